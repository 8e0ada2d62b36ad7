"""The columns that the scenarios that ship fill, as `columns.toml` states them."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path

_FILE = Path(__file__).with_suffix(".toml")


@dataclass(frozen=True)
class StatedColumns:
    """Columns of a scenario's rows; in `flags` and `numbers` a star stands for any text.

    Attributes
    ----------
    flags
        Columns of true and false.
    numbers
        Columns of numbers.
    named_flags
        A list among the parameters whose entries' `name` are further columns of true and false; empty for none.
    """

    flags: tuple[str, ...]
    numbers: tuple[str, ...]
    named_flags: str = ""

    def has_flag(self, name: str) -> bool:
        """Whether a column of true and false may have this name."""
        return any(fnmatchcase(name, pattern) for pattern in self.flags)

    def has_number(self, name: str) -> bool:
        """Whether a column of numbers may have this name."""
        return any(fnmatchcase(name, pattern) for pattern in self.numbers)


@cache
def stated_columns() -> Mapping[str, StatedColumns]:
    """The columns of each scenario that ships, by its name."""
    tables = tomllib.loads(_FILE.read_text(encoding="utf-8"))
    return {
        name: StatedColumns(tuple(one["flags"]), tuple(one["numbers"]), one.get("named_flags", ""))
        for name, one in tables.items()
    }
