"""Kinds of report sections as data: a `SectionDeclaration` of parts, each of which draws blocks and their numbers.

Parts: `RateTable`, `RateByCondition`, `OutcomesBySize`, `Distribution`, `Statistics`, `Quantiles`, `Scatter`, `MadeBy`.
`marsyard.reports.papers.PaperFacts` is a section of its own. Example: `docs/reports.md`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from marsyard.reports import rates
from marsyard.reports.figures import RateLine, cumulative_figure, rate_figure, scatter_panels, stacked_bars
from marsyard.reports.rates import CONFIDENCE, PooledRate, Share, known, varies
from marsyard.reports.section import Block, Grid, Section, Subject, plate
from marsyard.reports.statistics.drivers import MIN_CASES, driver
from marsyard.reports.tables import error_summaries, statistics_grid
from marsyard.reports.wording import NOTHING, coefficient, format_fraction, label, number, numbers, percent

Rows = pd.DataFrame
Drawn = tuple[Sequence[Block], Mapping[str, Any]]
RateOf = Callable[[Rows], Share | PooledRate]
#: Number of bins of a condition with equally many cases, and the minimum number of cases of one.
_BINS, _MIN_IN_BIN = 5, 4
#: Maximum number of values of a condition that are shown one by one.
_MAX_VALUES = 24


@runtime_checkable
class Part(Protocol):
    """A part of a declared section."""

    def draw(self, frame: Rows, subject: Subject, key: str) -> Drawn:
        """Blocks of the page and their numbers; `key` prefixes identifiers of figures. No blocks: nothing to show."""


@dataclass(frozen=True)
class SectionDeclaration:
    """A section declared by its parts; call it with a `Subject` to make the section.

    requires: columns that must exist and have a value
    rows: rows of the section, chosen or extended; None for no section
    note: text below all parts
    """

    key: str
    name: str
    title: str
    parts: Sequence[Part]
    requires: Sequence[str] = ()
    rows: Callable[[Subject], Rows | None] = lambda subject: subject.frame
    note: str = ""

    def __call__(self, subject: Subject) -> Section | None:
        """The section; None if the rows lack required columns, or no part has blocks."""
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
        blocks += [Block(note=self.note)] if self.note else []
        return Section(self.key, self.name, self.title, blocks, data)


@dataclass(frozen=True)
class MadeBy:
    """A part that a function makes."""

    function: Callable[[Rows, Subject, str], Drawn]

    def draw(self, frame: Rows, subject: Subject, key: str) -> Drawn:
        """Call the function."""
        return self.function(frame, subject, key)


@dataclass(frozen=True)
class Quantity:
    """A column of numbers with its name for readers (by default the column in words) and a scale."""

    column: str
    name: str = ""
    scale: float = 1.0

    @property
    def title(self) -> str:
        """The name for readers."""
        return self.name or label(self.column)

    def values(self, frame: Rows) -> Float[np.ndarray, " n"]:
        """The scaled numbers; NaN if missing."""
        return np.asarray(self.scale * numbers(frame, self.column))


def flag_rate(name: str, *among: str, wanted: bool = True) -> RateOf:
    """Fraction of rows whose flag is as wanted, among the rows with all of the other flags."""

    def rate(frame: Rows) -> Share:
        every = np.ones(len(frame), dtype=np.bool_)
        chosen = frame[np.logical_and.reduce([every, *(rates.flag(frame, one) for one in among)])]
        return rates.fraction_of(rates.flag(chosen, name) == wanted, chosen)

    return rate


def pooled_fraction(hits: str, of: str) -> RateOf:
    """Fraction of one column of counts in another, pooled over the rows."""
    return lambda frame: rates.pooled_rate(frame, hits, of)


@dataclass(frozen=True)
class Rate:
    """A rate of rows: key in `report.json`, name for readers, function, and whether figures draw it."""

    key: str
    name: str
    of: RateOf
    drawn: bool = True


@dataclass(frozen=True)
class RateTable:
    """A table of rates with their intervals.

    rates: declared, or made from the rows
    shared: whether the intervals allow for cases that share terrains
    """

    rates: Sequence[Rate] | Callable[[Rows], Mapping[str, Share]]
    cases: str = "Cases"
    heading: str = ""
    note: str = ""
    data: str = "rates"
    shared: bool = True

    def draw(self, frame: Rows, subject: Subject, key: str) -> Drawn:
        """The rates that have cases."""
        rates_by_name = self.rates(frame) if callable(self.rates) else {one.name: one.of(frame) for one in self.rates}
        rows = [
            [name, rates.fraction_text(one), rates.interval_text(one, shared=self.shared)]
            for name, one in rates_by_name.items()
            if isinstance(one, Share) and one.n
        ]
        grid = Grid(["", self.cases, f"{format_fraction(CONFIDENCE)} interval"], rows)
        blocks = [Block(heading=self.heading, grid=grid, note=self.note)] if rows else []
        return blocks, {self.data: {name: asdict(one) for name, one in rates_by_name.items()}}


@dataclass(frozen=True)
class RateByCondition:
    """Rates against a condition, as a table and as curves.

    by: the condition: single values, or bins of equally many cases if it has many
    cases, ylabel, text, note, caption: heading of the table's cases, label of the figure's axis, and texts
    limit: name of a vertical line, and its position by campaign
    data: key of the list in `report.json`
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
        """The table and the curves; nothing if the condition does not vary."""
        if not varies(frame, self.by.column):
            return [], {}
        values = self.by.values(frame)
        records = []
        for chosen in condition_bins(values, _MAX_VALUES):
            of_bin = {one.key: one.of(frame[chosen]) for one in self.rates}
            records.append((float(np.median(values[chosen])), int(chosen.sum()), of_bin))
        limit = None if self.limit is None else (self.limit[0], self.limit[1](subject))
        x = [value for value, _, _ in records]
        lines = [RateLine(one.name.lower(), x, [r[one.key] for _, _, r in records]) for one in self.rates if one.drawn]
        figure = rate_figure(lines, (self.by.title, self.ylabel), limit)
        rows = []
        for value, n, of_bin in records:
            texts = [
                rates.fraction_text(one) if isinstance(one, Share) else rates.rate_text(one) for one in of_bin.values()
            ]
            rows.append([f"{value:.4g}", f"{n:,}", *texts])
        grid = Grid([self.by.title, self.cases, *(one.name for one in self.rates)], rows)
        data: dict[str, Any] = {
            self.data: [
                {self.by.column: x, "n": n, **{k: asdict(r) for k, r in of_bin.items()}} for x, n, of_bin in records
            ]
        }
        if limit is not None:
            data["limit"] = limit[1]
        block = Block(text=self.text, plates=[plate(figure, key, self.caption or self.by.title)])
        return [block, Block(grid=grid, note=self.note)], data


def condition_bins(values: Float[np.ndarray, " n"], max_values: int = _BINS) -> list[Bool[np.ndarray, " n"]]:
    """Masks of single values if they are few, else of bins of equally many cases; NaN is in none."""
    finite = np.isfinite(values)
    kinds = np.unique(values[finite])
    if kinds.size <= max_values:
        return [values == kind for kind in kinds]
    bins = max(1, min(_BINS, int(finite.sum()) // _MIN_IN_BIN))
    ranks = np.full(values.size, -1)
    ranks[finite] = np.argsort(np.argsort(values[finite], kind="stable"), kind="stable") * bins // int(finite.sum())
    return [ranks == k for k in range(bins)]


@dataclass(frozen=True)
class OutcomesBySize:
    """Outcomes of cases by a kind and its size (a fault and its severity): a table and stacked bars.

    outcomes: masks of the rows by key of `report.json`, in the order of the bars; the last has an interval
    styles: name for readers and style of `marsyard.reports.section.BARS` by outcome
    cases: heading of the rows
    wording: kind and size in words; no size is empty
    further: further columns: heading, key of `report.json`, value of the rows, and its text
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
        """Counts of each kind and size, cases without a fault first."""
        records = []
        for kind, size, chosen in rates.by_size(frame, self.kind, self.size, self.none):
            ended = self.outcomes(chosen, subject)
            worst = rates.fraction_of(ended[[*self.styles][-1]], chosen)
            counts = {name: int(mask.sum()) for name, mask in ended.items()}
            values = {name: value(chosen) for _, name, value, _ in self.further}
            key = f"{[*self.styles][-1]}_share"
            records.append({self.kind: kind, "size": size, "n": len(chosen), **counts, key: worst, **values})
        return records

    def draw(self, frame: Rows, subject: Subject, key: str) -> Drawn:
        """The table and the bars; nothing if no row has a fault."""
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
                rates.interval_text(one[f"{worst}_share"]),
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
    """Cumulative curves of quantities, or of values by name; see `marsyard.reports.figures.cumulative_figure`."""

    curves: Sequence[Quantity] | Callable[[Rows], Mapping[str, Float[np.ndarray, " n"]]]
    labels: tuple[str, str]
    caption: str
    heading: str = ""
    falling: bool = False
    bound: float | None = None
    limits: Mapping[str, Sequence[float]] = field(default_factory=dict)
    table: Callable[[Mapping[str, Float[np.ndarray, " n"]]], Grid] | None = None

    def draw(self, frame: Rows, subject: Subject, key: str) -> Drawn:
        """The curves and their table; nothing if no curve has a value."""
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
    """Mean, standard deviation and quantiles of a column and of its signed parts, with intervals."""

    column: str
    heading: str = ""

    def draw(self, frame: Rows, subject: Subject, key: str) -> Drawn:
        """The table."""
        data = {name: asdict(one) for name, one in error_summaries(frame, self.column)}
        return [Block(heading=self.heading, grid=statistics_grid(frame, self.column))], data


@dataclass(frozen=True)
class Quantiles:
    """Quantiles of quantities; `columns` maps headings to probabilities."""

    quantities: Sequence[Quantity]
    columns: Mapping[str, float]
    heading: str = ""
    note: str = ""
    data: str = ""

    def draw(self, frame: Rows, subject: Subject, key: str) -> Drawn:
        """The quantities that the rows hold; nothing if they hold none."""
        rows = []
        for one in self.quantities:
            values = known(frame, one.column, one.scale)
            if values.size:
                rows.append([one.title, *(number(float(q)) for q in np.quantile(values, [*self.columns.values()]))])
        block = Block(heading=self.heading, grid=Grid(["", *self.columns], rows), note=self.note)
        return ([block], {self.data: len(frame)} if self.data else {}) if rows else ([], {})


@dataclass(frozen=True)
class Scatter:
    """Responses against conditions that vary: points, medians of bins, and rank correlations."""

    x: Sequence[Quantity]
    y: Sequence[Quantity]
    caption: str
    heading: str = ""
    logarithmic: bool = False

    def effects(self, frame: Rows) -> list[dict[str, Any]]:
        """Effects of every condition that varies on every response.

        Keys: `driver`, `error`, Spearman's `rank_correlation` with its interval, `centres` and `medians` of the bins.
        """
        effects, groups = [], rates.terrain_groups(frame)
        for one in (one for one in self.x if varies(frame, one.column)):
            for response in self.y:
                x, y = one.values(frame), response.values(frame)
                bins = condition_bins(np.where(np.isfinite(y), x, np.nan))
                centres, medians = ([float(np.median(values[chosen])) for chosen in bins] for values in (x, y))
                ranks = driver(x, y, groups, CONFIDENCE)
                of_ranks = (math.nan,) * 3 if ranks is None else (ranks.correlation, ranks.lower, ranks.upper)
                effect: dict[str, Any] = {"driver": one.title, "error": response.title}
                effect |= zip(("rank_correlation", "lower", "upper"), of_ranks, strict=True)
                effects.append(effect | {"centres": centres, "medians": medians})
        return effects

    def draw(self, frame: Rows, subject: Subject, key: str) -> Drawn:
        """The panels and the rank correlations; nothing if no condition varies."""
        effects = self.effects(frame)
        if not effects:
            return [], {}
        columns = {one.title: one.values(frame) for one in (*self.x, *self.y)}
        panels = {
            (one["driver"], one["error"]): (
                (columns[one["driver"]], columns[one["error"]]),
                (one["centres"], one["medians"]),
            )
            for one in effects
        }
        texts: dict[str, list[str]] = {}
        for one in effects:
            texts.setdefault(one["driver"], []).append(correlation_text(one))
        head = ["Rank correlation", *(one.title for one in self.y)]
        grid = Grid(head, [[name, *cells] for name, cells in texts.items()])
        figure = scatter_panels(panels, logarithmic=self.logarithmic)
        note = (
            f"Intervals at {format_fraction(CONFIDENCE)} confidence; a dash below {MIN_CASES} cases or for constants."
        )
        plates = [plate(figure, key, self.caption, wide=len(effects) > 1)]
        return [Block(heading=self.heading, plates=plates, grid=grid, note=note)], {"effects": effects}


def correlation_text(effect: Mapping[str, Any]) -> str:
    """A rank correlation with its interval; a dash for NaN."""
    value, lower, upper = (coefficient(effect[key]) for key in ("rank_correlation", "lower", "upper"))
    return NOTHING if math.isnan(effect["rank_correlation"]) else f"{value} ({lower} to {upper})"
