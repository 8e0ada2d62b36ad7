"""The columns of the scenarios' rows, as the systems' files state them (`columns.toml`)."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache

from marsyard.scenarios.systems import system_of


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
def stated_columns(scenario: str) -> StatedColumns | None:
    """The columns of a scenario by its name; None where its system does not state them.

    Raises
    ------
    ValueError
        Where the system's file cannot be used.
    """
    system = system_of(scenario)
    if system is None or system.columns is None:
        return None
    try:
        stated = tomllib.loads(system.columns.read_text(encoding="utf-8")).get(scenario)
        if stated is None:
            return None
        return StatedColumns(tuple(stated["flags"]), tuple(stated["numbers"]), stated.get("named_flags", ""))
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise ValueError(f"{system.columns}: states no columns: {type(error).__name__}: {error}") from error
