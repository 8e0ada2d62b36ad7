"""Contributions of sources of error to the mean square of the error, with their intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float64

from marsyard.campaigns.json_numbers import Number
from marsyard.campaigns.studies.bootstrap import studentized_intervals
from marsyard.sim.error_sources import ErrorSource

#: Minimum number of base cases whose error has a value in all variants.
MIN_COMMON = 10


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
    if n_groups < 2 or squares[0] <= 0.0:
        return None
    total, without_sources = float(squares[0]), float(squares[1])
    removed, alone = total - squares[2 : 2 + n_sources], squares[2 + n_sources :] - without_sources
    # rows: mean of `removed` and `alone` of each source, mean square with all sources, and closure times this
    combinations = np.zeros((n_sources + 2, len(squares)))
    for index in range(n_sources):
        combinations[index, [0, 1, 2 + index, 2 + n_sources + index]] = 0.5, -0.5, -0.5, 0.5
    combinations[n_sources, 0] = 1.0
    combinations[n_sources + 1] = combinations[:n_sources].sum(axis=0)
    combinations[n_sources + 1, 1] += 1.0
    mean = combinations[:n_sources] @ squares
    lower, upper = studentized_intervals(partial(_combine, mean_squares, combinations), n_groups, confidence)
    counts = has_error.sum(axis=1)
    contributions = [
        Contribution(
            source.name,
            source.title,
            float(alone[index]),
            float(removed[index]),
            float(mean[index]),
            float(lower[index]),
            float(upper[index]),
            (int(counts[2 + index]), int(counts[2 + n_sources + index])),
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
    total = max(squares[0], np.finfo(np.float64).tiny)  # 0 if a resample contains only one group
    outputs, slopes = combinations @ squares, combinations.copy()
    outputs[-1] /= total
    slopes[-1] /= total
    slopes[-1, 0] -= outputs[-1] / total
    n_groups = len(influence)
    variances = n_groups / (n_groups - 1.0) * weights @ (influence @ slopes.T) ** 2
    return outputs, np.sqrt(variances)
