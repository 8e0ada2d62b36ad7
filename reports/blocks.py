"""Blocks of report sections, created from rows: rates, distributions, and quantiles.

A section is a function from rows to blocks (`marsyard.reports.section.create_section`). `docs/reports.md` contains an
example. The argument `key` of these functions is the identifier of the figure on the page.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from marsyard.reports import populations, rates
from marsyard.reports.column_values import numbers
from marsyard.reports.plots import RateLine, cumulative_figure, rate_figure
from marsyard.reports.rates import CONFIDENCE, CaseFraction, PooledRate, finite_values, varies
from marsyard.reports.section import Block, Grid, svg_figure
from marsyard.reports.wording import format_fraction, label, number, percent

#: Function that computes a rate of rows.
RateFunction = Callable[[pd.DataFrame], CaseFraction | PooledRate]
#: Maximum number of bins of a condition (bins have equal numbers of cases), and minimum number of cases of a bin.
_MAX_BINS, _MIN_CASES_IN_BIN = 5, 4
#: Maximum number of values of a condition with a row each.
_MAX_VALUES = 24


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

    def values(self, frame: pd.DataFrame) -> Float[np.ndarray, " n"]:
        """The scaled numbers; NaN if missing."""
        return np.asarray(self.scale * numbers(frame, self.column))


def collect_values(frame: pd.DataFrame, quantities: Sequence[Quantity]) -> dict[str, Float[np.ndarray, " n"]]:
    """Collect the finite values of quantities by title."""
    return {quantity.title: finite_values(frame, quantity.column, quantity.scale) for quantity in quantities}


def flag_rate(name: str, *conditions: str) -> RateFunction:
    """Return a function that computes how often flag `name` is true, in the rows with all flags `conditions`."""

    def compute_rate(frame: pd.DataFrame) -> CaseFraction:
        all_rows = np.ones(len(frame), dtype=np.bool_)
        masks = (populations.flag_mask(frame, condition) for condition in conditions)
        selected_rows = frame[np.logical_and.reduce([all_rows, *masks])]
        return rates.fraction_of(populations.flag_mask(selected_rows, name), selected_rows)

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


def rate_block(
    rates_by_name: Mapping[str, CaseFraction | PooledRate], cases: str = "Cases", heading: str = "", note: str = "",
    data: str = "rates",
) -> Block | None:  # fmt: skip
    """Create a table of rates with intervals that allow for shared terrains; None if no rate has a case.

    data: key of the rates in `report.json`
    """
    rows = []
    for name, rate in rates_by_name.items():
        if isinstance(rate, CaseFraction) and rate.n:
            rows.append([name, rates.fraction_text(rate), rates.interval_text(rate, shared=True)])
        elif isinstance(rate, PooledRate) and rate.total:
            fraction = f"{rate.hits:,} of {rate.total:,}: {percent(rate.fraction)}"
            rows.append([name, fraction, rates.range_text(rate.lower, rate.upper)])
    grid = Grid(["", cases, f"{format_fraction(CONFIDENCE)} interval"], rows)
    return Block(heading=heading, grid=grid if rows else None, note=note if rows else "", data={data: rates_by_name})


def condition_blocks(
    frame: pd.DataFrame, key: str, by: Quantity, declared_rates: Sequence[Rate], cases: str = "Cases",
    ylabel: str = "fraction of cases", text: str = "", note: str = "", caption: str = "",
    limit: tuple[str, float] | None = None, data: str = "by_condition",
) -> list[Block]:  # fmt: skip
    """Create curves and a table of rates against a condition; empty if the condition does not vary.

    by: the condition; each value has a row, or each bin with an equal number of cases if there are many values
    cases, ylabel: heading of the number of cases in the table, and label of the figure's vertical axis
    limit: name and position of a vertical line
    data: key of the list in `report.json`
    """
    if not varies(frame, by.column):
        return []
    values = by.values(frame)
    bins = [
        (float(np.median(values[mask])), int(mask.sum()), [rate.compute(frame[mask]) for rate in declared_rates])
        for mask in condition_bins(values, _MAX_VALUES)
    ]
    x = [value for value, _, _ in bins]
    lines = [
        RateLine(rate.name.lower(), x, [bin_rates[index] for _, _, bin_rates in bins])
        for index, rate in enumerate(declared_rates)
        if rate.in_figure
    ]
    rows, records = [], []
    for value, n, bin_rates in bins:
        rows.append([f"{value:.4g}", f"{n:,}", *map(_describe_rate, bin_rates)])
        named_rates = zip(declared_rates, bin_rates, strict=True)
        records.append({by.column: value, "n": n} | {rate.key: result for rate, result in named_rates})
    grid = Grid([by.title, cases, *(rate.name for rate in declared_rates)], rows)
    figure = svg_figure(rate_figure(lines, (by.title, ylabel), limit), key, caption or by.title)
    values_of_block = {data: records} | ({} if limit is None else {"limit": limit[1]})
    return [Block(text=text, figures=[figure], data=values_of_block), Block(grid=grid, note=note)]


def _describe_rate(rate: CaseFraction | PooledRate) -> str:
    return rates.fraction_text(rate) if isinstance(rate, CaseFraction) else rates.rate_text(rate)


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


def distribution_block(
    key: str, curves: Mapping[str, Float[np.ndarray, " n"]], labels: tuple[str, str], caption: str, heading: str = "",
    *, complementary: bool = False, bound: float | None = None,
) -> Block | None:  # fmt: skip
    """Draw cumulative curves of values by name; None if no curve has a value."""
    if not any(values.size for values in curves.values()):
        return None
    figure = cumulative_figure(curves, labels, complementary=complementary, bound=bound)
    return Block(heading=heading, figures=[svg_figure(figure, key, caption)])


def quantile_block(
    frame: pd.DataFrame, quantities: Sequence[Quantity], columns: Mapping[str, float], heading: str = "", note: str = ""
) -> Block | None:
    """Create a table of quantiles; `columns` maps headings to probabilities. None if there are no values."""
    rows = [
        [name, *(number(rates.quantile(values, probability)) for probability in columns.values())]
        for name, values in collect_values(frame, quantities).items()
        if values.size
    ]
    return Block(heading=heading, grid=Grid(["", *columns], rows), note=note) if rows else None
