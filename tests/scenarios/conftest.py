"""Every row that a scenario gives in these tests has the columns that `scenarios/columns.toml` states."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from marsyard.scenarios.interface import CaseResult
from marsyard.scenarios.systems import RowColumns, row_columns, scenario_paths
from marsyard.scenarios.user_files import import_object


def _unstated(row: Any, stated: RowColumns, own: tuple[str, ...]) -> list[str]:
    """Columns of numbers and truth values that are stated nowhere; those of further algorithms are the judged one's."""
    found = []
    for name, value in row.items():
        plain = name.rpartition(".")[2] if not name.startswith("footprints_") else name
        is_flag = isinstance(value, bool)
        known = stated.has_flag(plain) or plain == "answered" if is_flag else stated.has_number(plain)
        if not isinstance(value, str) and not known and not plain.startswith(own):
            found.append(name)
    return found


def _checked(run: Callable[..., CaseResult], stated: RowColumns) -> Callable[..., CaseResult]:
    def checked(self: Any, parameters: Any, streams: Any) -> CaseResult:
        result = run(self, parameters, streams)
        named = [one.name for one in getattr(parameters, stated.named_flags, ())] if stated.named_flags else []
        # columns of a user's own scores begin with the function's name
        holder = parameters if getattr(parameters, "scores", ()) else getattr(parameters, "drive", None)
        specs: tuple[str, ...] = getattr(holder, "scores", ())
        own = (*named, *(f"{spec.rpartition(':')[2]}_" for spec in specs))
        unstated = _unstated(result.row, stated, own)
        assert not unstated, f"columns that scenarios/columns.toml does not state for {self.name}: {unstated}"
        return result

    return checked


@pytest.fixture(autouse=True, scope="session")
def _rows_have_the_columns_that_are_stated() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for name, path in scenario_paths().items():
            kind = import_object(path)
            stated = row_columns(name)
            assert stated is not None
            patch.setattr(kind, "run", _checked(kind.run, stated))
        yield
