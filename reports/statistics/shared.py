"""What values from shared terrains say: intervals of mean and spread, bounds of quantiles.

Values on one terrain are alike, so that the terrain is what was drawn. Mean and standard deviation: BCa bootstrap of
whole terrains (Davison & Hinkley, "Bootstrap methods and their application", 1997, section 3.8), widened for few of
them as that of single values is, and reaching at least as far as Student's interval with the variance over terrains
(Taylor linearisation; Cochran, "Sampling techniques", 1977, section 6), since a bootstrap of few terrains covers too
little. Quantiles: order statistics, counted as success rates of shared terrains are
(`marsyard.reports.statistics.clusters`): by the effective number of values (Woodruff, J. Amer. Statist. Assoc. 47,
1952, with Korn & Graubard's number), or by whole terrains where too few of them lie on either side. `python -m
benchmarks.validation --only shared` measures their coverage.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

from marsyard.reports.statistics.bootstrap import LARGEST_SAMPLE, bca
from marsyard.reports.statistics.clusters import ClusterMethod, clustered_evidence, terrain_index
from marsyard.reports.statistics.proportions import Interval, proportion_lower

#: Fewest terrains that say anything of the spread between them.
FEWEST_TERRAINS = 5


def is_shared(groups: Int[np.ndarray, " n"] | None) -> bool:
    """Whether any two values are from one terrain."""
    return groups is not None and groups.size > 0 and int(terrain_index(groups).max()) + 1 < groups.size


def shared_mean(values: Float[np.ndarray, " n"], groups: Int[np.ndarray, " n"], confidence: float) -> Interval:
    """Two-sided interval of the mean of values on shared terrains; NaN for fewer than five terrains.

    Parameters
    ----------
    values, groups
        Finite values, and the number of the terrain of each.
    confidence
        Of the interval.
    """
    index = terrain_index(groups)
    sizes, sums = np.bincount(index).astype(np.float64), np.bincount(index, weights=values)
    terrains = sizes.size
    if terrains < FEWEST_TERRAINS:
        return math.nan, math.nan
    mean = float(values.mean())
    half = _student(confidence, terrains) * _deviation_of_mean(sums - mean * sizes, values.size)
    plain = mean - half, mean + half
    if terrains > LARGEST_SAMPLE:
        return plain
    return _union(plain, bca((sums, sizes), _ratio, confidence))


def shared_spread(values: Float[np.ndarray, " n"], groups: Int[np.ndarray, " n"], confidence: float) -> Interval:
    """Two-sided interval of the standard deviation of values on shared terrains; NaN for fewer than five terrains."""
    index = terrain_index(groups)
    sizes = np.bincount(index).astype(np.float64)
    terrains = sizes.size
    if terrains < FEWEST_TERRAINS:
        return math.nan, math.nan
    centred = values - values.mean()
    sums, squares = (np.bincount(index, weights=centred**power) for power in (1, 2))
    variance = float((centred**2).mean())
    # of the logarithm, whose distribution is less skewed, corrected for few terrains as Bonett's interval (see
    # `samples.spread_interval`) is for few values
    quantile = _student(confidence, terrains)
    correction = terrains / max(terrains - quantile, 1.0)
    half = quantile * correction * _deviation_of_mean(squares - variance * sizes, values.size) / variance
    middle = math.log(correction * variance)
    plain = math.exp(0.5 * (middle - half)), math.exp(0.5 * (middle + half))
    if terrains > LARGEST_SAMPLE:
        return plain
    return _union(plain, bca((squares, sums, sizes), _spread, confidence))


def shared_quantile(
    values: Float[np.ndarray, " n"], groups: Int[np.ndarray, " n"], quantile: float, confidence: float
) -> Interval:
    """One-sided bounds of a quantile of values on shared terrains, each at the confidence; infinite where the sample
    is too small to give one.
    """
    lower = -_upper_bound(-values, groups, 1.0 - quantile, confidence)
    return lower, _upper_bound(values, groups, quantile, confidence)


def _upper_bound(
    values: Float[np.ndarray, " n"], groups: Int[np.ndarray, " n"], quantile: float, confidence: float
) -> float:
    """The least value of the sample up to which at least a share `quantile` of all lies, at the confidence."""
    ordered = np.sort(values)
    n = ordered.size
    below = values <= ordered[min(n - 1, max(0, math.ceil(quantile * n) - 1))]
    shown = clustered_evidence(below, groups, confidence)
    if shown.method is ClusterMethod.TERRAIN_COUNT:
        # what holds for all values of so many terrains holds for at least as many values
        index = terrain_index(groups)
        ordered = np.full(int(index.max()) + 1, -math.inf)
        np.maximum.at(ordered, index, values)
        ordered, worth = np.sort(ordered), 1.0
    else:
        worth = shown.effective_n / n
    return _least_rank(ordered, worth, quantile, confidence)


def _least_rank(ordered: Float[np.ndarray, " n"], worth: float, quantile: float, confidence: float) -> float:
    """The first of the ordered values whose rank shows the quantile, each value being worth so many; inf for none."""
    n = ordered.size
    if proportion_lower(n * worth, n * worth, confidence) < quantile:
        return math.inf
    low, high = 0, n
    while high - low > 1:
        middle = (low + high) // 2
        shown = proportion_lower(middle * worth, n * worth, confidence) >= quantile
        low, high = (low, middle) if shown else (middle, high)
    return float(ordered[high - 1])


def _student(confidence: float, terrains: int) -> float:
    return float(stats.t.ppf(0.5 * (1.0 + confidence), terrains - 1))


def _deviation_of_mean(residuals: Float[np.ndarray, " terrains"], n: int) -> float:
    """Standard deviation of a mean over n values, from the terrains' sums of residuals."""
    terrains = residuals.size
    return math.sqrt(terrains / (terrains - 1.0) * float((residuals**2).sum())) / n


def _ratio(sums: Float[np.ndarray, "*n"], sizes: Float[np.ndarray, "*n"], axis: int = -1) -> np.ndarray:
    return np.asarray(sums.sum(axis=axis) / sizes.sum(axis=axis))


def _spread(
    squares: Float[np.ndarray, "*n"], sums: Float[np.ndarray, "*n"], sizes: Float[np.ndarray, "*n"], axis: int = -1
) -> np.ndarray:
    n = sizes.sum(axis=axis)
    excess = squares.sum(axis=axis) - sums.sum(axis=axis) ** 2 / n
    return np.asarray(np.sqrt(np.maximum(excess, 0.0) / (n - 1.0)))


def _union(first: Interval, second: Interval) -> Interval:
    return float(np.fmin(first[0], second[0])), float(np.fmax(first[1], second[1]))
