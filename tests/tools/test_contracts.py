"""Import contracts: they cover every module of the simulation, including new ones."""

from __future__ import annotations

import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
#: All that an algorithm may know of the simulated world (docs/architecture.md).
OPEN_TO_ALGORITHMS = {"marsyard.sim.frames", "marsyard.sim.camera", "marsyard.sim.measurements"}
#: What `marsyard.sim.camera` reads files with: checks of files, which hold no truth.
BELOW_THE_CAMERAS = {"marsyard.sim.files"}
#: The base class of parameters and its types of fields: no world, and no truth.
BASE_OF_PARAMETERS = {"marsyard.sim.parameters"}


def test_all_of_sim_but_the_flight_interface_is_closed_to_algorithms() -> None:
    children = [
        path for path in (ROOT / "sim").iterdir() if path.suffix in ("", ".py") and not path.name.startswith("_")
    ]
    modules = {f"marsyard.sim.{path.stem}" for path in children}
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    closed = next(set(c["forbidden_modules"]) for c in contracts if c["type"] == "forbidden")
    assert closed == modules - OPEN_TO_ALGORITHMS - BELOW_THE_CAMERAS - BASE_OF_PARAMETERS
