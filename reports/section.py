"""What sections of a report are made of: tables, figures with captions, blocks, and the subject they are about.

A section is made by a function that takes a `Subject` and returns the `Section`, or None where the rows hold none of
its columns. `marsyard.reports.kinds` has such functions as data.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import pandas as pd
from markupsafe import Markup
from matplotlib.figure import Figure

from marsyard.reports.stored import StoredRun
from marsyard.reports.svg import svg_markup

T = TypeVar("T")


@dataclass(frozen=True)
class Grid:
    """A table of texts: headings, rows, and how many rows were left out."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    left_out: int = 0


def grid_of(records: Iterable[T], columns: Mapping[str, Callable[[T], str]]) -> Grid:
    """A table of records: each column's heading, and the function that makes its text from a record."""
    return Grid([*columns], [[text(record) for text in columns.values()] for record in records])


@dataclass(frozen=True)
class Plate:
    """A figure as SVG, its caption, and whether it takes the page's whole width."""

    svg: Markup
    caption: str
    wide: bool = False


def plate(figure: Figure, key: str, caption: str, *, wide: bool = False) -> Plate:
    """A figure with its caption; `key` is as in `svg_markup`."""
    # Matplotlib has escaped the texts inside; the description is escaped where it is put in.
    return Plate(Markup(svg_markup(figure, key, caption)), caption, wide)  # noqa: S704


@dataclass(frozen=True)
class Subject:
    """What a report is about: the stored run, and the page's metric and its bound where there are any."""

    run: StoredRun
    metric: str | None
    bound: float | None

    @property
    def frame(self) -> pd.DataFrame:
        """The rows: all, or of very many cases the first."""
        return self.run.frame

    @property
    def whole(self) -> pd.DataFrame:
        """The rows of all cases; of very many only some columns."""
        return self.run.whole


@dataclass(frozen=True)
class Block:
    """A part of a section, shown in this order: heading, text, figures, table, note; empty parts are left out."""

    heading: str = ""
    text: str = ""
    plates: Sequence[Plate] = ()
    grid: Grid | None = None
    note: str = ""


@dataclass(frozen=True)
class Section:
    """A section of the page.

    Attributes
    ----------
    key
        Its anchor, and its name in `report.json`: letters, digits and hyphens.
    name
        What the page's menu calls it.
    title
        Its heading.
    blocks
        What it shows.
    data
        The same in numbers, for `report.json`.
    """

    key: str
    name: str
    title: str
    blocks: Sequence[Block]
    data: Mapping[str, Any] = field(default_factory=dict)


SectionMaker = Callable[[Subject], Section | None]
