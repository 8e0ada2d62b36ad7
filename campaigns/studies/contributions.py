"""Contributions of sources of error to the mean square of the error, with their intervals.

Means of squared errors are skewed. Percentile intervals of a bootstrap, and BCa intervals, are then too short: with 20
to 100 cases they contain the true value in 70 to 92 % of samples for a nominal 90 %. A studentised bootstrap (Efron &
Tibshirani, An Introduction to the Bootstrap, 1993, section 12.5) is accurate to second order, and is united with
Student's interval, which is longer on the side of the small values (`docs/validation.md` contains the coverage).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float64
from scipy import stats

from marsyard.campaigns.json_numbers import Number
from marsyard.sim.error_sources import ErrorSource

#: Minimum number of base cases whose error has a value in all variants.
MIN_COMMON = 10
#: Number of bootstrap resamples.
_RESAMPLES = 2000
#: Minimum standard error relative to the estimate; below it, an output is constant except for rounding errors.
_MIN_RELATIVE_ERROR = 1e-9
#: Rows of the errors by variant: with all sources and with none; the rows without each source begin at the last number,
#: and those with each source alone follow them (`marsyard.campaigns.studies.budget.list_variants`).
_ALL, _NONE, _FIRST_WITHOUT = 0, 1, 2
#: Function of the weights of the groups: estimates, and their standard errors.
Evaluate = Callable[
    [Float64[np.ndarray, " groups"]], tuple[Float64[np.ndarray, " outputs"], Float64[np.ndarray, " outputs"]]
]


@dataclass(frozen=True)
class Contribution:
    """Contribution of a source of error to the mean square of the error, in its squared unit.

    - source, title: see `ErrorSource`
    - alone: mean square with this source only, minus that without any source
    - removed: mean square with all sources, minus that without this one
    - mean, lower, upper: mean of `alone` and `removed`, and bounds of its interval; without interactions of more than
      two sources, these means and the mean square without any source add up to the mean square with all sources
    - answered: numbers of base cases whose error has a value, without the source and with the source alone
    """

    source: str
    title: str
    alone: float
    removed: float
    mean: float
    lower: Number
    upper: Number
    answered: tuple[int, int]


@dataclass(frozen=True)
class Budget:
    """An error budget: mean squares of the error over the base cases whose error has a value in all variants.

    - contributions: one per source, the largest first
    - total, total_lower, total_upper: mean square with all sources, and bounds of its interval
    - remaining: mean square without any source, for example caused by images, matching and scene
    - closure, closure_lower, closure_upper: (remaining + sum of the means of the contributions) / total
    - common: number of these base cases
    """

    contributions: tuple[Contribution, ...]
    total: float
    total_lower: Number
    total_upper: Number
    remaining: float
    closure: Number
    closure_lower: Number
    closure_upper: Number
    common: int


def compute_budget(
    errors: Float64[np.ndarray, "variants n"],
    groups: np.ndarray,
    sources: Sequence[ErrorSource],
    is_centred: bool,
    confidence: float,
) -> Budget | None:
    """Compute the contributions from the base cases whose error has a value in all variants.

    None for too few of these cases, for one group, or if all errors are equal. The intervals are those of
    `studentized_intervals`; groups of cases (terrains) are resampled.

    - errors: error of each case in each variant: with all sources, with none, without each one, then with each one
      alone (`marsyard.campaigns.studies.budget.list_variants`); NaN without a value
    - groups: number of the group of each case
    """
    has_error = np.isfinite(errors)
    is_common: Bool[np.ndarray, "n"] = has_error.all(axis=0)
    n_sources = len(sources)
    if not n_sources or is_common.sum() < MIN_COMMON:
        return None
    mean_squares = _MeanSquares.from_errors(errors[:, is_common], groups[is_common], is_centred)
    n_groups = mean_squares.sizes.size
    squares = mean_squares.evaluate(np.ones(n_groups))[0]
    if n_groups < 2 or squares[_ALL] <= 0.0:
        return None
    without = _FIRST_WITHOUT + np.arange(n_sources)
    only = without + n_sources
    total, without_sources = float(squares[_ALL]), float(squares[_NONE])
    removed, alone = total - squares[without], squares[only] - without_sources
    # rows: mean of `removed` and `alone` of each source, mean square with all sources, and closure times this
    combinations = np.zeros((n_sources + 2, len(squares)))
    for index in range(n_sources):
        combinations[index, [_ALL, without[index], only[index], _NONE]] = 0.5, -0.5, 0.5, -0.5
    combinations[n_sources, _ALL] = 1.0
    combinations[n_sources + 1] = combinations[:n_sources].sum(axis=0)
    combinations[n_sources + 1, _NONE] += 1.0
    mean = combinations[:n_sources] @ squares
    lower, upper = studentized_intervals(partial(_combine, mean_squares, combinations), n_groups, confidence)
    counts = has_error.sum(axis=1)
    contributions = [
        Contribution(
            source=source.name,
            title=source.title,
            alone=float(alone[index]),
            removed=float(removed[index]),
            mean=float(mean[index]),
            lower=float(lower[index]),
            upper=float(upper[index]),
            answered=(int(counts[without[index]]), int(counts[only[index]])),
        )
        for index, source in enumerate(sources)
    ]
    return Budget(
        contributions=tuple(sorted(contributions, key=lambda item: -item.mean)),
        total=total,
        total_lower=float(lower[n_sources]),
        total_upper=float(upper[n_sources]),
        remaining=without_sources,
        closure=float(combinations[n_sources + 1] @ squares) / total,
        closure_lower=float(lower[n_sources + 1]),
        closure_upper=float(upper[n_sources + 1]),
        common=int(is_common.sum()),
    )


@dataclass(frozen=True)
class _MeanSquares:
    """Sums of the errors and their squares over groups of cases, for each variant; sizes of the groups.

    If mean squares are not centred (`BudgetResult.centred`), the sums of the errors are 0.
    """

    sums: Float64[np.ndarray, "groups variants"]
    squares: Float64[np.ndarray, "groups variants"]
    sizes: Float64[np.ndarray, " groups"]

    @classmethod
    def from_errors(
        cls, errors: Float64[np.ndarray, "variants n"], groups: np.ndarray, is_centred: bool
    ) -> _MeanSquares:
        """Sum errors over groups of cases."""
        number = np.unique(groups, return_inverse=True)[1]
        belongs = (number == np.arange(number.max() + 1)[:, None]).astype(np.float64)
        return cls(float(is_centred) * belongs @ errors.T, belongs @ errors.T**2, belongs.sum(axis=1))

    def evaluate(
        self, weights: Float64[np.ndarray, " groups"]
    ) -> tuple[Float64[np.ndarray, " variants"], Float64[np.ndarray, "groups variants"]]:
        """Compute the mean squares for the weights of the groups, and their change by each group (influence)."""
        n = weights @ self.sizes
        means, squares = weights @ self.sums / n, weights @ self.squares / n
        sizes = self.sizes[:, None]
        influence = self.squares - squares * sizes - 2.0 * means * (self.sums - means * sizes)
        return squares - means**2, influence / n


def _combine(
    mean_squares: _MeanSquares,
    combinations: Float64[np.ndarray, "outputs variants"],
    weights: Float64[np.ndarray, " groups"],
) -> tuple[Float64[np.ndarray, " outputs"], Float64[np.ndarray, " outputs"]]:
    """Compute combinations of mean squares with their standard errors (linearisation).

    The last output is divided by the first mean square.
    """
    squares, influence = mean_squares.evaluate(weights)
    total = max(squares[_ALL], np.finfo(np.float64).tiny)  # 0 if a resample contains only one group
    outputs, slopes = combinations @ squares, combinations.copy()
    outputs[-1] /= total
    slopes[-1] /= total
    slopes[-1, _ALL] -= outputs[-1] / total
    n_groups = len(influence)
    variances = n_groups / (n_groups - 1.0) * weights @ (influence @ slopes.T) ** 2
    return outputs, np.sqrt(variances)


def studentized_intervals(evaluate: Evaluate, n_groups: int, confidence: float) -> Float64[np.ndarray, "2 outputs"]:
    """Compute two-sided intervals of estimates from independent groups (at least 2), which are resampled.

    - evaluate: estimates and standard errors for the number of times that each group occurs in a resample
    - confidence: two-sided confidence of each interval
    """
    estimates, errors = evaluate(np.ones(n_groups))
    rng = np.random.default_rng(0)
    resamples = rng.multinomial(n_groups, np.full(n_groups, 1.0 / n_groups), size=_RESAMPLES).astype(np.float64)
    deviations = np.zeros((_RESAMPLES, estimates.size))
    for deviation, weights in zip(deviations, resamples, strict=True):
        resampled, resampled_errors = evaluate(weights)
        has_error = resampled_errors > _MIN_RELATIVE_ERROR * np.abs(estimates)
        np.divide(resampled - estimates, resampled_errors, out=deviation, where=has_error)
    student = float(stats.t.ppf(0.5 * (1.0 + confidence), n_groups - 1))
    low, high = np.quantile(deviations, (0.5 * (1.0 - confidence), 0.5 * (1.0 + confidence)), axis=0)
    return np.array([estimates - np.maximum(high, student) * errors, estimates - np.minimum(low, -student) * errors])
