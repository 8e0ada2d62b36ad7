"""Tests of the import contracts: they list each module of the simulation and of the scenarios; no circular imports."""

import tomllib
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

import grimp

from marsyard.scenarios.systems import own_paths

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
    forbidden_modules = next(
        set(contract["forbidden_modules"]) for contract in _read_contracts() if contract["type"] == "forbidden"
    )
    assert forbidden_modules == modules - ALLOWED_MODULES - CAMERA_DEPENDENCIES - PARAMETER_TYPES


def test_contract_separates_systems_from_common_modules() -> None:
    contract = next(item for item in _read_contracts() if item.get("containers") == ["marsyard.scenarios"])
    # recorded images are a layer above the other systems
    *layers, shared = ({name.strip() for name in layer.replace(":", "|").split("|")} for layer in contract["layers"])
    assert set().union(*layers) <= set(own_paths())
    modules = {path.stem for path in (ROOT / "scenarios").iterdir() if path.suffix in ("", ".py")}
    # conformance suites use the inputs and limits of several systems
    assert shared == {name for name in modules if not name.startswith("_")} - set(own_paths()) - {"conformance"}


def test_no_circular_imports() -> None:
    graph = grimp.build_graph("marsyard", exclude_type_checking_imports=True, cache_dir=None)
    # raises CycleError, which names the modules
    TopologicalSorter({name: graph.find_modules_directly_imported_by(name) for name in graph.modules}).prepare()


def _read_contracts() -> list[dict[str, Any]]:
    contracts: list[dict[str, Any]] = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"][
        "contracts"
    ]
    return contracts
