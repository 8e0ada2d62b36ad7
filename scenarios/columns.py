"""Declaration of a scenario's rows: each column once, with its type, unit, kind and meaning.

Reports, axes, checks of requirements, the reference of columns and the tests of the scenarios read these declarations.
The engine adds its own columns (`ENGINE`) and the sampled values of the case, each under the path of its parameter.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from fnmatch import fnmatchcase
from functools import cached_property

#: Units by the ends of column names; an ending precedes all others that are its own end (`_deg_s` precedes `_s`).
_UNITS = {
    "_deg_h_k": "deg/h/K", "_deg_h": "deg/h", "_m_s2": "m/s²", "_deg_s": "deg/s", "_rad_s": "rad/s", "_m_s": "m/s",
    "_m2": "m²", "_mrad": "mrad", "_ppm": "ppm",
    "_deg": "deg", "_rad": "rad", "_km": "km", "_mm": "mm", "_cm": "cm", "_px": "px", "_dn": "DN", "_ms": "ms",
    "_kg": "kg", "_m": "m", "_s": "s", "_k": "K",
}  # fmt: skip


class ColumnKind(StrEnum):
    """What a column describes.

    - CONDITION: world, motion and images of the case, which do not depend on the algorithm
    - INSTRUMENT_ERROR: error of a measurement that the algorithm receives
    - TRUTH: flag that the flight system cannot know, because it is computed from the truth
    - CONFIGURED: column that follows from the parameters of a case, such as its camera or its fault
    - OUTCOME: answer of the algorithm, and quantities of its computation
    - ERROR: difference between answer and truth, or a score of the answer
    - PROVENANCE: identity of case, images, programs and machine; times
    """

    CONDITION = "condition"
    INSTRUMENT_ERROR = "instrument error"
    TRUTH = "from truth"
    CONFIGURED = "configured"
    OUTCOME = "outcome"
    ERROR = "error"
    PROVENANCE = "provenance"


def split_unit(column: str) -> tuple[str, str]:
    """Split a column name into name and unit; the unit may be empty.

    >>> split_unit("attitude_rate_max_deg_s")
    ('attitude_rate_max', 'deg/s')
    """
    for ending, unit in _UNITS.items():
        if column.endswith(ending) and len(column) > len(ending):
            return column.removesuffix(ending), unit
    return column, ""


def to_words(name: str) -> str:
    """Return a name in words: ``sun.azimuth`` as ``sun azimuth``."""
    return name.replace("_", " ").replace(".", " ")


@dataclass(frozen=True)
class Column:
    """A column, or several columns with a common pattern.

    - name: name; a star matches any text, such as the number of an image
    - kind: what it describes
    - type: type of its values: float for numbers, bool for flags, str for texts
    - meaning: noun phrase; for a flag, a clause
    - label: the quantity in words, for axes and tables, with the stars of the name; by default the words of the name
    - population: phrase after "cases" for the cases with a true flag; by default the clause
    - enables_answer: whether an algorithm can answer only in the cases with a true flag
    """

    name: str
    kind: ColumnKind
    meaning: str
    label: str = ""
    population: str = ""
    type: type[float | bool | str] = float
    enables_answer: bool = False

    @property
    def unit(self) -> str:
        """Unit; empty for a number without a unit."""
        return split_unit(self.name)[1]

    def matches(self, name: str) -> bool:
        """Return whether a column name is this name or follows the pattern."""
        return fnmatchcase(name, self.name)

    def label_of(self, name: str) -> str:
        """Return the quantity of a matching column in words, without its unit."""
        return self._insert(self.label, name) if self.label else to_words(split_unit(name)[0])

    def population_of(self, name: str) -> str:
        """Return the phrase of the cases with a true flag, after "cases"."""
        return self._insert(self.population, name) or f"for which {self.meaning}"

    def _insert(self, words: str, name: str) -> str:
        """Replace the stars of a phrase by the texts at the stars of the pattern."""
        stars = re.fullmatch(re.escape(self.name).replace(r"\*", "(.+)"), name)
        for part in () if stars is None else stars.groups():
            words = words.replace("*", to_words(part).replace(" percent", " %"), 1)
        return words


def condition(name: str, meaning: str, label: str = "") -> Column:
    """Declare a number that describes the conditions of a case."""
    return Column(name, ColumnKind.CONDITION, meaning, label)


def instrument_error(name: str, meaning: str, label: str = "") -> Column:
    """Declare the error of a measurement."""
    return Column(name, ColumnKind.INSTRUMENT_ERROR, meaning, label)


def outcome(name: str, meaning: str, label: str = "") -> Column:
    """Declare a number of an algorithm's answer or computation."""
    return Column(name, ColumnKind.OUTCOME, meaning, label)


def error(name: str, meaning: str, label: str = "") -> Column:
    """Declare an error or a score of an algorithm's answer."""
    return Column(name, ColumnKind.ERROR, meaning, label)


def flag(name: str, clause: str, population: str = "", kind: ColumnKind = ColumnKind.OUTCOME) -> Column:
    """Declare a column of true and false."""
    return Column(name, kind, clause, population=population, type=bool)


def text(name: str, meaning: str, kind: ColumnKind = ColumnKind.CONDITION) -> Column:
    """Declare a column of texts."""
    return Column(name, kind, meaning, type=str)


#: Columns of the engine: the first ones of a row, and the last ones.
LEADING = (
    Column("case", ColumnKind.PROVENANCE, "number of the case"),
    text("outcome", "outcome of the answer, or reason of the failure", ColumnKind.OUTCOME),
    flag("answered", "an answer is given", "with an answer"),
)
TRAILING = (
    Column("case_attempts", ColumnKind.PROVENANCE, "number of times that the case was run"),
    Column("wall_time_s", ColumnKind.PROVENANCE, "wall-clock time of the case"),
    Column("cpu_time_s", ColumnKind.PROVENANCE, "processor time of the case"),
    text("error", "message of a failure", ColumnKind.OUTCOME),
    text("traceback", "traceback of a failure", ColumnKind.OUTCOME),
)
ENGINE = (
    *LEADING,
    *TRAILING,
    text("standard_point", "point of a study at which the case was run", ColumnKind.PROVENANCE),
)


@dataclass(frozen=True)
class Columns:
    """Columns of a scenario's rows.

    - columns: all columns, also patterns
    - named_flags: path of a list among the parameters; the `name` of each entry is a further flag; empty for none
    """

    columns: tuple[Column, ...]
    named_flags: str = ""

    def __iter__(self) -> Iterator[Column]:
        return iter(self.columns)

    def find(self, name: str) -> Column | None:
        """Return the declaration of a column: that of its name, else that of the longest pattern."""
        matching = (item for item in self.columns if item.matches(name))
        return self._by_name.get(name) or max(matching, key=lambda item: len(item.name), default=None)

    def names(self, value_type: type[float | bool | str]) -> tuple[str, ...]:
        """Return the names and patterns of the columns with values of a type."""
        return tuple(item.name for item in self.columns if item.type is value_type)

    def has(self, name: str, value_type: type[float | bool | str]) -> bool:
        """Return whether a column with values of a type may have this name."""
        return any(item.type is value_type and item.matches(name) for item in self.columns)

    @property
    def from_truth(self) -> dict[str, str]:
        """Clauses of the flags from the truth, by name."""
        return {item.name: item.meaning for item in self.columns if item.kind is ColumnKind.TRUTH}

    @property
    def configured(self) -> tuple[str, ...]:
        """Names and patterns of the configured columns."""
        return tuple(item.name for item in self.columns if item.kind is ColumnKind.CONFIGURED)

    def is_condition(self, name: str) -> bool:
        """Return whether a column describes the conditions of a case."""
        found = self.find(name)
        return found is not None and found.kind in (ColumnKind.CONDITION, ColumnKind.INSTRUMENT_ERROR)

    @cached_property
    def _by_name(self) -> dict[str, Column]:
        return {item.name: item for item in self.columns}
