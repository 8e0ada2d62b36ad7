"""Declared report sections: a `SectionDeclaration` consists of parts, which create tables, figures and their numbers.

Parts: `RateTable`, `RateByCondition`, `OutcomesBySize`, `Distribution`, `Statistics`, `Quantiles`, `Scatter`, and
`CustomBlocks`. `marsyard.reports.papers.PaperFacts` is a separate section. `docs/reports.md` contains an example.
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
from marsyard.reports.rates import CONFIDENCE, CaseFraction, PooledRate, finite_values, varies
from marsyard.reports.section import Block, Grid, Section, Subject, svg_figure
from marsyard.reports.statistics.drivers import MIN_CASES, estimate_driver
from marsyard.reports.tables import error_summaries, statistics_grid
from marsyard.reports.wording import NOTHING, coefficient, format_fraction, label, number, numbers, percent

Rows = pd.DataFrame
BlocksAndData = tuple[Sequence[Block], Mapping[str, Any]]
#: Function that computes a rate of rows.
RateFunction = Callable[[Rows], CaseFraction | PooledRate]
#: Maximum number of bins of a condition (bins have equal numbers of cases), and minimum number of cases of a bin.
_MAX_BINS, _MIN_CASES_IN_BIN = 5, 4
#: Maximum number of values of a condition with a row each.
_MAX_VALUES = 24


@runtime_checkable
class Part(Protocol):
    """A part of a declared section."""

    def draw(self, frame: Rows, subject: Subject, key: str) -> BlocksAndData:
        """Create the blocks of the page and the data for `report.json`; `key` is the prefix of figure identifiers."""


@dataclass(frozen=True)
class SectionDeclaration:
    """A section declared by its parts; call it with a `Subject` to create the section.

    - requires: columns that must exist and contain a value
    - rows: function that selects or extends the rows of the section; it returns None for no section
    - note: text below all parts
    """

    key: str
    name: str
    title: str
    parts: Sequence[Part]
    requires: Sequence[str] = ()
    rows: Callable[[Subject], Rows | None] = lambda subject: subject.frame
    note: str = ""

    def __call__(self, subject: Subject) -> Section | None:
        """Create the section; None if required columns are missing or no part has blocks."""
        frame = self.rows(subject)
        if frame is None or any(name not in frame or frame[name].isna().all() for name in self.requires):
            return None
        blocks: list[Block] = []
        data: dict[str, Any] = {}
        for index, part in enumerate(self.parts):
            part_blocks, values = part.draw(frame, subject, f"{self.key.replace('-', '')}{index}")
            blocks += part_blocks
            data |= values
        if not blocks:
            return None
        blocks += [Block(note=self.note)] if self.note else []
        return Section(self.key, self.name, self.title, blocks, data)


@dataclass(frozen=True)
class CustomBlocks:
    """A part whose blocks are created by a function."""

    function: Callable[[Rows, Subject, str], BlocksAndData]

    def draw(self, frame: Rows, subject: Subject, key: str) -> BlocksAndData:
        """Create the blocks by the function."""
        return self.function(frame, subject, key)


@dataclass(frozen=True)
class Quantity:
    """A column of numbers with its name on the page (default: the column in words) and a scale."""

    column: str
    name: str = ""
    scale: float = 1.0

    @property
    def title(self) -> str:
        """The name on the page."""
        return self.name or label(self.column)

    def values(self, frame: Rows) -> Float[np.ndarray, " n"]:
        """The scaled numbers; NaN if missing."""
        return np.asarray(self.scale * numbers(frame, self.column))


def flag_rate(name: str, *conditions: str, value: bool = True) -> RateFunction:
    """Return a function that computes how often flag `name` equals `value`, in the rows with all flags `conditions`."""

    def compute_rate(frame: Rows) -> CaseFraction:
        all_rows = np.ones(len(frame), dtype=np.bool_)
        masks = (rates.flag_mask(frame, condition) for condition in conditions)
        selected_rows = frame[np.logical_and.reduce([all_rows, *masks])]
        return rates.fraction_of(rates.flag_mask(selected_rows, name) == value, selected_rows)

    return compute_rate


def pooled_fraction(numerator: str, denominator: str) -> RateFunction:
    """Return a function that divides the sum of one column of counts by that of another, over all rows."""
    return lambda frame: rates.pooled_rate(frame, numerator, denominator)


@dataclass(frozen=True)
class Rate:
    """A rate: key in `report.json`, name on the page, function that computes it, and whether figures show it."""

    key: str
    name: str
    compute: RateFunction
    in_figure: bool = True


@dataclass(frozen=True)
class RateTable:
    """A table of rates with their intervals.

    - rates: declared rates, or a function that computes rates by name from the rows
    - shared: whether the intervals allow for cases on shared terrains
    - data: key of the rates in `report.json`
    """

    rates: Sequence[Rate] | Callable[[Rows], Mapping[str, CaseFraction]]
    cases: str = "Cases"
    heading: str = ""
    note: str = ""
    data: str = "rates"
    shared: bool = True

    def draw(self, frame: Rows, subject: Subject, key: str) -> BlocksAndData:
        """Create a table of the rates that have cases."""
        rates_by_name = (
            self.rates(frame) if callable(self.rates) else {rate.name: rate.compute(frame) for rate in self.rates}
        )
        rows = []
        for name, rate in rates_by_name.items():
            if isinstance(rate, CaseFraction) and rate.n:
                rows.append([name, rates.fraction_text(rate), rates.interval_text(rate, shared=self.shared)])
            elif isinstance(rate, rates.PooledRate) and rate.total:
                fraction = f"{rate.hits:,} of {rate.total:,}: {percent(rate.fraction)}"
                rows.append([name, fraction, rates.range_text(rate.lower, rate.upper)])
        grid = Grid(["", self.cases, f"{format_fraction(CONFIDENCE)} interval"], rows)
        blocks = [Block(heading=self.heading, grid=grid, note=self.note)] if rows else []
        return blocks, {self.data: {name: asdict(rate) for name, rate in rates_by_name.items()}}


@dataclass(frozen=True)
class RateByCondition:
    """Rates against a condition, as a table and as curves.

    - by: the condition; each value has a row, or each bin with an equal number of cases if there are many values
    - cases, ylabel: heading of the number of cases in the table, and label of the figure's vertical axis
    - limit: name of a vertical line, and function that returns its position for a campaign
    - data: key of the list in `report.json`
    """

    by: Quantity
    rates: Sequence[Rate]
    cases: str = "Cases"
    ylabel: str = "fraction of cases"
    text: str = ""
    note: str = ""
    caption: str = ""
    limit: tuple[str, Callable[[Subject], float]] | None = None
    data: str = "by_condition"

    def draw(self, frame: Rows, subject: Subject, key: str) -> BlocksAndData:
        """Create the table and the curves; nothing if the condition does not vary."""
        if not varies(frame, self.by.column):
            return [], {}
        values = self.by.values(frame)
        records = []
        for mask in condition_bins(values, _MAX_VALUES):
            bin_rates = {rate.key: rate.compute(frame[mask]) for rate in self.rates}
            records.append((float(np.median(values[mask])), int(mask.sum()), bin_rates))
        limit = None if self.limit is None else (self.limit[0], self.limit[1](subject))
        x = [value for value, _, _ in records]
        curves = [rate for rate in self.rates if rate.in_figure]
        lines = [RateLine(rate.name.lower(), x, [record[2][rate.key] for record in records]) for rate in curves]
        figure = rate_figure(lines, (self.by.title, self.ylabel), limit)
        rows = []
        for value, n, bin_rates in records:
            texts = [
                rates.fraction_text(rate) if isinstance(rate, CaseFraction) else rates.rate_text(rate)
                for rate in bin_rates.values()
            ]
            rows.append([f"{value:.4g}", f"{n:,}", *texts])
        grid = Grid([self.by.title, self.cases, *(rate.name for rate in self.rates)], rows)
        bins = [({self.by.column: x, "n": n}, bin_rates) for x, n, bin_rates in records]
        data: dict[str, Any] = {
            self.data: [
                head | {rate_key: asdict(bin_rate) for rate_key, bin_rate in bin_rates.items()}
                for head, bin_rates in bins
            ]
        }
        if limit is not None:
            data["limit"] = limit[1]
        block = Block(text=self.text, figures=[svg_figure(figure, key, self.caption or self.by.title)])
        return [block, Block(grid=grid, note=self.note)], data


def condition_bins(values: Float[np.ndarray, " n"], max_values: int = _MAX_BINS) -> list[Bool[np.ndarray, " n"]]:
    """Create a mask for each value, or for bins with equal numbers of cases if there are many values, without NaN."""
    finite = np.isfinite(values)
    distinct = np.unique(values[finite])
    if distinct.size <= max_values:
        return [values == value for value in distinct]
    bins = max(1, min(_MAX_BINS, int(finite.sum()) // _MIN_CASES_IN_BIN))
    ranks = np.argsort(np.argsort(values[finite], kind="stable"), kind="stable")
    bin_numbers = np.full(values.size, -1)
    bin_numbers[finite] = ranks * bins // int(finite.sum())
    return [bin_numbers == index for index in range(bins)]


@dataclass(frozen=True)
class OutcomesBySize:
    """Outcomes of cases by type and size (severity) of their fault: a table and stacked bars.

    - outcomes: function that returns a mask of the rows for each outcome, by its key in `report.json`; the table shows
      a confidence interval for the last outcome
    - styles: for each outcome, its label and the style of its bars (`marsyard.reports.section.BARS`), in order
    - cases: heading of the number of rows
    - wording: function that returns fault type and size in words; an unknown size is empty
    - extra_columns: further columns of the table, each with its heading, its key in `report.json`, a function that
      computes its value from the rows, and a function that formats the value
    - kind, size: columns of the rows with fault type and size; none: fault type of cases without a fault
    """

    outcomes: Callable[[Rows, Subject], Mapping[str, Bool[np.ndarray, " n"]]]
    styles: Mapping[str, tuple[str, str]]
    cases: str
    wording: Callable[[str, float], tuple[str, str]]
    extra_columns: Sequence[tuple[str, str, Callable[[Rows], Any], Callable[[Any], str]]] = ()
    kind: str = "fault"
    size: str = "fault_size"
    none: str = "none"
    note: str = ""
    caption: str = ""

    def records(self, frame: Rows, subject: Subject) -> list[dict[str, Any]]:
        """Count the outcomes for each fault type and size; cases without a fault come first."""
        records = []
        for kind, size, rows in rates.group_by_size(frame, self.kind, self.size, self.none):
            masks = self.outcomes(rows, subject)
            last_outcome = [*self.styles][-1]
            last_fraction = rates.fraction_of(masks[last_outcome], rows)
            counts = {name: int(mask.sum()) for name, mask in masks.items()}
            values = {name: compute(rows) for _, name, compute, _ in self.extra_columns}
            head = {self.kind: kind, "size": size, "n": len(rows)}
            records.append({**head, **counts, f"{last_outcome}_fraction": last_fraction, **values})
        return records

    def draw(self, frame: Rows, subject: Subject, key: str) -> BlocksAndData:
        """Create the table and the bars; nothing if no row has a fault."""
        if self.kind not in frame:
            return [], {}
        records = self.records(frame, subject)
        if all(record[self.kind] == self.none for record in records):
            return [], {}
        texts = [self.wording(record[self.kind], record["size"]) for record in records]
        last = [*self.styles][-1]
        head = ["Fault", "Size", self.cases, *(name.capitalize() for name, _ in self.styles.values())]
        head += [f"{self.styles[last][0].capitalize()}, interval", *(heading for heading, *_ in self.extra_columns)]
        rows = [
            [
                *(name, size or NOTHING, f"{record['n']:,}"),
                *(f"{record[outcome]:,} ({percent(record[outcome] / record['n'])})" for outcome in self.styles),
                rates.interval_text(record[f"{last}_fraction"]),
                *(format_value(record[name]) for _, name, _, format_value in self.extra_columns),
            ]
            for record, (name, size) in zip(records, texts, strict=True)
        ]
        percentages = {
            name: (style, [100.0 * record[outcome] / record["n"] for record in records])
            for outcome, (name, style) in self.styles.items()
        }
        figure = stacked_bars([" ".join(pair).strip() for pair in texts], percentages, f"% of {self.cases.lower()}")
        caption = self.caption or " ".join(f"{style.capitalize()}: {name}." for name, style in self.styles.values())
        data = [{**record, f"{last}_fraction": asdict(record[f"{last}_fraction"])} for record in records]
        return [Block(figures=[svg_figure(figure, key, caption)]), Block(grid=Grid(head, rows), note=self.note)], {
            "rows": data
        }


@dataclass(frozen=True)
class Distribution:
    """Cumulative curves of quantities, or of values by name that a function computes (`figures.cumulative_figure`)."""

    curves: Sequence[Quantity] | Callable[[Rows], Mapping[str, Float[np.ndarray, " n"]]]
    labels: tuple[str, str]
    caption: str
    heading: str = ""
    complementary: bool = False
    bound: float | None = None
    limits: Mapping[str, Sequence[float]] = field(default_factory=dict)
    table: Callable[[Mapping[str, Float[np.ndarray, " n"]]], Grid] | None = None
    note: str = ""

    def draw(self, frame: Rows, subject: Subject, key: str) -> BlocksAndData:
        """Create the curves and their table; nothing if no curve has a value."""
        if callable(self.curves):
            curves = self.curves(frame)
        else:
            curves = {quantity.title: finite_values(frame, quantity.column, quantity.scale) for quantity in self.curves}
        if not any(values.size for values in curves.values()):
            return [], {}
        style: dict[str, Any] = {"complementary": self.complementary, "bound": self.bound, "limits": self.limits}
        figure = cumulative_figure(curves, self.labels, **style)
        grid = None if self.table is None else self.table(curves)
        return [
            Block(heading=self.heading, figures=[svg_figure(figure, key, self.caption)], grid=grid, note=self.note)
        ], {}


@dataclass(frozen=True)
class Statistics:
    """Mean, standard deviation and quantiles of an error and of its signed components (x and y), with intervals."""

    column: str
    heading: str = ""
    note: str = ""

    def draw(self, frame: Rows, subject: Subject, key: str) -> BlocksAndData:
        """Create the table."""
        data = {name: asdict(summary) for name, summary in error_summaries(frame, self.column)}
        return [Block(heading=self.heading, grid=statistics_grid(frame, self.column), note=self.note)], data


@dataclass(frozen=True)
class Quantiles:
    """Quantiles of quantities; `columns` maps headings to probabilities, `data` is the key of the number of rows."""

    quantities: Sequence[Quantity]
    columns: Mapping[str, float]
    heading: str = ""
    note: str = ""
    data: str = ""

    def draw(self, frame: Rows, subject: Subject, key: str) -> BlocksAndData:
        """Create a table of the quantities in the rows; nothing if there are none."""
        rows = []
        for quantity in self.quantities:
            values = finite_values(frame, quantity.column, quantity.scale)
            if values.size:
                quantiles = (rates.quantile(values, probability) for probability in self.columns.values())
                rows.append([quantity.title, *map(number, quantiles)])
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
        """Compute the effect of every condition that varies on every response.

        Keys: `driver`, `error`, Spearman's `rank_correlation` with its interval, `centres` and `medians` of the bins.
        """
        effects, groups = [], rates.terrain_groups(frame)
        for condition in (condition for condition in self.x if varies(frame, condition.column)):
            for response in self.y:
                x, y = condition.values(frame), response.values(frame)
                bins = condition_bins(np.where(np.isfinite(y), x, np.nan))
                centres, medians = ([float(np.median(values[mask])) for mask in bins] for values in (x, y))
                ranks = estimate_driver(x, y, groups, CONFIDENCE)
                rank_values = (math.nan,) * 3 if ranks is None else (ranks.correlation, ranks.lower, ranks.upper)
                effect: dict[str, Any] = {"driver": condition.title, "error": response.title}
                effect |= zip(("rank_correlation", "lower", "upper"), rank_values, strict=True)
                effects.append(effect | {"centres": centres, "medians": medians})
        return effects

    def draw(self, frame: Rows, subject: Subject, key: str) -> BlocksAndData:
        """Create the panels and the rank correlations; nothing if no condition varies."""
        effects = self.effects(frame)
        if not effects:
            return [], {}
        columns = {quantity.title: quantity.values(frame) for quantity in (*self.x, *self.y)}
        panels = {
            (effect["driver"], effect["error"]): (
                (columns[effect["driver"]], columns[effect["error"]]),
                (effect["centres"], effect["medians"]),
            )
            for effect in effects
        }
        texts_by_condition: dict[str, list[str]] = {}
        for effect in effects:
            texts_by_condition.setdefault(effect["driver"], []).append(correlation_text(effect))
        head = ["Rank correlation", *(response.title for response in self.y)]
        grid = Grid(head, [[name, *cells] for name, cells in texts_by_condition.items()])
        figure = scatter_panels(panels, logarithmic=self.logarithmic)
        confidence_text = f"The intervals are at {format_fraction(CONFIDENCE)} confidence."
        note = f"{confidence_text} A dash means that there are fewer than {MIN_CASES} cases or only one value."
        svg_figures = [svg_figure(figure, key, self.caption, wide=len(effects) > 1)]
        return [Block(heading=self.heading, figures=svg_figures, grid=grid, note=note)], {"effects": effects}


def correlation_text(effect: Mapping[str, Any]) -> str:
    """Format a rank correlation with its interval; a dash for NaN."""
    value, lower, upper = (coefficient(effect[key]) for key in ("rank_correlation", "lower", "upper"))
    return NOTHING if math.isnan(effect["rank_correlation"]) else f"{value} ({lower} to {upper})"
