"""Bounds of the mean, the standard deviation and the quantiles of a sample.

The bounds of quantiles are order statistics, for any distribution (Wilks, "Determination of sample sizes for setting
tolerance limits", Ann. Math. Statist. 12, 1941; used by Hanson & Beard for a specified consumer risk,
NASA/TP-2010-216447). The intervals of means and standard deviations are those of SciPy's BCa bootstrap (Efron, "Better
bootstrap confidence intervals", J. Amer. Statist. Assoc. 82, 1987), at the level of Student's t instead of the normal
distribution (Hesterberg, "What teachers should know about the bootstrap", Amer. Statist. 69, 2015), since the coverage
of BCa is too low in small samples. The interval of a standard deviation also includes Bonett's interval ("Approximate
confidence interval for standard deviation of nonnormal distributions", Comput. Statist. Data Anal. 50, 2006).

Values that share terrains (`groups`) are correlated; the terrain is the sampling unit. Mean and standard deviation: BCa
bootstrap of entire terrains (Davison & Hinkley, "Bootstrap methods and their application", 1997, section 3.8), widened
for few terrains as for few values; it also includes Student's interval with the variance over terrains (Taylor
linearisation; Cochran, "Sampling techniques", 1977, section 6). Quantiles: the order statistic at which the rate of
larger values has its bound (`marsyard.reports.statistics.clusters`).

`python -m benchmarks.validation --only intervals --only shared` measures the coverage of all these intervals.
"""

import math
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from scipy import stats

from marsyard.reports.statistics.clusters import (
    count_sizes,
    event_scores,
    max_statistic,
    number_terrains,
    select_counted,
)
from marsyard.reports.statistics.proportions import Interval, check_confidence

#: Maximum number of values (or terrains) of a bootstrap; above it, the large-sample interval is equal as printed.
_MAX_BOOTSTRAP = 2000
#: Number of resamples of a bootstrap, and of those that are computed together, which limits the memory.
_N_RESAMPLES, _BATCH = 2000, 200
#: Fixed seed of the bootstrap, for reproducible reports.
_SEED = 19340401
#: Minimum number of terrains, and of independent values, for intervals of a mean and of a standard deviation. The
#: bootstrap of fewer values has too few distinct samples: of two values, its interval ends at these values.
MIN_TERRAINS, _MIN_FOR_MEAN, _MIN_FOR_DEVIATION = 5, 5, 8
#: Terrain number of each value; None if all are independent.
Groups = Int[np.ndarray, " n"] | None


def is_shared(groups: Groups) -> bool:
    """Whether any two values are from one terrain."""
    return groups is not None and groups.size > 0 and int(number_terrains(groups).max()) + 1 < groups.size


def _bootstrap(data: Sequence[Float[np.ndarray, " n"]], statistic: Callable[..., Any], confidence: float) -> Interval:
    """Two-sided BCa interval of a statistic of one or more columns, resampled together; NaN if it does not exist."""
    n = data[0].size
    # the level at which the normal quantile equals Student's times sqrt(n / (n - 1)): Hesterberg 2015, section 5
    quantile = _student_quantile(confidence, n) * math.sqrt(n / (n - 1.0))
    with warnings.catch_warnings():
        # a degenerate bootstrap distribution (of two values, for example) gives NaN bounds
        warnings.simplefilter("ignore")
        result = stats.bootstrap(
            tuple(data),
            statistic,
            paired=True,
            # below 1, as SciPy requires
            confidence_level=min(2.0 * float(stats.norm.cdf(quantile)) - 1.0, 1.0 - 1e-6),
            n_resamples=_N_RESAMPLES,
            batch=_BATCH,
            vectorized=True,
            method="BCa",
            rng=np.random.default_rng(_SEED),
        )
    return float(result.confidence_interval.low), float(result.confidence_interval.high)


def _student_quantile(confidence: float, n: int) -> float:
    """Student's two-sided quantile for a mean of n values."""
    return float(stats.t.ppf(0.5 * (1.0 + confidence), n - 1))


def _standard_error(residuals: Float[np.ndarray, " terrains"], n: int) -> float:
    """Standard error of a mean of n values from the residual sums of the terrains (Taylor linearisation)."""
    terrains = residuals.size
    return math.sqrt(terrains / (terrains - 1.0) * float((residuals**2).sum())) / n


def _unite_intervals(first: Interval, second: Interval) -> Interval:
    """Return the smallest interval that contains both; NaN bounds are ignored."""
    return float(np.fmin(first[0], second[0])), float(np.fmax(first[1], second[1]))


def mean_interval(sample: Float[np.ndarray, " n"], confidence: float, groups: Groups = None) -> Interval:
    """Two-sided interval of the mean: BCa bootstrap, or the central limit theorem in large samples.

    NaN for fewer than five values or, if terrains are shared, fewer than five terrains. Equal values: that value.
    """
    check_confidence(confidence)
    values = np.asarray(sample, dtype=np.float64)
    if values.size < _MIN_FOR_MEAN:
        return math.nan, math.nan
    mean = float(values.mean())
    if np.ptp(values) == 0.0:
        return mean, mean
    if groups is None or not is_shared(groups):
        if values.size <= _MAX_BOOTSTRAP:
            return _bootstrap((values,), np.mean, confidence)
        quantile, deviation = float(stats.norm.ppf(0.5 * (1.0 + confidence))), float(values.std(ddof=1))
        half_width = quantile * deviation / math.sqrt(values.size)
        return mean - half_width, mean + half_width
    index = number_terrains(groups)
    sizes, sums = np.bincount(index).astype(np.float64), np.bincount(index, weights=values)
    if sizes.size < MIN_TERRAINS:
        return math.nan, math.nan
    half_width = _student_quantile(confidence, sizes.size) * _standard_error(sums - mean * sizes, values.size)
    if sizes.size > _MAX_BOOTSTRAP:
        return mean - half_width, mean + half_width

    def ratio(sums: Float[np.ndarray, "*n"], sizes: Float[np.ndarray, "*n"], axis: int = -1) -> np.ndarray:
        return np.asarray(sums.sum(axis=axis) / sizes.sum(axis=axis))

    return _unite_intervals((mean - half_width, mean + half_width), _bootstrap((sums, sizes), ratio, confidence))


def standard_deviation_interval(sample: Float[np.ndarray, " n"], confidence: float, groups: Groups = None) -> Interval:
    """Two-sided interval of the standard deviation: union of BCa bootstrap and Bonett's; in large samples Bonett's.

    NaN for fewer than eight values or, if terrains are shared, fewer than five terrains; 0 if all are equal.
    """
    check_confidence(confidence)
    values = np.asarray(sample, dtype=np.float64)
    if values.size < _MIN_FOR_DEVIATION:
        return math.nan, math.nan
    if np.ptp(values) == 0.0:
        return 0.0, 0.0
    if groups is not None and is_shared(groups):
        return _clustered_deviation_interval(values, groups, confidence)
    interval = _bonett_interval(values, confidence)
    if values.size > _MAX_BOOTSTRAP:
        return interval
    return _unite_intervals(interval, _bootstrap((values,), partial(np.std, ddof=1), confidence))


def _clustered_deviation_interval(
    values: Float[np.ndarray, " n"], groups: Int[np.ndarray, " n"], confidence: float
) -> Interval:
    """Two-sided interval of the standard deviation of values on shared terrains; NaN for fewer than five terrains."""
    index = number_terrains(groups)
    sizes = np.bincount(index).astype(np.float64)
    terrains = sizes.size
    if terrains < MIN_TERRAINS:
        return math.nan, math.nan
    centred = values - values.mean()
    sums, squares = (np.bincount(index, weights=centred**power) for power in (1, 2))
    variance = float((centred**2).mean())
    # interval of the logarithm, which is less skewed; corrected for few terrains like Bonett's interval for few values
    quantile = _student_quantile(confidence, terrains)
    correction = terrains / max(terrains - quantile, 1.0)
    half_width = quantile * correction * _standard_error(squares - variance * sizes, values.size) / variance
    centre = math.log(correction * variance)
    interval = math.exp(0.5 * (centre - half_width)), math.exp(0.5 * (centre + half_width))
    if terrains > _MAX_BOOTSTRAP:
        return interval

    def standard_deviation(*columns: Float[np.ndarray, "*n"], axis: int = -1) -> np.ndarray:
        squares, sums, n = (column.sum(axis=axis) for column in columns)
        return np.asarray(np.sqrt(np.maximum(squares - sums**2 / n, 0.0) / (n - 1.0)))

    return _unite_intervals(interval, _bootstrap((squares, sums, sizes), standard_deviation, confidence))


def _bonett_interval(values: Float[np.ndarray, " n"], confidence: float) -> Interval:
    """Bonett 2006, equation 8, with Student's t instead of the normal quantile."""
    n = values.size
    quantile = _student_quantile(confidence, n)
    # Bonett's trimmed mean and correction n / (n - z); the logarithm of the variance is less skewed
    trimmed_mean = float(stats.trim_mean(values, min(0.49, 0.5 / math.sqrt(n - 4.0))))
    squares = float(((values - values.mean()) ** 2).sum())
    kurtosis = n * float(((values - trimmed_mean) ** 4).sum()) / squares**2
    correction = n / max(n - quantile, 1.0)
    standard_error = correction * math.sqrt(max((kurtosis - (n - 3.0) / n) / (n - 1.0), 0.0))
    centre = math.log(correction * squares / (n - 1.0))
    return math.exp(0.5 * (centre - quantile * standard_error)), math.exp(0.5 * (centre + quantile * standard_error))


def is_interpolated(n: int, probability: float) -> bool:
    """Return whether a quantile of n values has at least one value beyond it; otherwise it is an extrapolation."""
    return n * min(probability, 1.0 - probability) >= 1.0 - 1e-9


def quantile_bounds(
    sample: Float[np.ndarray, " n"], quantile: float, confidence: float, groups: Groups = None
) -> Interval:
    """One-sided lower and upper order-statistic bounds of a quantile, each at the confidence.

    -inf or inf if the sample is too small (upper bound of the 99 % quantile at 95 % confidence: fewer than 299 values).
    """
    check_confidence(confidence)
    values = np.asarray(sample, dtype=np.float64)
    if values.size == 0:
        return -math.inf, math.inf
    lower = -_bound_quantile(-values, groups, 1.0 - quantile, confidence)
    return lower, _bound_quantile(values, groups, quantile, confidence)


def _bound_quantile(values: Float[np.ndarray, " n"], groups: Groups, quantile: float, confidence: float) -> float:
    """Find the smallest sample value that is an upper bound of the quantile at the confidence; infinite if none is.

    Wilks 1941: the r-th smallest of n values lies at or above the quantile q with probability P(Bin(n, q) <= r - 1);
    the bound is the smallest value for which this probability is at least the confidence.
    """
    if groups is None or not is_shared(groups):
        # `ppf` gives the smallest k with P(Bin <= k) >= confidence; the value of 1-based rank k + 1 is the bound
        rank = int(stats.binom.ppf(confidence, values.size, quantile))
        return float(np.sort(values)[rank]) if rank < values.size else math.inf
    index = number_terrains(groups)
    counted = select_counted(index)
    values, index = values[counted], index[counted]
    # of the sorted values; each has `larger` larger values on its terrain
    order = np.argsort(values, kind="stable")
    ordered, index = values[order], index[order]
    sizes = count_sizes(np.bincount(index))
    limit = max_statistic(sizes, 1.0 - quantile, 1.0 - confidence)
    larger = pd.Series(index[::-1]).groupby(index[::-1]).cumcount().to_numpy()
    # statistic of the values from each rank on, and beyond the largest value
    statistic = np.append(np.cumsum(np.diff(event_scores(sizes))[larger])[::-1], 0)
    is_bound = statistic[1:] <= limit
    return float(ordered[np.argmax(is_bound)]) if is_bound.any() else math.inf
