"""Effects of conditions on results: correlation, and the figure that shows it."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
import pandas as pd

from marsyard.reports import rates
from marsyard.reports.blocks import Quantity, condition_bins
from marsyard.reports.plots import scatter_panels
from marsyard.reports.rates import CONFIDENCE, varies
from marsyard.reports.section import Block, Grid, svg_figure
from marsyard.reports.statistics.drivers import MIN_CASES, estimate_driver
from marsyard.reports.wording import NOTHING, coefficient, format_fraction


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
