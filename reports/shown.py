"""What a page shows of one case that was kept, and what a system says of how its cases are drawn."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marsyard.reports.plates import Plate


@dataclass(frozen=True)
class TableRow:
    """A row of a case's table: its values as texts, and whether what it tells of succeeded."""

    values: Sequence[str]
    succeeded: bool


@dataclass(frozen=True)
class CaseView:
    """A case as its page shows it: facts by name, figures, and a table; `legend` in place of its system's."""

    facts: Sequence[tuple[str, str]]
    plates: Sequence[Plate]
    head: Sequence[str]
    rows: Sequence[TableRow]
    legend: str | None = None


@dataclass(frozen=True)
class System:
    """How cases of one of the papers' systems are drawn, from their products alone.

    Attributes
    ----------
    is_case
        Whether products are those of such a case.
    view
        What the page shows of it; the text names it in figures' identifiers.
    write
        Writes its figures into a folder and returns their paths; raises OSError where they cannot be written.
    legend
        What a reader of the page's figures must know.
    """

    is_case: Callable[[Mapping[str, Any]], bool]
    view: Callable[[Mapping[str, Any], str], CaseView]
    write: Callable[[Path, Mapping[str, Any]], list[Path]]
    legend: str
