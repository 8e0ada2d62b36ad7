"""Sections of descents: velocity error at ignition, speed at touchdown, and sensitivity to the conditions.

The paper is Johnson et al., "Field Testing of the MER DIMES".
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy import stats

from marsyard.reports import populations, rates
from marsyard.reports.blocks import Quantity, distribution_block, quantile_block, rate_block
from marsyard.reports.column_values import numbers
from marsyard.reports.figure_style import MUTED, SERIES, in_page_style, new_axes
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import (
    Block,
    Grid,
    Section,
    Subject,
    create_section,
    has_values,
    omit_empty_rows,
    svg_figure,
)
from marsyard.reports.statistics.samples import quantile_bounds
from marsyard.reports.tables import error_summaries, statistics_rows
from marsyard.reports.wording import format_fraction, label, magnitude_label, note_text, number, percent
from marsyard.scenarios.columns import split_unit
from marsyard.scenarios.descent.parameters import TouchdownParameters

_FIRING = "firing_velocity_error_m_s"


def ignition_section(subject: Subject) -> Section | None:
    """Create the section on the error of the propagated velocity at thruster ignition, at a height near 100 m.

    Section I of the paper. None without the error, or if it is the page's metric.
    """
    frame = subject.frame
    if subject.metric == _FIRING or not has_values(frame, _FIRING):
        return None
    summaries = error_summaries(frame, _FIRING)
    rows, too_few_cases = omit_empty_rows(statistics_rows([summary for _, summary in summaries]))
    grid = Grid(["", *(name for name, _ in summaries)], rows)
    return create_section(
        "firing",
        "Ignition",
        "Velocity error at thruster ignition",
        Block(grid=grid, note=f"{too_few_cases}{note_text('dimes.firing')}", data=dict(summaries)),
        quantile_block(
            frame,
            [Quantity("firing_after_s")],
            {"Minimum": 0.0, "Median": 0.5, "Maximum": 1.0},
            "Time available to compute the velocity",
        ),
    )


#: Columns of the horizontal speed at touchdown with and without steering.
SPEED_CORRECTED, SPEED_UNCORRECTED = "touchdown_speed_corrected_m_s", "touchdown_speed_uncorrected_m_s"
#: Minimum change of speed that counts as an improvement or a degradation, m/s.
MIN_SPEED_CHANGE_M_S = 1.0
#: Speeds above which the table gives the fraction of cases, m/s.
SPEEDS_M_S = (5.0, 10.0, 15.0, 20.0, 25.0)


def landing_section(subject: Subject) -> Section | None:
    """Create the section on the horizontal speed at touchdown with and without steering by the estimated velocity."""
    landings = landing_rows(subject)
    if landings is None:
        return None
    return create_section(
        "landing",
        "Landing",
        "Horizontal speed at touchdown",
        distribution_block(
            "landing",
            {
                "with steering": rates.finite_values(landings, SPEED_CORRECTED),
                "without steering": rates.finite_values(landings, SPEED_UNCORRECTED),
            },
            ("horizontal speed at touchdown (m/s)", "fraction of landings above this speed"),
            "The same landings with steering by the reported velocity, and without. The lower curve is better.",
            complementary=True,
        ),
        rate_block(
            landing_fractions(landings),
            "Landings",
            "Effect of steering",
            "The intervals are two-sided Clopper-Pearson intervals, corrected for shared terrains.",
            data="fractions",
        ),
        create_speed_block(landings, subject),
    )


def landing_rows(subject: Subject) -> pd.DataFrame | None:
    """Select the landings with both speeds; None without a landing."""
    speeds = np.column_stack([numbers(subject.frame, name) for name in (SPEED_CORRECTED, SPEED_UNCORRECTED)])
    landings = subject.frame[np.isfinite(speeds).all(axis=1)]
    return landings if len(landings) else None


def landing_fractions(landings: pd.DataFrame) -> dict[str, rates.CaseFraction]:
    """Compute fractions of landings with a lower and a higher speed, and of answers available before ignition."""
    change = numbers(landings, SPEED_CORRECTED) - numbers(landings, SPEED_UNCORRECTED)
    fractions = {
        f"slower by more than {MIN_SPEED_CHANGE_M_S:g} m/s": rates.fraction_of(
            change < -MIN_SPEED_CHANGE_M_S, landings
        ),
        f"faster by more than {MIN_SPEED_CHANGE_M_S:g} m/s": rates.fraction_of(change > MIN_SPEED_CHANGE_M_S, landings),
    }
    if populations.is_flag(landings, "in_time_assumed"):
        name = "assumed computation time ends before ignition"
        fractions[name] = rates.fraction_of(populations.flag_mask(landings, "in_time_assumed"), landings)
    return fractions


def _landing_model(subject: Subject) -> dict[str, str]:
    """Return the parameters of the campaign's model of the last seconds, for the note of the table of speeds."""
    model = TouchdownParameters.model_validate(subject.run.parameter("landing") or {})
    return {
        "computation": f"{model.computation_s:g}",
        "deadband": f"{model.steering_deadband_m_s:g}",
        "max_steering": f"{model.max_steering_m_s:g}",
        "steering": f"{100.0 * model.steering_error:g}",
        "burn": f"{model.burn_error_m_s:g}",
    }


def create_speed_block(landings: pd.DataFrame, subject: Subject) -> Block:
    """Create the table of touchdown speeds with and without steering: mean, quantiles, fractions above speeds."""
    corrected, uncorrected = columns = [numbers(landings, name) for name in (SPEED_CORRECTED, SPEED_UNCORRECTED)]
    groups, change = rates.terrain_groups(landings), corrected - uncorrected
    rows = [["mean (m/s)", *(number(float(values.mean())) for values in columns)]]
    for probability in (0.5, 0.95, 0.99):
        texts = []
        for values in columns:
            _, bound = quantile_bounds(values, probability, CONFIDENCE, groups)
            bound_text = f" (≤ {number(bound)})" if np.isfinite(bound) else ""
            texts.append(f"{number(rates.quantile(values, probability))}{bound_text}")
        name = "median" if probability == 0.5 else f"{format_fraction(probability)} quantile"
        rows.append([f"{name} (m/s)", *texts])
    rows += [
        [f"faster than {speed:g} m/s", *(percent(float(np.mean(values > speed))) for values in columns)]
        for speed in SPEEDS_M_S
    ]
    data = {
        "landings": len(landings),
        "reduced_fraction": float(np.mean(change < -MIN_SPEED_CHANGE_M_S)),
        "increased_fraction": float(np.mean(change > MIN_SPEED_CHANGE_M_S)),
        "mean_with_m_s": float(corrected.mean()),
        "mean_without_m_s": float(uncorrected.mean()),
        "largest_gain_m_s": float(-change.min()),
        "largest_loss_m_s": float(change.max()),
    }
    gain, loss = (f"{number(value)} m/s" if value > 0.0 else "none" for value in (-change.min(), change.max()))
    kept_rows, missing = omit_empty_rows(rows)
    has_bounds = any("≤" in text for row in kept_rows for text in row)
    bounds = f"The sign ≤ marks upper bounds at {format_fraction(CONFIDENCE)} confidence. " if has_bounds else ""
    numbers_of_note = {"not_steered": int((change == 0.0).sum()), "landings": len(landings), **_landing_model(subject)}
    note = note_text("dimes.landing", missing=missing, bounds=bounds, gain=gain, loss=loss, **numbers_of_note)
    grid = Grid(["", "With steering", "Without steering"], kept_rows)
    return Block(heading="Speeds with and without steering", grid=grid, note=note, data=data)


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
    estimates, lower, upper = np.array([effect.effect for effect in effects]).T
    axes.hlines(y_positions, lower, upper, color=SERIES[0], linewidth=5.0, alpha=0.45)
    axes.plot(estimates, y_positions, "o", color=SERIES[0])
    axes.axvline(0.0, color=MUTED, linewidth=0.8)
    axes.set_yticks(y_positions, [label(effect.column) for effect in effects])
    axes.set(xlabel=f"change of the mean magnitude ({unit})", ylim=(len(effects) - 0.5, -0.5))
    axes.grid(visible=False, axis="y")
    return figure
