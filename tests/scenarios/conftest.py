"""Fixtures of all scenario tests: rows contain only the declared columns; algorithms of tests are described here."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from marsyard.scenarios import custom_algorithms
from marsyard.scenarios.columns import ENGINE, Columns
from marsyard.scenarios.declared_columns import row_columns
from marsyard.scenarios.imports import import_object
from marsyard.scenarios.interface import CaseResult
from marsyard.scenarios.isolation.remote import AlgorithmDescription, describe_in_process
from marsyard.scenarios.systems import scenario_paths
from tests.scenarios.suites import describe_here


def _list_undeclared_columns(row: Any, declared_columns: Columns, custom_prefixes: tuple[str, ...]) -> list[str]:
    """Return the undeclared columns, without the label of a compared algorithm, which precedes a dot.

    In the name of a `footprints_` column, a dot is a decimal point.
    """
    declared = Columns((*declared_columns, *ENGINE))
    undeclared_names = []
    for name, value in row.items():
        column = name.rpartition(".")[2] if not name.startswith("footprints_") else name
        kind = float if isinstance(value, int | float) and not isinstance(value, bool) else type(value)
        if not declared.has(column, kind) and not column.startswith(custom_prefixes):
            undeclared_names.append(name)
    return undeclared_names


def add_column_check(run: Callable[..., CaseResult], declared_columns: Columns) -> Callable[..., CaseResult]:
    """Return a wrapper of a scenario's `run` method that checks the columns of each row."""

    def run_and_check(self: Any, parameters: Any, streams: Any) -> CaseResult:
        result = run(self, parameters, streams)
        flags = getattr(parameters, declared_columns.named_flags, ()) if declared_columns.named_flags else ()
        # Columns of custom scores start with the function name.
        score_parameters = parameters if getattr(parameters, "scores", ()) else getattr(parameters, "drive", None)
        score_specs: tuple[str, ...] = getattr(score_parameters, "scores", ())
        custom_prefixes = (*(flag.name for flag in flags), *(f"{spec.rpartition(':')[2]}_" for spec in score_specs))
        undeclared_columns = _list_undeclared_columns(result.row, declared_columns, custom_prefixes)
        assert not undeclared_columns, f"columns that {self.name} does not declare: {undeclared_columns}"
        return result

    return run_and_check


@pytest.fixture(autouse=True, scope="session")
def _check_row_columns() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for name, path in scenario_paths().items():
            scenario_class = import_object(path)
            declared_columns = row_columns(name)
            assert declared_columns is not None
            patch.setattr(scenario_class, "run", add_column_check(scenario_class.run, declared_columns))
        yield


@pytest.fixture(autouse=True, scope="session")
def _describe_algorithms_here() -> Iterator[None]:
    """Describe the algorithms of test modules in this process."""

    def describe(spec: str) -> AlgorithmDescription:
        return describe_here(spec) if spec.startswith("tests.scenarios.") else describe_in_process(spec)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(custom_algorithms, "describe_in_process", describe)
        yield
