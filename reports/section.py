"""Building blocks of report sections: tables, figures with captions, blocks, and the subject of a report."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import pandas as pd
from markupsafe import Markup
from matplotlib.figure import Figure

from marsyard.reports.charts import svg_markup
from marsyard.reports.stored import StoredRun

T = TypeVar("T")


@dataclass(frozen=True)
class Grid:
    """A table of texts, and the number of rows left out."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    left_out: int = 0


def grid_of(records: Iterable[T], columns: Mapping[str, Callable[[T], str]]) -> Grid:
    """A table of records; `columns` maps headings to functions that make the texts."""
    return Grid([*columns], [[text(record) for text in columns.values()] for record in records])


@dataclass(frozen=True)
class SvgFigure:
    """A figure as SVG with its caption; `wide` figures have the full width of the page."""

    svg: Markup
    caption: str
    wide: bool = False


def plate(figure: Figure, key: str, caption: str, *, wide: bool = False) -> SvgFigure:
    """A figure with its caption; `key` is as in `svg_markup`."""
    # matplotlib escapes the texts inside, svg_markup the description
    return SvgFigure(Markup(svg_markup(figure, key, caption)), caption, wide)  # noqa: S704


@dataclass(frozen=True)
class Subject:
    """Subject of a report: the stored run, and the page's metric with its bound."""

    run: StoredRun
    metric: str | None
    bound: float | None

    @property
    def frame(self) -> pd.DataFrame:
        """The rows of all cases, or of the first of very many."""
        return self.run.frame

    @property
    def whole(self) -> pd.DataFrame:
        """The rows of all cases; of very many, only some columns."""
        return self.run.whole


@dataclass(frozen=True)
class Block:
    """A block of a section: heading, text, figures, table, note, as far as they are given."""

    heading: str = ""
    text: str = ""
    plates: Sequence[SvgFigure] = ()
    grid: Grid | None = None
    note: str = ""


@dataclass(frozen=True)
class Section:
    """A section of the page.

    key: its anchor and its key in `report.json`: letters, digits and hyphens
    name: its entry in the page's menu
    data: its numbers, for `report.json`
    """

    key: str
    name: str
    title: str
    blocks: Sequence[Block]
    data: Mapping[str, Any] = field(default_factory=dict)


SectionMaker = Callable[[Subject], Section | None]
