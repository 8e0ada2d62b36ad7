"""Tests of the code as a whole: import contracts, no circular imports, and no parameter without an effect."""

import ast
import tomllib
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

import grimp

from marsyard.scenarios.systems import own_paths, scenario, scenario_names
from marsyard.sim.parameters import Parameters

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


def test_every_parameter_is_read() -> None:
    """A parameter of the user that no code reads would have no effect. It may be read by a name in a string."""
    names = set()
    folders = [ROOT / name for name in ("sim", "algorithms", "scenarios", "campaigns", "reports", "marsyard")]
    for path in (path for folder in folders for path in folder.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_bytes())):
            if isinstance(node, ast.Attribute):
                names.add(node.attr)
            elif isinstance(node, ast.Constant):
                names.add(str(node.value))
    for name in scenario_names():
        scenario(name)  # imports its parameters
    models = [model for model in _list_subclasses(Parameters) if model.__module__.startswith("marsyard.")]
    unread = {f"{model.__name__}.{field}" for model in models for field in model.model_fields if field not in names}
    assert len(models) > 100
    assert unread == set()


def _list_subclasses(kind: type[Any]) -> list[type[Any]]:
    return [item for child in kind.__subclasses__() for item in (child, *_list_subclasses(child))]


def _read_contracts() -> list[dict[str, Any]]:
    contracts: list[dict[str, Any]] = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"][
        "contracts"
    ]
    return contracts
