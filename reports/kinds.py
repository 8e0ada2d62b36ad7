"""Kinds of report sections as data: what a system declares instead of writing a section by hand.

A `SectionDeclaration` is a section of parts. A part takes the section's rows and gives a block of the page and the same
in numbers: `RateTable`, `RateByCondition`, `OutcomesBySize`, `Distribution`, `Statistics`, `Quantiles`, `MadeBy` and
`marsyard.reports.scatter.Scatter`. `marsyard.reports.papers.PaperFacts` is a section of its own. `docs/reports.md` has
an example.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from marsyard.reports.charts import RateLine, cumulative_figure, rate_figure, stacked_bars
from marsyard.reports.columns import label, numbers
from marsyard.reports.rates import (
    CONFIDENCE,
    PooledRate,
    Share,
    by_size,
    flag,
    interval_text,
    known,
    pooled_rate,
    rate_text,
    share_of,
    share_text,
    varies,
)
from marsyard.reports.section import Block, Grid, Section, Subject, plate
from marsyard.reports.tables import error_summaries, statistics_grid
from marsyard.reports.wording import NOTHING, number, percent, stated

Rows = pd.DataFrame
Drawn = tuple[Sequence[Block], Mapping[str, Any]]
RateOf = Callable[[Rows], Share | PooledRate]
#: Bins of a condition, each with as many cases as the others, and the fewest cases of one.
_BINS, _FEWEST_IN_BIN = 5, 4
#: Values of a condition that are shown one by one, at most.
_MOST_VALUES = 24


@runtime_checkable
class Part(Protocol):
    """A part of a declared section."""

    def draw(self, frame: Rows, subject: Subject, key: str) -> Drawn:
        """Blocks of the page and their numbers; `key` is for identifiers of figures. No blocks: nothing to show."""


@dataclass(frozen=True)
class SectionDeclaration:
    """A section declared by its parts; call it with a `Subject` to make the section.

    Attributes
    ----------
    key, name, title
        As of `marsyard.reports.section.Section`.
    parts
        What it shows, in order.
    requires
        Columns without which there is no section: each must be there and have a value.
    rows
        The rows that it is about, chosen or extended; None for no section.
    note
        What a reader must know of all of it.
    """

    key: str
    name: str
    title: str
    parts: Sequence[Part]
    requires: Sequence[str] = ()
    rows: Callable[[Subject], Rows | None] = lambda subject: subject.frame
    note: str = ""

    def __call__(self, subject: Subject) -> Section | None:
        """The section; None where the rows lack what it requires, or no part has anything to show."""
        frame = self.rows(subject)
        if frame is None or any(name not in frame or frame[name].isna().all() for name in self.requires):
            return None
        blocks: list[Block] = []
        data: dict[str, Any] = {}
        for place, part in enumerate(self.parts):
            shown, values = part.draw(frame, subject, f"{self.key.replace('-', '')}{place}")
            blocks += shown
            data |= values
        if not blocks:
            return None
        return Section(
            self.key, self.name, self.title, [*blocks, *([Block(note=self.note)] if self.note else [])], data
        )


@dataclass(frozen=True)
class MadeBy:
    """A part that a function makes."""

    function: Callable[[Rows, Subject, str], Drawn]

    def draw(self, frame: Rows, subject: Subject, key: str) -> Drawn:
        """What the function makes."""
        return self.function(frame, subject, key)


@dataclass(frozen=True)
class Quantity:
    """A column of numbers: its name for readers (by default its own in words), and what it is multiplied by."""

    column: str
    name: str = ""
    scale: float = 1.0

    @property
    def title(self) -> str:
        """The name for readers."""
        return self.name or label(self.column)

    def values(self, frame: Rows) -> Float[np.ndarray, " n"]:
        """The column's numbers; NaN where there are none."""
        return np.asarray(self.scale * numbers(frame, self.column))


def flagged(name: str, *among: str, wanted: bool = True) -> RateOf:
    """The share of rows whose flag is as wanted, among those that have all of the other flags."""

    def rate(frame: Rows) -> Share:
        chosen = frame[np.logical_and.reduce([np.ones(len(frame), dtype=bool), *(flag(frame, one) for one in among)])]
        return share_of(flag(chosen, name) == wanted, chosen)

    return rate


def pooled(hits: str, of: str) -> RateOf:
    """The share of one column of counts in another, pooled over the rows."""
    return lambda frame: pooled_rate(frame, hits, of)


@dataclass(frozen=True)
class Rate:
    """A rate of rows: its key in `report.json`, its name for readers, how it is found, and whether figures draw it."""

    key: str
    name: str
    of: RateOf
    drawn: bool = True


@dataclass(frozen=True)
class RateTable:
    """A table of rates with their intervals; `rates` may also be made from the rows.

    `shared` says whether the intervals allow for cases that share terrains.
    """

    rates: Sequence[Rate] | Callable[[Rows], Mapping[str, Share]]
    cases: str = "Cases"
    heading: str = ""
    note: str = ""
    data: str = "rates"
    shared: bool = True

    def draw(self, frame: Rows, subject: Subject, key: str) -> Drawn:
        """The rates that have cases."""
        del subject, key
        rates = self.rates(frame) if callable(self.rates) else {one.name: one.of(frame) for one in self.rates}
        rows = [
            [name, share_text(one), interval_text(one, shared=self.shared)]
            for name, one in rates.items()
            if isinstance(one, Share) and one.n
        ]
        grid = Grid(["", self.cases, f"{stated(CONFIDENCE)} interval"], rows)
        blocks = [Block(heading=self.heading, grid=grid, note=self.note)] if rows else []
        return blocks, {self.data: {name: asdict(one) for name, one in rates.items()}}


@dataclass(frozen=True)
class RateByCondition:
    """Rates against a condition, as a table and as curves.

    Attributes
    ----------
    by
        The condition: its values where they are few, else bins of as many cases each.
    rates
        The rates; table columns and, where drawn, curves.
    cases, ylabel, text, note, caption
        Words for the table's cases, the figure's axis, the text above, the note below, and the figure's caption.
    limit
        A vertical line: its name, and its place found from the campaign.
    data
        Name of the list in `report.json`.
    """

    by: Quantity
    rates: Sequence[Rate]
    cases: str = "Cases"
    ylabel: str = "share of cases"
    text: str = ""
    note: str = ""
    caption: str = ""
    limit: tuple[str, Callable[[Subject], float]] | None = None
    data: str = "by_condition"

    def draw(self, frame: Rows, subject: Subject, key: str) -> Drawn:
        """The table and the curves; nothing where the condition does not vary."""
        if not varies(frame, self.by.column):
            return [], {}
        values = self.by.values(frame)
        records = []
        for chosen in condition_bins(values, _MOST_VALUES):
            rates = {one.key: one.of(frame[chosen]) for one in self.rates}
            records.append((float(np.median(values[chosen])), int(chosen.sum()), rates))
        limit = None if self.limit is None else (self.limit[0], self.limit[1](subject))
        x = [value for value, _, _ in records]
        lines = [RateLine(one.name.lower(), x, [r[one.key] for _, _, r in records]) for one in self.rates if one.drawn]
        figure = rate_figure(lines, (self.by.title, self.ylabel), limit)
        rows = [[f"{x:.4g}", f"{n:,}", *(_any_rate_text(one) for one in rates.values())] for x, n, rates in records]
        grid = Grid([self.by.title, self.cases, *(one.name for one in self.rates)], rows)
        data: dict[str, Any] = {
            self.data: [
                {self.by.column: x, "n": n, **{k: asdict(r) for k, r in rates.items()}} for x, n, rates in records
            ]
        }
        if limit is not None:
            data["limit"] = limit[1]
        block = Block(text=self.text, plates=[plate(figure, key, self.caption or self.by.title)])
        return [block, Block(grid=grid, note=self.note)], data


def _any_rate_text(one: Share | PooledRate) -> str:
    return share_text(one) if isinstance(one, Share) else rate_text(one)


def condition_bins(values: Float[np.ndarray, " n"], most_values: int = _BINS) -> list[Bool[np.ndarray, " n"]]:
    """Masks of each value where there are few, else of bins with as many cases each; without a value: in none."""
    finite = np.isfinite(values)
    kinds = np.unique(values[finite])
    if kinds.size <= most_values:
        return [values == kind for kind in kinds]
    bins = max(1, min(_BINS, int(finite.sum()) // _FEWEST_IN_BIN))
    ranks = np.full(values.size, -1)
    ranks[finite] = np.argsort(np.argsort(values[finite], kind="stable"), kind="stable") * bins // int(finite.sum())
    return [ranks == k for k in range(bins)]


@dataclass(frozen=True)
class OutcomesBySize:
    """What became of cases, by a kind and its size (a fault and its severity): a table and stacked bars.

    Attributes
    ----------
    outcomes
        Which rows ended in which way, by a key of `report.json`, in the order of the bars; the last is the harm, whose
        share has an interval.
    styles
        Of the outcomes: a name for readers and a style of `marsyard.reports.charts.BARS`.
    cases
        What the rows are called.
    wording
        The kind and the size in words; the size is empty where there is none.
    further
        Further columns: a heading, a key of `report.json`, a value of the rows, and its text.
    """

    outcomes: Callable[[Rows, Subject], Mapping[str, Bool[np.ndarray, " n"]]]
    styles: Mapping[str, tuple[str, str]]
    cases: str
    wording: Callable[[str, float], tuple[str, str]]
    further: Sequence[tuple[str, str, Callable[[Rows], Any], Callable[[Any], str]]] = ()
    kind: str = "fault"
    size: str = "fault_size"
    none: str = "none"
    note: str = ""
    caption: str = ""

    def records(self, frame: Rows, subject: Subject) -> list[dict[str, Any]]:
        """Counts of each kind and size, those without a fault first."""
        records = []
        for kind, size, chosen in by_size(frame, self.kind, self.size, self.none):
            ended = self.outcomes(chosen, subject)
            worst = share_of(ended[[*self.styles][-1]], chosen)
            counts = {name: int(mask.sum()) for name, mask in ended.items()}
            values = {name: value(chosen) for _, name, value, _ in self.further}
            key = f"{[*self.styles][-1]}_share"
            records.append({self.kind: kind, "size": size, "n": len(chosen), **counts, key: worst, **values})
        return records

    def draw(self, frame: Rows, subject: Subject, key: str) -> Drawn:
        """The table and the bars; nothing where no row has a fault."""
        if self.kind not in frame:
            return [], {}
        records = self.records(frame, subject)
        if all(one[self.kind] == self.none for one in records):
            return [], {}
        words = [self.wording(one[self.kind], one["size"]) for one in records]
        worst = [*self.styles][-1]
        head = ["Fault", "Size", self.cases, *(name.capitalize() for name, _ in self.styles.values())]
        head += [f"{self.styles[worst][0].capitalize()}, interval", *(heading for heading, *_ in self.further)]
        rows = [
            [
                *(name, size or NOTHING, f"{one['n']:,}"),
                *(f"{one[kind]:,} ({percent(one[kind] / one['n'])})" for kind in self.styles),
                interval_text(one[f"{worst}_share"]),
                *(text(one[name]) for _, name, _, text in self.further),
            ]
            for one, (name, size) in zip(records, words, strict=True)
        ]
        shares = {
            name: (style, [100.0 * one[kind] / one["n"] for one in records])
            for kind, (name, style) in self.styles.items()
        }
        figure = stacked_bars([" ".join(pair).strip() for pair in words], shares, f"% of {self.cases.lower()}")
        caption = self.caption or " ".join(f"{style.capitalize()}: {name}." for name, style in self.styles.values())
        data = [{**one, f"{worst}_share": asdict(one[f"{worst}_share"])} for one in records]
        return [Block(plates=[plate(figure, key, caption)]), Block(grid=Grid(head, rows), note=self.note)], {
            "rows": data
        }


@dataclass(frozen=True)
class Distribution:
    """Cumulative curves: the share of cases up to each value, or from each value on.

    Attributes
    ----------
    curves
        Quantities by the curve's name; or a function of the rows that gives values by name.
    labels
        Of the axes.
    falling, bound, limits
        As of `marsyard.reports.charts.cumulative_figure`.
    """

    curves: Sequence[Quantity] | Callable[[Rows], Mapping[str, Float[np.ndarray, " n"]]]
    labels: tuple[str, str]
    caption: str
    heading: str = ""
    falling: bool = False
    bound: float | None = None
    limits: Mapping[str, Sequence[float]] = field(default_factory=dict)
    table: Callable[[Mapping[str, Float[np.ndarray, " n"]]], Grid] | None = None

    def draw(self, frame: Rows, subject: Subject, key: str) -> Drawn:
        """The curves, with their table where there is one; nothing where no curve has a value."""
        del subject
        if callable(self.curves):
            curves = self.curves(frame)
        else:
            curves = {one.title: known(frame, one.column, one.scale) for one in self.curves}
        if not any(values.size for values in curves.values()):
            return [], {}
        figure = cumulative_figure(curves, self.labels, falling=self.falling, bound=self.bound, limits=self.limits)
        grid = None if self.table is None else self.table(curves)
        return [Block(heading=self.heading, plates=[plate(figure, key, self.caption)], grid=grid)], {}


@dataclass(frozen=True)
class Statistics:
    """Mean, spread and quantiles of a column and of its signed parts, with intervals."""

    column: str
    heading: str = ""

    def draw(self, frame: Rows, subject: Subject, key: str) -> Drawn:
        """The table."""
        del subject, key
        data = {name: asdict(one) for name, one in error_summaries(frame, self.column)}
        return [Block(heading=self.heading, grid=statistics_grid(frame, self.column))], data


@dataclass(frozen=True)
class Quantiles:
    """Quantiles of quantities, a row each; `columns` has a heading for each probability."""

    quantities: Sequence[Quantity]
    columns: Mapping[str, float]
    heading: str = ""
    note: str = ""
    data: str = ""

    def draw(self, frame: Rows, subject: Subject, key: str) -> Drawn:
        """The quantities that the rows have; nothing where there is none."""
        del subject, key
        rows = []
        for one in self.quantities:
            values = known(frame, one.column, one.scale)
            if values.size:
                rows.append([one.title, *(number(float(q)) for q in np.quantile(values, [*self.columns.values()]))])
        block = Block(heading=self.heading, grid=Grid(["", *self.columns], rows), note=self.note)
        return ([block], {self.data: len(frame)} if self.data else {}) if rows else ([], {})
