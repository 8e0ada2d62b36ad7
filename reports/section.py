"""Report sections and what they are made of: the subject of a report, blocks, tables, and figures with captions."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import pandas as pd
from markupsafe import Markup
from matplotlib.figure import Figure

from marsyard.reports.figure_style import svg_markup
from marsyard.reports.stored import StoredRun
from marsyard.reports.wording import NOTHING

T = TypeVar("T")


@dataclass(frozen=True)
class Grid:
    """A table of texts, and the number of omitted rows.

    Raises ValueError if a row does not have one cell per column.
    """

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    n_omitted: int = 0

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.head):
                raise ValueError(f"row {list(row)} has {len(row)} cells; allowed: {len(self.head)}, as the head has")


def build_grid(records: Iterable[T], columns: Mapping[str, Callable[[T], str]]) -> Grid:
    """Create a table of records; `columns` maps headings to functions that format a record."""
    return Grid([*columns], [[text(record) for text in columns.values()] for record in records])


@dataclass(frozen=True)
class SvgFigure:
    """A figure as SVG with its caption; `wide` figures have the full width of the page."""

    svg: Markup
    caption: str
    wide: bool = False


def svg_figure(figure: Figure, key: str, caption: str, *, wide: bool = False) -> SvgFigure:
    """Convert a figure to SVG with its caption; `key` is as in `svg_markup`."""
    # matplotlib escapes the texts of the figure, svg_markup the description
    return SvgFigure(Markup(svg_markup(figure, key, caption)), caption, wide)  # noqa: S704


@dataclass(frozen=True)
class Subject:
    """Subject of a report: the stored run, and the page's metric with its bound."""

    run: StoredRun
    metric: str | None
    bound: float | None

    @property
    def frame(self) -> pd.DataFrame:
        """The rows of all cases, or of the first cases of a large campaign (see `StoredRun`)."""
        return self.run.frame

    @property
    def all_cases(self) -> pd.DataFrame:
        """The rows of all cases; in a large campaign they have only some columns."""
        return self.run.all_cases


@dataclass(frozen=True)
class Block:
    """A block of a section: heading, text, figures, table, note, and its numbers in `report.json`; all are optional.

    The numbers may contain dataclasses, which become tables of `report.json`.
    """

    heading: str = ""
    text: str = ""
    figures: Sequence[SvgFigure] = ()
    grid: Grid | None = None
    note: str = ""
    data: Mapping[str, Any] = field(default_factory=dict)

    @property
    def is_empty(self) -> bool:
        """Whether the page shows nothing of the block."""
        return not (self.heading or self.text or self.figures or self.grid or self.note)


@dataclass(frozen=True)
class Section:
    """A section of the page.

    - key: anchor of the section and key in `report.json`: letters, digits and hyphens
    - name: entry in the page's menu
    - data: numbers of the section in `report.json`
    """

    key: str
    name: str
    title: str
    blocks: Sequence[Block]
    data: Mapping[str, Any] = field(default_factory=dict)


SectionMaker = Callable[[Subject], Section | None]


def create_section(key: str, name: str, title: str, *blocks: Block | None) -> Section | None:
    """Create a section of the blocks that exist, with their data; None if no block has a content."""
    known_blocks = [block for block in blocks if block is not None]
    contents = [block for block in known_blocks if not block.is_empty]
    data = {name: value for block in known_blocks for name, value in block.data.items()}
    return Section(key, name, title, contents, data) if contents else None


def has_values(frame: pd.DataFrame, *columns: str) -> bool:
    """Whether all columns exist and contain a value."""
    return all(name in frame and not frame[name].isna().all() for name in columns)


def omit_empty_rows(rows: Sequence[Sequence[str]]) -> tuple[list[Sequence[str]], str]:
    """Omit the rows that have only dashes; return the other rows and a sentence that names the omitted rows."""
    is_empty = [all(text == NOTHING for text in row[1:]) for row in rows]
    names = [row[0].split(" (")[0] for row, empty in zip(rows, is_empty, strict=True) if empty]
    sentence = f"Too few cases to estimate: {', '.join(names)}. " if names else ""
    return [row for row, empty in zip(rows, is_empty, strict=True) if not empty], sentence


def drop_empty_columns(grid: Grid) -> Grid:
    """Remove the columns after the first that contain only dashes."""
    kept = [0, *(index for index in range(1, len(grid.head)) if any(row[index] != NOTHING for row in grid.rows))]
    return replace(
        grid, head=[grid.head[index] for index in kept], rows=[[row[index] for index in kept] for row in grid.rows]
    )
