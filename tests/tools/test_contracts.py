"""Test of the import contracts: algorithms may import only the listed modules of the simulation."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
#: Modules of the simulation that algorithms may import (docs/architecture.md).
ALLOWED_MODULES = {"marsyard.sim.frames", "marsyard.sim.camera", "marsyard.sim.measurements"}
#: Modules that `marsyard.sim.camera` imports: checks of files. They do not contain the truth.
CAMERA_DEPENDENCIES = {"marsyard.sim.files"}
#: Base class and field types of parameters. They do not contain the truth.
PARAMETER_TYPES = {"marsyard.sim.parameters"}


def test_algorithms_may_import_only_the_allowed_modules_of_sim() -> None:
    paths = [path for path in (ROOT / "sim").iterdir() if path.suffix in ("", ".py") and not path.name.startswith("_")]
    modules = {f"marsyard.sim.{path.stem}" for path in paths}
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    forbidden_modules = next(
        set(contract["forbidden_modules"]) for contract in contracts if contract["type"] == "forbidden"
    )
    assert forbidden_modules == modules - ALLOWED_MODULES - CAMERA_DEPENDENCIES - PARAMETER_TYPES
