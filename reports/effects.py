"""Effects of conditions on results: correlations and their figure, and drivers.

Drivers are conditions ranked by the fraction of the variance of errors and of failures that they explain.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

from marsyard.reports import populations, rates
from marsyard.reports.blocks import Quantity, condition_bins
from marsyard.reports.column_selection import condition_columns
from marsyard.reports.column_values import numbers
from marsyard.reports.plots import scatter_panels
from marsyard.reports.rates import CONFIDENCE, varies
from marsyard.reports.section import Block, Grid, Section, Subject, svg_figure
from marsyard.reports.statistics.difference_tests import correct_holm
from marsyard.reports.statistics.drivers import MIN_CASES, Driver, estimate_driver
from marsyard.reports.wording import NOTHING, coefficient, format_fraction, label, note_text, p_text, percent

#: Maximum number of conditions in a table, and of cases that are used for the ranking.
_MAX_DRIVERS, _MAX_DRIVER_CASES = 12, 20_000


@dataclass(frozen=True)
class Effect:
    """Effect of a condition on a response: their titles, Spearman's rank correlation with its interval, and bins.

    centres, medians: medians of the condition and of the response in each bin of the condition
    """

    condition: str
    response: str
    rank_correlation: float
    lower: float
    upper: float
    centres: list[float]
    medians: list[float]


def estimate_effects(frame: pd.DataFrame, x: Sequence[Quantity], y: Sequence[Quantity]) -> list[Effect]:
    """Compute the effect of every condition `x` that varies on every response `y`."""
    effects, groups = [], rates.terrain_groups(frame)
    for condition in x:
        if not varies(frame, condition.column):
            continue
        for response in y:
            conditions, responses = condition.values(frame), response.values(frame)
            bins = condition_bins(np.where(np.isfinite(responses), conditions, np.nan))
            centres, medians = ([float(np.median(values[mask])) for mask in bins] for values in (conditions, responses))
            ranks = estimate_driver(conditions, responses, groups, CONFIDENCE)
            rank_values = (math.nan,) * 3 if ranks is None else (ranks.correlation, ranks.lower, ranks.upper)
            effects.append(Effect(condition.title, response.title, *rank_values, centres, medians))
    return effects


def scatter_block(
    frame: pd.DataFrame, key: str, x: Sequence[Quantity], y: Sequence[Quantity], caption: str, heading: str = "",
    note: str = "", *, logarithmic: bool = False, statistics: bool = True,
) -> Block | None:  # fmt: skip
    """Draw responses `y` against the conditions `x` that vary; None if no condition varies.

    statistics: whether the block contains medians of bins, and rank correlations
    """
    effects = estimate_effects(frame, x, y)
    if not effects:
        return None
    columns = {quantity.title: quantity.values(frame) for quantity in (*x, *y)}
    panels = {
        (effect.condition, effect.response): (
            (columns[effect.condition], columns[effect.response]),
            (effect.centres, effect.medians) if statistics else ((), ()),
        )
        for effect in effects
    }
    texts_by_condition: dict[str, list[str]] = {}
    for effect in effects:
        texts_by_condition.setdefault(effect.condition, []).append(correlation_text(effect))
    head = ["Rank correlation", *(response.title for response in y)]
    grid = Grid(head, [[name, *cells] for name, cells in texts_by_condition.items()]) if statistics else None
    figure = svg_figure(scatter_panels(panels, logarithmic=logarithmic), key, caption, wide=len(effects) > 1)
    note = note or (
        f"The intervals are at {format_fraction(CONFIDENCE)} confidence. A dash means that there are fewer than "
        f"{MIN_CASES} cases or only one value."
    )
    return Block(
        heading=heading,
        figures=[figure],
        grid=grid,
        note=note,
        data={"effects": [asdict(effect) for effect in effects]},
    )


def correlation_text(effect: Effect) -> str:
    """Format a rank correlation with its interval; a dash for NaN."""
    value, lower, upper = map(coefficient, (effect.rank_correlation, effect.lower, effect.upper))
    return NOTHING if math.isnan(effect.rank_correlation) else f"{value} ({lower} to {upper})"


class RankedDriver(NamedTuple):
    """A condition (a column of the rows) with its effect, and the p-value corrected for the number of conditions."""

    column: str
    driver: Driver
    p_value: float


def drivers_section(subject: Subject) -> Section | None:
    """Create the section with the ranked drivers of errors and of failures; None without drivers."""
    metric = subject.metric
    if metric is None:
        return None
    frame = subject.frame.head(_MAX_DRIVER_CASES)
    responses = {"the size of errors": np.abs(numbers(frame, metric))}
    if subject.bound is not None:
        responses["failures"] = (~populations.success_mask(frame, metric, subject.bound)).astype(np.float64)
    columns = condition_columns(frame, metric, subject.run.is_condition)
    ranked_drivers = {
        name: drivers for name, response in responses.items() if (drivers := rank_drivers(frame, columns, response))
    }
    if not ranked_drivers:
        return None
    note = note_text("common.drivers", confidence=format_fraction(CONFIDENCE))
    headings = ["Condition", "Cases", "Rank correlation", "Interval of the correlation"]
    headings += ["Fraction of variance", "Interval of the fraction", "p"]
    blocks = []
    for name, drivers in ranked_drivers.items():
        rows = []
        for column, driver, p_value in drivers[:_MAX_DRIVERS]:
            ranks = [coefficient(driver.correlation), f"{coefficient(driver.lower)} to {coefficient(driver.upper)}"]
            fractions = [percent(driver.fraction), rates.range_text(driver.fraction_lower, driver.fraction_upper)]
            rows.append([label(column), f"{driver.n:,}", *ranks, *fractions, p_text(p_value)])
        blocks.append(Block(heading=f"Drivers of {name}", grid=Grid(headings, rows, len(drivers) - len(rows))))
    data = {
        name: [{"condition": column, **asdict(driver), "corrected_p": p_value} for column, driver, p_value in drivers]
        for name, drivers in ranked_drivers.items()
    }
    title = "Influence of conditions on errors and failures"
    return Section("explained", "Influences", title, [*blocks, Block(note=note)], data)


def rank_drivers(frame: pd.DataFrame, columns: Sequence[str], response: Float[np.ndarray, " n"]) -> list[RankedDriver]:
    """Rank columns by the fraction of a response's variance that they explain, largest first; correct the p-values."""
    groups = rates.terrain_groups(frame)
    drivers: Mapping[str, Driver] = {
        column: driver
        for column in columns
        if (driver := estimate_driver(numbers(frame, column), response, groups, CONFIDENCE)) is not None
    }
    p_values = dict(zip(drivers, correct_holm([driver.p_value for driver in drivers.values()]), strict=True))
    order = sorted(drivers, key=lambda column: (-drivers[column].fraction, column))
    return [RankedDriver(column, drivers[column], p_values[column]) for column in order]
