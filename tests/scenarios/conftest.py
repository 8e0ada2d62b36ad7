"""Fixture for all scenario tests: each row contains only the columns that `scenarios/columns.toml` declares."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from marsyard.scenarios.interface import CaseResult
from marsyard.scenarios.systems import RowColumns, row_columns, scenario_paths
from marsyard.scenarios.user_files import import_object


def _list_undeclared_columns(row: Any, declared: RowColumns, custom_prefixes: tuple[str, ...]) -> list[str]:
    """Return undeclared columns of numbers and booleans; the prefixes of compared algorithms are removed first."""
    undeclared_names = []
    for name, value in row.items():
        column = name.rpartition(".")[2] if not name.startswith("footprints_") else name
        is_flag = isinstance(value, bool)
        is_declared = (declared.has_flag(column) or column == "answered") if is_flag else declared.has_number(column)
        if not isinstance(value, str) and not is_declared and not column.startswith(custom_prefixes):
            undeclared_names.append(name)
    return undeclared_names


def add_column_check(run: Callable[..., CaseResult], declared: RowColumns) -> Callable[..., CaseResult]:
    """Return a wrapper of a scenario's `run` method that checks the columns of each row."""

    def run_and_check(self: Any, parameters: Any, streams: Any) -> CaseResult:
        result = run(self, parameters, streams)
        flags = getattr(parameters, declared.named_flags, ()) if declared.named_flags else ()
        # Columns of custom scores start with the function name.
        score_parameters = parameters if getattr(parameters, "scores", ()) else getattr(parameters, "drive", None)
        score_specs: tuple[str, ...] = getattr(score_parameters, "scores", ())
        custom_prefixes = (*(flag.name for flag in flags), *(f"{spec.rpartition(':')[2]}_" for spec in score_specs))
        undeclared = _list_undeclared_columns(result.row, declared, custom_prefixes)
        assert not undeclared, f"columns that scenarios/columns.toml does not declare for {self.name}: {undeclared}"
        return result

    return run_and_check


@pytest.fixture(autouse=True, scope="session")
def _check_row_columns() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for name, path in scenario_paths().items():
            scenario_class = import_object(path)
            declared = row_columns(name)
            assert declared is not None
            patch.setattr(scenario_class, "run", add_column_check(scenario_class.run, declared))
        yield
