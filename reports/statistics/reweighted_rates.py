"""Failure rates of reweighted cases: estimates, one-sided bounds, and effective numbers of cases.

The cases are drawn from a distribution p; a change replaces it by p'. The weight p'(x) / p(x) of a case then gives the
rate under p' (importance sampling) without new cases. A unit is a case, or all cases on one terrain; u and f are its
weight and the weight of its failures, scaled so that the mean of u over the N units is 1.

The bounds are those of Fay & Feuer ("Confidence intervals for directly standardized rates: a method based on the gamma
distribution", Statistics in Medicine 16, 1997), with the beta distribution in place of their gamma distribution. With
Y = sum f, the rate q = Y / N and the confidence c they are::

    V = max(sum f^2, sum (f - q u)^2 / (1 - q))
    lower = s B(1 - c; k, N - k + 1) with s = V / Y, k = Y^2 / V
    upper = s B(c; k, N - k + 1)     with s = (V + m^2) / (Y + m), k = (Y + m)^2 / (V + m^2)

B is the quantile of the beta distribution: k failures of the weight s among N units. The second term of V is the
variance of a ratio, since the sum of the weights is random too. The upper bound has one further failure with the
largest weight m = max u, so that it is valid where no case failed. With equal weights, both are the bounds of Clopper
and Pearson, on which verdicts rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int
from scipy import stats
from scipy.special import rel_entr

#: Values for each of several changes.
Changes = Float64[np.ndarray, " changes"]
#: Minimum number of effective units: with fewer, weights say nothing.
MIN_EFFECTIVE = 30.0
#: Smallest parameter of a beta distribution, if all units fail.
_MIN_PARAMETER = 1e-9
#: Smallest sum of weights: smaller weights were rounded to 0.
_MIN_SUM = 1e-9


@dataclass(frozen=True)
class WeightedRates:
    """Failure rates under several changes.

    - estimate, lower, upper: rate, and its one-sided bounds
    - effective_units: equivalent number of units with equal weights (Kish 1965)
    """

    estimate: Changes
    lower: Changes
    upper: Changes
    effective_units: Changes


def weighted_rates(
    weights: Float64[np.ndarray, "changes n"],
    failure: Bool[np.ndarray, "*changes n"],
    groups: Int[np.ndarray, " n"] | None,
    confidences: tuple[float, float],
    max_weights: Changes | float = 0.0,
    efficiency: Changes | float = 1.0,
) -> WeightedRates:
    """Compute the failure rates of the cases of a population for the weights of each change.

    - weights: of each case for each change; those of the first change are the weights without a change
    - failure: whether each case fails, for each change if it depends on it
    - groups: number of each case's terrain; None for independent cases
    - confidences: of the lower and of the upper bound
    - max_weights: largest possible weight of a unit if it is known; otherwise, the largest one of these units is used
    - efficiency: expected effective number of units per unit, if it is known: that of a sample is too large if weights
      are heavy-tailed
    """
    unit, failing = _sum_groups(weights, groups), _sum_groups(weights * failure, groups)
    units = unit.shape[1]
    is_known = unit.sum(axis=1) > _MIN_SUM
    unit = np.where(is_known[:, None], unit, 1.0)
    scale = units / unit.sum(axis=1)
    total, square = scale * failing.sum(axis=1), scale**2 * (failing**2).sum(axis=1)
    rate = (total / units)[:, None]
    ratio_square = scale**2 * ((failing - rate * unit) ** 2).sum(axis=1)
    square = np.maximum(square, ratio_square / np.maximum(1.0 - rate[:, 0], 1.0 / units))
    largest = scale * np.maximum(unit.max(axis=1), max_weights)
    has_failure = square > 0.0
    # any positive numbers where no case failed
    known_total, known_square = np.where(has_failure, total, 1.0), np.where(has_failure, square, 1.0)
    lower = np.where(has_failure, _bound(known_total, known_square, units, 1.0 - confidences[0]), 0.0)
    upper = _bound(total + largest, square + largest**2, units, confidences[1])
    effective = is_known * units**2 / (scale**2 * (unit**2).sum(axis=1))
    return WeightedRates(total / units, lower, np.minimum(upper, 1.0), np.minimum(effective, efficiency * effective[0]))


def _bound(total: Changes, square: Changes, units: int, level: float) -> Changes:
    """Compute the quantile at a level of the rate of failures with the sum `total` and the sum of squares `square`."""
    number = total**2 / square
    return np.asarray(square / total * stats.beta.ppf(level, number, np.maximum(units - number + 1.0, _MIN_PARAMETER)))


def _sum_groups(
    values: Float64[np.ndarray, "changes n"], groups: Int[np.ndarray, " n"] | None
) -> Float64[np.ndarray, "changes units"]:
    """Sum the values of the cases of each group."""
    if groups is None:
        return values
    order = np.argsort(groups, kind="stable")
    starts = np.flatnonzero(np.diff(groups[order], prepend=-1))
    return np.add.reduceat(values[:, order], starts, axis=1)


#: Rounding error of a rate that is compared with a limit.
ROUNDING = 1e-12


@dataclass(frozen=True)
class Crossing:
    """Sizes of a change at which the upper bound, the estimate and the lower bound of a failure rate reach a limit.

    - change: size at which the estimate reaches it; lower, upper: bounds of this size, from upper and lower bound
    - lower: `reach` if the upper bound stays below the limit; NaN if it exceeds the limit without a change
    - change, upper: NaN if they do not reach the limit
    - reach: largest size with `MIN_EFFECTIVE` effective units; effective_cases: their number at `change`, or at `reach`
    """

    change: float
    lower: float
    upper: float
    reach: float
    effective_cases: float


def find_crossing(sizes: Changes, rates: WeightedRates, limit: float, *, decides_by_rate: bool = False) -> Crossing:
    """Find the sizes of a change at which the failure rate reaches a limit, by linear interpolation.

    decides_by_rate: whether `lower` is that of the estimate
    """
    # the tolerance is for rounding errors of the largest size
    is_usable = np.logical_and.accumulate(np.nan_to_num(rates.effective_units) >= MIN_EFFECTIVE * (1.0 - 1e-9))
    count = int(is_usable.sum())
    if not count:
        return Crossing(math.nan, math.nan, math.nan, 0.0, float(rates.effective_units[0]))
    reach = float(sizes[count - 1])
    decisive = rates.estimate if decides_by_rate else rates.upper
    lower, change, upper = (
        _first_above(sizes[:count], values[:count], limit) for values in (decisive, rates.estimate, rates.lower)
    )
    if decisive[0] > limit + ROUNDING:
        lower = math.nan
    elif math.isnan(lower):
        lower = reach
    size = reach if math.isnan(change) else change
    return Crossing(change, lower, upper, reach, float(np.interp(size, sizes, rates.effective_units)))


def _first_above(sizes: Changes, values: Changes, limit: float) -> float:
    """Find the smallest size whose value exceeds a limit, by linear interpolation; NaN if there is none.

    The first size is 0, without a change.
    """
    above = np.flatnonzero(values > limit + ROUNDING)
    if not above.size:
        return math.nan
    first = int(above[0])
    if first == 0:
        return 0.0
    return float(np.interp(limit, values[first - 1 : first + 1], sizes[first - 1 : first + 1]))


def population_divergence(rate: float, reference: float, member_rate: float) -> float:
    """Compute the smallest divergence of the distribution of all cases that changes the failure rate of a population.

    - rate, reference: failure rates in the population after and before the change
    - member_rate: fraction of all cases that belong to the population, before the change
    """
    divergence = 0.0 if rate <= reference else float(rel_entr(rate, reference) + rel_entr(1 - rate, 1 - reference))
    is_bounded = math.isfinite(divergence) and member_rate < 1.0
    return -math.log1p(member_rate * math.expm1(-divergence)) if is_bounded else divergence
