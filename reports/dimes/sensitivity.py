"""What drives the error: rank correlations and a standardised regression, with bootstrap intervals.

The paper says that "vertical velocity of the lander had much less of an effect on DIMES performance when compared to
altitude and attitude rates" (section III.C), and flew a helicopter for that. The regression tells each condition's part
with the others held: the error's magnitude on all drivers at once, each driver in units of its standard deviation. Both
sides may also be taken as ranks, which no outlier and no curved but monotonic law upsets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy import stats

from marsyard.reports.columns import label, magnitude_label, numbers, split_unit
from marsyard.reports.plates import plate
from marsyard.reports.populations import terrain_groups
from marsyard.reports.section import Block, Section, Subject
from marsyard.reports.sections import Grid
from marsyard.reports.svg import MUTED, SERIES, in_page_style, new_axes
from marsyard.reports.wording import number, stated

#: The drivers that the paper compares: all must be there and vary for the section to be shown.
ASKED = ("descent_rate_m_s", "altitude_1_m", "attitude_rate_max_deg_s")
#: Further drivers, taken in where they vary.
FURTHER = ("off_nadir_max_deg", "horizontal_speed_m_s", "sun_elevation_deg")
FEWEST_CASES = 50
CONFIDENCE = 0.9
_RESAMPLES = 1000
#: The same rows give the same page.
_SEED = 20050815


@dataclass(frozen=True)
class Driver:
    """What one condition does to the magnitude of the error.

    Attributes
    ----------
    column
        The condition.
    low, high
        Its 5 % and 95 % quantiles.
    rank_correlation
        Spearman's, with its interval.
    coefficient
        Change of the mean magnitude per standard deviation of the condition, the others held, over the standard
        deviation of the magnitude; with its interval.
    effect
        Change of the mean magnitude from `low` to `high`, the others held, in the error's unit; with its interval.
    """

    column: str
    low: float
    high: float
    rank_correlation: tuple[float, float, float]
    coefficient: tuple[float, float, float]
    effect: tuple[float, float, float]


def sensitivity_section(subject: Subject) -> Section | None:
    """What drives the error; None where the paper's drivers do not all vary or errors are too few."""
    if subject.metric is None:
        return None
    drivers = analyse(subject, subject.metric)
    if not drivers:
        return None
    metric, unit = subject.metric, split_unit(subject.metric)[1]
    caption = f"Change of the mean {magnitude_label(metric)} from the 5 % to the 95 % quantile of each condition."
    figure = effect_figure(drivers, unit)
    drawn = plate(figure, "sensitivity", caption)
    note = (
        f"Regression of {magnitude_label(metric)} on all conditions at once, cases with an answer only. Intervals: "
        f"{stated(CONFIDENCE)}, by bootstrap over terrains where cases share them, else over cases. Effect: from the "
        "5 % to the 95 % quantile of the condition, the others held."
    )
    data = {"drivers": [asdict(driver) for driver in drivers]}
    blocks = [Block(plates=[drawn]), Block(grid=_grid(drivers, unit), note=note)]
    return Section("sensitivity", "Sensitivity", "What drives the error", blocks, data)


def analyse(subject: Subject, metric: str) -> list[Driver]:
    """The drivers, the paper's first; none where these do not all vary or errors are too few."""
    frame = subject.frame
    magnitude = np.abs(numbers(frame, metric))
    columns = [name for name in (*ASKED, *FURTHER) if _varies(numbers(frame, name))]
    conditions = np.column_stack([numbers(frame, name) for name in columns]) if columns else np.zeros((len(frame), 0))
    known = np.isfinite(magnitude) & np.isfinite(conditions).all(axis=1)
    if not set(ASKED) <= set(columns) or known.sum() < FEWEST_CASES:
        return []
    x, y = conditions[known], magnitude[known]
    if np.ptp(y) == 0.0 or (np.ptp(x, axis=0) == 0.0).any():
        return []
    groups = terrain_groups(frame[known])
    weights = bootstrap_weights(np.arange(y.size) if groups is None else groups, np.random.default_rng(_SEED))
    low, high = np.quantile(x, (0.05, 0.95), axis=0)
    slopes = regressions(x / x.std(axis=0), y, weights)
    ranks = weighted_correlations(stats.rankdata(x, axis=0), stats.rankdata(y), weights)
    return [
        Driver(
            column=name,
            low=float(low[k]),
            high=float(high[k]),
            rank_correlation=_with_interval(ranks[:, k]),
            coefficient=_with_interval(slopes[:, k] / y.std()),
            effect=_with_interval(slopes[:, k] / x[:, k].std() * (high[k] - low[k])),
        )
        for k, name in enumerate(columns)
    ]


def bootstrap_weights(groups: np.ndarray, rng: np.random.Generator) -> Float[np.ndarray, "resamples n"]:
    """How often each case is drawn when whole groups are drawn with replacement; the first row is the sample itself."""
    count = int(groups.max()) + 1
    drawn = rng.multinomial(count, np.full(count, 1.0 / count), size=_RESAMPLES)
    return np.concatenate([np.ones((1, groups.size)), drawn[:, groups]]).astype(np.float64)


def regressions(
    x: Float[np.ndarray, "n k"], y: Float[np.ndarray, " n"], weights: Float[np.ndarray, "b n"]
) -> Float[np.ndarray, "b k"]:
    """Slopes of weighted least squares of y on all columns of x with a constant, for every row of weights."""
    design = np.column_stack([np.ones(y.size), x - x.mean(axis=0)])
    normal = np.einsum("bn,ni,nj->bij", weights, design, design, optimize=True)
    right = np.einsum("bn,ni->bi", weights, design * y[:, None])
    # A resample of few terrains may leave a direction without spread: the pseudo-inverse gives it no slope.
    return np.asarray(np.einsum("bij,bj->bi", np.linalg.pinv(normal, hermitian=True), right)[:, 1:])


def weighted_correlations(
    x: Float[np.ndarray, "n k"], y: Float[np.ndarray, " n"], weights: Float[np.ndarray, "b n"]
) -> Float[np.ndarray, "b k"]:
    """Correlations of y with each column of x, for every row of weights; of ranks, ranked once in the whole sample."""
    w = weights / weights.sum(axis=1, keepdims=True)
    x, y = x - x.mean(axis=0), y - y.mean()
    mean_x, mean_y = w @ x, (w @ y)[:, None]
    covariance = w @ (x * y[:, None]) - mean_x * mean_y
    variances = (w @ (x * x) - mean_x**2) * ((w @ (y * y))[:, None] - mean_y**2)
    return np.asarray(covariance / np.sqrt(np.maximum(variances, np.finfo(np.float64).tiny)))


@in_page_style
def effect_figure(drivers: Sequence[Driver], unit: str) -> Figure:
    """The effects with their intervals, a line each."""
    figure, axes = new_axes(6.4, 0.9 + 0.36 * len(drivers))
    places = np.arange(len(drivers))
    effects = np.array([driver.effect for driver in drivers])
    axes.hlines(places, effects[:, 1], effects[:, 2], color=SERIES[0], linewidth=5.0, alpha=0.45)
    axes.plot(effects[:, 0], places, "o", color=SERIES[0])
    axes.axvline(0.0, color=MUTED, linewidth=0.8)
    axes.set_yticks(places, [label(driver.column) for driver in drivers])
    axes.set(xlabel=f"change of the mean magnitude ({unit})", ylim=(len(drivers) - 0.5, -0.5))
    axes.grid(visible=False, axis="y")
    return figure


def _grid(drivers: Sequence[Driver], unit: str) -> Grid:
    head = ["", "5 % to 95 %", "Rank correlation", "Standardised coefficient", f"Effect ({unit})"]
    rows = [
        [
            label(driver.column),
            f"{number(driver.low)} to {number(driver.high)}",
            *(
                f"{number(value)} ({number(low)} to {number(high)})"
                for value, low, high in (driver.rank_correlation, driver.coefficient, driver.effect)
            ),
        ]
        for driver in drivers
    ]
    return Grid(head, rows)


def _varies(values: Float[np.ndarray, " n"]) -> bool:
    known = values[np.isfinite(values)]
    return known.size > 1 and float(np.ptp(known)) > 0.0


def _with_interval(values: Float[np.ndarray, " b"]) -> tuple[float, float, float]:
    """The sample's own value, then the percentile interval over the resamples."""
    low, high = np.quantile(values[1:], (0.5 * (1.0 - CONFIDENCE), 0.5 * (1.0 + CONFIDENCE)))
    return float(values[0]), float(low), float(high)
