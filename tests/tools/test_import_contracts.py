"""The contract on what algorithms may see names every part of `sim` that there is."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
#: What an algorithm may import of `sim`.
ALLOWED = {"sim.frames", "sim.camera", "sim.measurements"}


def test_every_other_part_of_sim_is_forbidden_to_algorithms() -> None:
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (forbidden,) = [set(c["forbidden_modules"]) for c in contracts if c["type"] == "forbidden"]
    parts = {f"sim.{path.stem}" for path in (ROOT / "sim").iterdir() if path.is_dir() or path.suffix == ".py"}
    parts -= {"sim.__init__", "sim.__pycache__"}
    assert forbidden == parts - ALLOWED
