"""Section on the effect of each condition on the velocity error.

The paper is Johnson et al., "Field Testing of the MER DIMES".
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy import stats

from marsyard.reports import rates
from marsyard.reports.column_values import numbers
from marsyard.reports.figure_style import MUTED, SERIES, in_page_style, new_axes
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Block, Grid, Section, Subject, svg_figure
from marsyard.reports.wording import format_fraction, label, magnitude_label, note_text, number
from marsyard.scenarios.columns import split_unit

#: Conditions that the paper compares (all of them must vary), and additional conditions.
PAPER_CONDITIONS = ("descent_rate_m_s", "altitude_1_m", "attitude_rate_max_deg_s")
ADDITIONAL_CONDITIONS = ("off_nadir_max_deg", "horizontal_speed_m_s", "sun_elevation_deg")
#: Minimum number of errors for the section.
MIN_CASES = 50
#: Fixed seed of the bootstrap, for reproducible reports.
_SEED = 20050815


@dataclass(frozen=True)
class ConditionEffect:
    """Effect of one condition on the magnitude of the error; each tuple contains an estimate and its two bounds.

    - low, high: 5 % and 95 % quantile of the condition
    - rank_correlation: Spearman's rank correlation of condition and magnitude
    - coefficient: coefficient of a regression on all conditions, in standard deviations of condition and magnitude
    - effect: change of the mean magnitude from `low` to `high` in that regression, in the error's unit
    """

    column: str
    low: float
    high: float
    rank_correlation: tuple[float, float, float]
    coefficient: tuple[float, float, float]
    effect: tuple[float, float, float]


def sensitivity_section(subject: Subject) -> Section | None:
    """Create the section on rank correlations and a standardised regression of the error on all conditions.

    None for too few errors, or if the paper's conditions do not vary. Paper (section III.C): "vertical velocity of the
    lander had much less of an effect on DIMES performance when compared to altitude and attitude rates".
    """
    metric = subject.metric
    effects = [] if metric is None else estimate_effects(subject, metric)
    if metric is None or not effects:
        return None
    unit = split_unit(metric)[1]
    change_text = f"Change of the mean {magnitude_label(metric)} from the 5 % to the 95 % quantile of each condition."
    caption = f"{change_text} Dots: estimates. Bars: {format_fraction(CONFIDENCE)} intervals."
    effect_svg = svg_figure(effect_figure(effects, unit), "sensitivity", caption)
    note = note_text("dimes.sensitivity", metric=magnitude_label(metric), confidence=format_fraction(CONFIDENCE))
    rows = [
        [label(effect.column), f"{number(effect.low)} to {number(effect.high)}"]
        + [
            "{} ({} to {})".format(*map(number, value))
            for value in (effect.rank_correlation, effect.coefficient, effect.effect)
        ]
        for effect in effects
    ]
    head = ["", "5 % to 95 % quantile", "Rank correlation", "Standardised coefficient", f"Effect ({unit})"]
    blocks = [Block(figures=[effect_svg]), Block(grid=Grid(head, rows), note=note)]
    return Section(
        "sensitivity", "Sensitivity", "Sensitivity of the error to the conditions", blocks, {"drivers": effects}
    )


def estimate_effects(subject: Subject, metric: str) -> list[ConditionEffect]:
    """Estimate the effects of the conditions; empty if one of the paper's is constant, or for too few errors."""
    frame = subject.frame
    magnitude = np.abs(numbers(frame, metric))
    columns = [name for name in (*PAPER_CONDITIONS, *ADDITIONAL_CONDITIONS) if rates.varies(frame, name)]
    conditions = np.column_stack([numbers(frame, name) for name in columns]) if columns else np.zeros((len(frame), 0))
    finite = np.isfinite(magnitude) & np.isfinite(conditions).all(axis=1)
    if not set(PAPER_CONDITIONS) <= set(columns) or finite.sum() < MIN_CASES:
        return []
    x, y = conditions[finite], magnitude[finite]
    if np.ptp(y) == 0.0 or (np.ptp(x, axis=0) == 0.0).any():
        return []
    groups = rates.terrain_groups(frame[finite])
    weights = rates.bootstrap_weights(np.arange(y.size) if groups is None else groups, np.random.default_rng(_SEED))
    low, high = np.quantile(x, (0.05, 0.95), axis=0)
    slopes = regress_weighted(x / x.std(axis=0), y, weights)
    ranks = correlate_weighted(stats.rankdata(x, axis=0), stats.rankdata(y), weights)
    # the first row is the sample, the other rows are the resamples
    statistics = [ranks, slopes / y.std(), slopes / x.std(axis=0) * (high - low)]
    effects = []
    for index, name in enumerate(columns):
        intervals = [
            (float(statistic[0, index]), *rates.percentile_interval(statistic[1:, index])) for statistic in statistics
        ]
        effects.append(ConditionEffect(name, float(low[index]), float(high[index]), *intervals))
    return effects


def regress_weighted(
    x: Float[np.ndarray, "n k"], y: Float[np.ndarray, " n"], weights: Float[np.ndarray, "b n"]
) -> Float[np.ndarray, "b k"]:
    """Fit y to all columns of x and a constant by weighted least squares; return the slopes for each row of weights."""
    design = np.column_stack([np.ones(y.size), x - x.mean(axis=0)])
    normal_matrices = np.einsum("bn,ni,nj->bij", weights, design, design, optimize=True)
    right_sides = np.einsum("bn,ni->bi", weights, design * y[:, None])
    # a condition can be constant in a resample of few terrains; its slope from the pseudo-inverse is then 0
    return np.asarray(np.einsum("bij,bj->bi", np.linalg.pinv(normal_matrices, hermitian=True), right_sides)[:, 1:])


def correlate_weighted(
    x: Float[np.ndarray, "n k"], y: Float[np.ndarray, " n"], weights: Float[np.ndarray, "b n"]
) -> Float[np.ndarray, "b k"]:
    """Correlate y with each column of x for each row of weights; inputs are ranks in the original sample."""
    normalized = weights / weights.sum(axis=1, keepdims=True)
    x, y = x - x.mean(axis=0), y - y.mean()
    mean_x, mean_y = normalized @ x, (normalized @ y)[:, None]
    covariance = normalized @ (x * y[:, None]) - mean_x * mean_y
    variances = (normalized @ (x * x) - mean_x**2) * ((normalized @ (y * y))[:, None] - mean_y**2)
    # `tiny` avoids a division by zero for a constant
    return np.asarray(covariance / np.sqrt(np.maximum(variances, np.finfo(np.float64).tiny)))


@in_page_style
def effect_figure(effects: Sequence[ConditionEffect], unit: str) -> Figure:
    """Draw the effects with their intervals."""
    figure, axes = new_axes(6.4, 0.9 + 0.36 * len(effects))
    y_positions = np.arange(len(effects))
    values = np.array([effect.effect for effect in effects])
    axes.hlines(y_positions, values[:, 1], values[:, 2], color=SERIES[0], linewidth=5.0, alpha=0.45)
    axes.plot(values[:, 0], y_positions, "o", color=SERIES[0])
    axes.axvline(0.0, color=MUTED, linewidth=0.8)
    axes.set_yticks(y_positions, [label(effect.column) for effect in effects])
    axes.set(xlabel=f"change of the mean magnitude ({unit})", ylim=(len(effects) - 0.5, -0.5))
    axes.grid(visible=False, axis="y")
    return figure
