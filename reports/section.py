"""What further sections of a report are made of, and what makes them.

A section has a module of its own with a function that takes a `Subject` and returns the `Section`, or None where the
rows hold none of its columns. `marsyard.reports.campaign.FURTHER_SECTIONS` lists these functions in the order of the
page.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

from marsyard.reports.plates import Plate
from marsyard.reports.sections import Grid
from marsyard.reports.stored import StoredRun


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
    """A part of a section, shown in this order: heading, text, figures, table, note; whatever is empty is left out."""

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
