"""The field test's runs and categories beside the paper's (its Fig. 11), and errors by category (its Fig. 10).

The section is there where rows say of which `run` and `category` they are. The paper's numbers stand beside cells of
the same names; where a campaign has other runs there are none.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from marsyard.reports.answers import CONFIDENCE, Share, share_of
from marsyard.reports.columns import axis_columns, label, numbers, split_unit
from marsyard.reports.plates import Plate, plate
from marsyard.reports.populations import is_flag, members
from marsyard.reports.section import Block, Section, Subject
from marsyard.reports.sections import Grid
from marsyard.reports.svg import MARKERS, REQUIREMENT, SERIES, in_page_style, new_axes
from marsyard.reports.wording import NOTHING, count, number, percent, stated

#: Difference from the paper that is called large, percentage points.
LARGE_POINTS = 10.0


@dataclass(frozen=True)
class PaperCell:
    """A row of the paper's Fig. 11 as printed: counts, total and per cent valid."""

    valid: int
    invalid: int
    total: int
    percent: int

    @property
    def adds_up(self) -> bool:
        """Whether valid and invalid come to the total."""
        return self.valid + self.invalid == self.total


#: Fig. 11 of the paper by (category, run).
PAPER: Mapping[tuple[str, str], PaperCell] = MappingProxyType(
    {
        ("short time", "Pisgah Run 2"): PaperCell(67, 1, 68, 99),
        ("short time", "Pisgah Run 3"): PaperCell(128, 8, 134, 94),
        ("short time", "Kelso Run 2"): PaperCell(65, 0, 65, 100),
        ("short time", "Kelso Run 3"): PaperCell(251, 0, 251, 100),
        ("short time", "Ivanpah Run 3"): PaperCell(139, 0, 139, 100),
        ("same direction", "Pisgah Run 2"): PaperCell(41, 0, 41, 100),
        ("same direction", "Pisgah Run 3"): PaperCell(168, 6, 164, 99),
        ("same direction", "Kelso Run 2"): PaperCell(95, 10, 105, 90),
        ("same direction", "Kelso Run 3"): PaperCell(121, 185, 306, 40),
        ("same direction", "Ivanpah Run 3"): PaperCell(63, 3, 66, 95),
        ("opposite direction", "Pisgah Run 2"): PaperCell(26, 0, 26, 100),
        ("opposite direction", "Pisgah Run 3"): PaperCell(139, 0, 139, 100),
        ("opposite direction", "Kelso Run 2"): PaperCell(97, 2, 99, 98),
        ("opposite direction", "Kelso Run 3"): PaperCell(121, 165, 286, 42),
        ("opposite direction", "Ivanpah Run 3"): PaperCell(24, 0, 24, 100),
    }
)


@dataclass(frozen=True)
class Cell:
    """The triples of one category and run.

    Attributes
    ----------
    category, run
        Which they are.
    valid
        The share with an answer.
    beyond
        Answers whose error is beyond the bound; None without one.
    largest
        Largest error of an answer; NaN for none.
    paper_percent
        The paper's per cent valid; None where it has no such cell.
    difference_points
        Ours less the paper's, percentage points; NaN where there is none.
    """

    category: str
    run: str
    valid: Share
    beyond: int | None
    largest: float
    paper_percent: int | None
    difference_points: float


def field_test_section(subject: Subject) -> Section | None:
    """Runs and categories; None where the rows do not say which they are of."""
    frame = subject.frame
    if not {"run", "category"}.issubset(frame.columns) or not is_flag(frame, "answered"):
        return None
    found = cells(subject)
    blocks = [Block(grid=_grid(found, subject.bound), note=_note(found))]
    plates = scatter_plates(subject)
    if plates:
        blocks.append(Block(heading="Errors by category", plates=plates, note=_scatter_note(subject)))
    data = {"cells": [asdict(one) for one in found]}
    return Section("field-test", "Field test", "Runs and categories, beside the paper's Fig. 11", blocks, data)


def cells(subject: Subject) -> list[Cell]:
    """Every category and run, in the paper's order, then in that of the rows."""
    frame = subject.frame
    known = frame[["category", "run"]].dropna().drop_duplicates()
    pairs = [(str(category), str(run)) for category, run in known.itertuples(index=False)]
    paper = [pair for pair in PAPER if pair in pairs]
    return [_cell(subject, *pair) for pair in [*paper, *(pair for pair in pairs if pair not in PAPER)]]


def _cell(subject: Subject, category: str, run: str) -> Cell:
    frame = subject.frame
    chosen = frame[frame["category"].eq(category) & frame["run"].eq(run)]
    answered = members(chosen, "valid")
    errors = np.abs(numbers(chosen[answered], subject.metric)) if subject.metric else np.array([])
    errors = errors[np.isfinite(errors)]
    share, paper = share_of(answered, chosen), PAPER.get((category, run))
    return Cell(
        category=category,
        run=run,
        valid=share,
        beyond=None if subject.bound is None else int((errors > subject.bound).sum()),
        largest=float(errors.max()) if errors.size else math.nan,
        paper_percent=None if paper is None else paper.percent,
        difference_points=math.nan if paper is None else 100.0 * share.share - paper.percent,
    )


def _grid(found: Sequence[Cell], bound: float | None) -> Grid:
    beyond = "Beyond the bound" if bound is None else f"Beyond {bound:g}"
    head = ["Category and run", "Triples", "Valid", "% valid", f"{stated(CONFIDENCE)} interval", "Paper", "Difference"]
    head += [beyond, "Largest error"]
    rows = [
        [
            f"{one.category}: {one.run}",
            f"{one.valid.n:,}",
            f"{one.valid.hits:,}",
            percent(one.valid.share),
            f"{percent(one.valid.lower)} to {percent(one.valid.upper)}",
            NOTHING if one.paper_percent is None else f"{one.paper_percent} %",
            _points(one.difference_points),
            NOTHING if one.beyond is None else f"{one.beyond:,}",
            number(one.largest),
        ]
        for one in found
    ]
    return Grid(head, rows)


def _points(difference: float) -> str:
    if math.isnan(difference):
        return NOTHING
    mark = " (large)" if abs(difference) > LARGE_POINTS else ""
    return f"{difference:+.1f} pp{mark}".replace("-", "−")


def _note(found: Sequence[Cell]) -> str:
    """What a reader must know of the table: the paper's misprints, and which cells differ."""
    said = (
        "Difference: ours less the paper's, in percentage points (pp). Intervals: two-sided, Clopper and Pearson, as "
        "for independent triples; triples of a run share its pictures and are not."
    )
    if not any(one.paper_percent is not None for one in found):
        return said
    odd = [f"{run}, {category} ({cell.valid} + {cell.invalid} ≠ {cell.total})" for (category, run), cell in _odd()]
    totals, counts = sum(c.total for c in PAPER.values()), sum(c.valid + c.invalid for c in PAPER.values())
    large = [f"{one.category}, {one.run}" for one in found if abs(one.difference_points) > LARGE_POINTS]
    apart = f"More than {LARGE_POINTS:g} percentage points apart: {'; '.join(large)}." if large else ""
    return (
        f"{said} Misprints of the paper's table: the rows {'; '.join(odd)}; its totals sum to {totals:,}, its counts "
        f"to {counts:,}. Its totals are taken. Of Pisgah Run 3's same direction it prints 99 %, its counts give 97 %. "
        f"{apart or f'No cell is more than {LARGE_POINTS:g} points apart.'}"
    )


def _odd() -> list[tuple[tuple[str, str], PaperCell]]:
    """The paper's rows that do not add up."""
    return [(key, cell) for key, cell in PAPER.items() if not cell.adds_up]


def scatter_plates(subject: Subject) -> list[Plate]:
    """Signed errors of each category, on axes of one size (the paper's Fig. 10)."""
    frame, metric = subject.frame, subject.metric
    parts = axis_columns(metric, [str(name) for name in frame.columns])[:2] if metric else []
    if len(parts) < 2:
        return []
    points = np.column_stack([numbers(frame, part) for part in parts])
    known = np.isfinite(points).all(axis=1)
    if not known.any():
        return []
    reach = 1.06 * max(float(np.abs(points[known]).max()), subject.bound or 0.0)
    categories = list(dict.fromkeys(category for category, _ in PAPER)) + sorted(frame["category"].dropna().unique())
    plates = []
    for place, category in enumerate(dict.fromkeys(str(one) for one in categories)):
        chosen = frame[known & frame["category"].eq(category).to_numpy(dtype=np.bool_)]
        if len(chosen):
            caption = f"{category[:1].upper()}{category[1:]}: {count(len(chosen), 'valid triple')}."
            figure = _scatter(chosen, parts, subject, reach)
            plates.append(plate(figure, f"fieldtest{place}", caption))
    return plates


@in_page_style
def _scatter(chosen: pd.DataFrame, parts: Sequence[str], subject: Subject, reach: float) -> Figure:
    """Errors of one category, marked by run."""
    figure, axes = new_axes(4.2, 4.4)
    runs = sorted(str(run) for run in subject.frame["run"].dropna().unique())
    for place, run in enumerate(runs):
        rows = chosen[chosen["run"].eq(run)]
        x, y = (numbers(rows, part) for part in parts)
        style: dict[str, Any] = {"marker": MARKERS[place % len(MARKERS)], "color": SERIES[place % len(SERIES)]}
        axes.plot(x, y, linestyle="", markersize=4.0, alpha=0.7, markeredgewidth=0.0, label=run, **style)
    if subject.bound is not None:
        axes.add_patch(Circle((0, 0), subject.bound, fill=False, color=REQUIREMENT, linewidth=1.6, linestyle="--"))
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    axes.set(xlabel=label(parts[0]), ylabel=label(parts[1]))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2, handletextpad=0.2)
    return figure


def _scatter_note(subject: Subject) -> str:
    if subject.bound is None or subject.metric is None:
        return ""
    return (
        f"As the paper's Fig. 10: errors of the valid triples; the dashed circle is {subject.bound:g} "
        f"{split_unit(subject.metric)[1]}. East is x, north is y."
    )
