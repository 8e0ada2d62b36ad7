"""Checks that each row of a scenario has only the columns of `scenarios/columns.toml`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from marsyard.scenarios.interface import CaseResult
from marsyard.scenarios.systems import RowColumns, row_columns, scenario_paths
from marsyard.scenarios.user_files import import_object


def _list_undeclared_columns(row: Any, declared: RowColumns, custom_prefixes: tuple[str, ...]) -> list[str]:
    """Return undeclared columns of numbers and truth values; prefixes of other algorithms are removed first."""
    undeclared_names = []
    for name, value in row.items():
        plain = name.rpartition(".")[2] if not name.startswith("footprints_") else name
        is_flag = isinstance(value, bool)
        known = declared.has_flag(plain) or plain == "answered" if is_flag else declared.has_number(plain)
        if not isinstance(value, str) and not known and not plain.startswith(custom_prefixes):
            undeclared_names.append(name)
    return undeclared_names


def _check_columns_of(run: Callable[..., CaseResult], declared: RowColumns) -> Callable[..., CaseResult]:
    def run_and_check(self: Any, parameters: Any, streams: Any) -> CaseResult:
        result = run(self, parameters, streams)
        named = [flag.name for flag in getattr(parameters, declared.named_flags, ())] if declared.named_flags else []
        # Columns of custom scores start with the function name.
        holder = parameters if getattr(parameters, "scores", ()) else getattr(parameters, "drive", None)
        specs: tuple[str, ...] = getattr(holder, "scores", ())
        custom_prefixes = (*named, *(f"{spec.rpartition(':')[2]}_" for spec in specs))
        undeclared = _list_undeclared_columns(result.row, declared, custom_prefixes)
        assert not undeclared, f"columns that scenarios/columns.toml does not state for {self.name}: {undeclared}"
        return result

    return run_and_check


@pytest.fixture(autouse=True, scope="session")
def _check_row_columns() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for name, path in scenario_paths().items():
            scenario_class = import_object(path)
            declared = row_columns(name)
            assert declared is not None
            patch.setattr(scenario_class, "run", _check_columns_of(scenario_class.run, declared))
        yield
