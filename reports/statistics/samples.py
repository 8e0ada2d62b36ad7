"""Statistics of samples: quantiles, mean and spread, each with bounds.

Quantiles are bounded by order statistics, for any distribution (Wilks, "Determination of sample sizes for setting
tolerance limits", Ann. Math. Statist. 12, 1941; as Hanson & Beard use them for a stated consumer risk,
NASA/TP-2010-216447). Means and spreads are bounded by SciPy's BCa bootstrap (Efron, "Better bootstrap confidence
intervals", J. Amer. Statist. Assoc. 82, 1987), at the level of Student's t instead of the normal distribution
(Hesterberg, "What teachers should know about the bootstrap", Amer. Statist. 69, 2015), since BCa alone covers too
little in small samples. A spread's interval contains Bonett's ("Approximate confidence interval for standard deviation
of nonnormal distributions", Comput. Statist. Data Anal. 50, 2006).

Values that share terrains (`groups`) are correlated; the terrain is the sampling unit. Mean and standard deviation: BCa
bootstrap of whole terrains (Davison & Hinkley, "Bootstrap methods and their application", 1997, section 3.8), widened
for few of them as for single values; it contains Student's interval with the variance over terrains (Taylor
linearisation; Cochran, "Sampling techniques", 1977, section 6). Quantiles: order statistics, with the counts of
`marsyard.reports.statistics.clusters`: the effective number of values (Woodruff, J. Amer. Statist. Assoc. 47, 1952,
with Korn & Graubard's number), or whole terrains where too few of them lie on either side.

`python -m benchmarks.validation --only intervals --only shared` measures the coverage of all of these.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

from marsyard.reports.statistics.clusters import ClusterMethod, clustered_evidence, terrain_index
from marsyard.reports.statistics.proportions import Interval, check_confidence, proportion_lower

#: Number of values (or terrains) above which the bootstrap's interval equals the large-sample one as printed.
_MAX_BOOTSTRAP = 2000
_RESAMPLES = 2000
#: Fixed seed: the same rows give the same page.
_SEED = 19340401


def bca(data: Sequence[Float[np.ndarray, " n"]], statistic: Callable[..., Any], confidence: float) -> Interval:
    """Two-sided interval of a statistic of one or more columns, resampled together; NaN where there is none."""
    with warnings.catch_warnings():
        # a degenerate bootstrap distribution (of two values, for example) gives NaN bounds
        warnings.simplefilter("ignore")
        result = stats.bootstrap(
            tuple(data),
            statistic,
            paired=True,
            confidence_level=_widened(confidence, data[0].size),
            n_resamples=_RESAMPLES,
            batch=200,
            vectorized=True,
            method="BCa",
            rng=np.random.default_rng(_SEED),
        )
    return float(result.confidence_interval.low), float(result.confidence_interval.high)


def _widened(confidence: float, n: int) -> float:
    """Level at which the normal quantile equals Student's times sqrt(n / (n - 1)): Hesterberg 2015, section 5."""
    quantile = float(stats.t.ppf(0.5 * (1.0 + confidence), n - 1)) * math.sqrt(n / (n - 1.0))
    # below 1, which the bootstrap does not accept
    return min(2.0 * float(stats.norm.cdf(quantile)) - 1.0, 1.0 - 1e-6)


#: Minimum number of terrains to estimate the spread between them.
FEWEST_TERRAINS = 5


def is_shared(groups: Int[np.ndarray, " n"] | None) -> bool:
    """Whether any two values are from one terrain."""
    return groups is not None and groups.size > 0 and int(terrain_index(groups).max()) + 1 < groups.size


def shared_mean(values: Float[np.ndarray, " n"], groups: Int[np.ndarray, " n"], confidence: float) -> Interval:
    """Two-sided interval of the mean of finite values on shared terrains; NaN for fewer than five terrains."""
    index = terrain_index(groups)
    sizes, sums = np.bincount(index).astype(np.float64), np.bincount(index, weights=values)
    terrains = sizes.size
    if terrains < FEWEST_TERRAINS:
        return math.nan, math.nan
    mean = float(values.mean())
    half = _student(confidence, terrains) * _deviation_of_mean(sums - mean * sizes, values.size)
    plain = mean - half, mean + half
    if terrains > _MAX_BOOTSTRAP:
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
    # of the logarithm, which is less skewed, corrected for few terrains as Bonett's interval is for few values
    quantile = _student(confidence, terrains)
    correction = terrains / max(terrains - quantile, 1.0)
    half = quantile * correction * _deviation_of_mean(squares - variance * sizes, values.size) / variance
    middle = math.log(correction * variance)
    plain = math.exp(0.5 * (middle - half)), math.exp(0.5 * (middle + half))
    if terrains > _MAX_BOOTSTRAP:
        return plain
    return _union(plain, bca((squares, sums, sizes), _spread, confidence))


def shared_quantile(
    values: Float[np.ndarray, " n"], groups: Int[np.ndarray, " n"], quantile: float, confidence: float
) -> Interval:
    """One-sided bounds of a quantile of values on shared terrains; infinite where the sample is too small."""
    lower = -_upper_bound(-values, groups, 1.0 - quantile, confidence)
    return lower, _upper_bound(values, groups, quantile, confidence)


def _upper_bound(
    values: Float[np.ndarray, " n"], groups: Int[np.ndarray, " n"], quantile: float, confidence: float
) -> float:
    """Smallest value of the sample below which at least a fraction `quantile` of the population lies, at the
    confidence.
    """
    ordered = np.sort(values)
    n = ordered.size
    below = values <= ordered[min(n - 1, max(0, math.ceil(quantile * n) - 1))]
    shown = clustered_evidence(below, groups, confidence)
    if shown.method is ClusterMethod.TERRAIN_COUNT:
        # a bound for the maximum of a terrain also holds for its values
        index = terrain_index(groups)
        ordered = np.full(int(index.max()) + 1, -math.inf)
        np.maximum.at(ordered, index, values)
        ordered, worth = np.sort(ordered), 1.0
    else:
        worth = shown.effective_n / n
    return _least_rank(ordered, worth, quantile, confidence)


def _least_rank(ordered: Float[np.ndarray, " n"], worth: float, quantile: float, confidence: float) -> float:
    """First of the ordered values whose rank shows the quantile, each counting as `worth` values; inf for none."""
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


#: Terrain number of each value; None where all are independent.
Groups = Int[np.ndarray, " n"] | None
#: Minimum number of values to estimate their spread.
_MIN_FOR_SPREAD = 8


def quantile_bounds(
    sample: Float[np.ndarray, " n"], quantile: float, confidence: float, groups: Groups = None
) -> Interval:
    """One-sided lower and upper order-statistic bounds of a quantile, each at the confidence.

    -inf or inf where the sample is too small (upper bound of the 99 % quantile at 95 % confidence: fewer than 299
    values).
    Wilks 1941: the r-th smallest of n values lies at or above the quantile q with probability P(Bin(n, q) <= r - 1);
    the upper bound is the smallest such value with that probability at the confidence.
    """
    check_confidence(confidence)
    if groups is not None and is_shared(groups):
        return shared_quantile(np.asarray(sample, dtype=np.float64), groups, quantile, confidence)
    ordered = np.sort(np.asarray(sample, dtype=np.float64))
    n = ordered.size
    if n == 0:
        return -math.inf, math.inf
    lower = -_upper_order_bound(-ordered[::-1], 1.0 - quantile, confidence)
    return lower, _upper_order_bound(ordered, quantile, confidence)


def _upper_order_bound(ordered: Float[np.ndarray, " n"], quantile: float, confidence: float) -> float:
    """Smallest of the ordered values that bounds the quantile from above at the confidence."""
    n = ordered.size
    # `ppf` gives the smallest k with P(Bin <= k) >= confidence; the value of 1-based rank k + 1 is the bound.
    rank = int(stats.binom.ppf(confidence, n, quantile))
    return float(ordered[rank]) if rank < n else math.inf


def mean_interval(sample: Float[np.ndarray, " n"], confidence: float, groups: Groups = None) -> Interval:
    """Two-sided interval of the mean: BCa bootstrap, or the central limit theorem in large samples.

    NaN for fewer than two values, or five terrains; the value itself where all are equal.
    """
    check_confidence(confidence)
    values = np.asarray(sample, dtype=np.float64)
    if values.size < 2:
        return math.nan, math.nan
    mean, spread = float(values.mean()), float(values.std(ddof=1))
    if np.ptp(values) == 0.0:
        return mean, mean
    if groups is not None and is_shared(groups):
        return shared_mean(values, groups, confidence)
    if values.size > _MAX_BOOTSTRAP:
        half = float(stats.norm.ppf(0.5 * (1.0 + confidence))) * spread / math.sqrt(values.size)
        return mean - half, mean + half
    return bca((values,), np.mean, confidence)


def spread_interval(sample: Float[np.ndarray, " n"], confidence: float, groups: Groups = None) -> Interval:
    """Two-sided interval of the standard deviation: union of BCa bootstrap and Bonett's; in large samples Bonett's
    alone.

    NaN for fewer than eight values, or five terrains; 0 where all are equal.
    """
    check_confidence(confidence)
    values = np.asarray(sample, dtype=np.float64)
    if values.size < _MIN_FOR_SPREAD:
        return math.nan, math.nan
    if np.ptp(values) == 0.0:
        return 0.0, 0.0
    if groups is not None and is_shared(groups):
        return shared_spread(values, groups, confidence)
    lower, upper = _bonett(values, confidence)
    if values.size > _MAX_BOOTSTRAP:
        return lower, upper
    resampled = bca((values,), _deviation, confidence)
    return float(np.fmin(lower, resampled[0])), float(np.fmax(upper, resampled[1]))


def _deviation(values: Float[np.ndarray, " *n"], axis: int = -1) -> Any:
    return np.std(values, axis=axis, ddof=1)


def _bonett(values: Float[np.ndarray, " n"], confidence: float) -> Interval:
    """Bonett 2006, equation 8, with Student's t for the normal quantile."""
    n = values.size
    quantile = float(stats.t.ppf(0.5 * (1.0 + confidence), n - 1))
    trimmed = float(stats.trim_mean(values, min(0.49, 0.5 / math.sqrt(n - 4.0))))
    squares = float(((values - values.mean()) ** 2).sum())
    kurtosis = n * float(((values - trimmed) ** 4).sum()) / squares**2
    correction = n / (n - quantile)
    error = correction * math.sqrt(max((kurtosis - (n - 3.0) / n) / (n - 1.0), 0.0))
    middle = math.log(correction * squares / (n - 1.0))
    return math.exp(0.5 * (middle - quantile * error)), math.exp(0.5 * (middle + quantile * error))


@dataclass(frozen=True)
class Quantile:
    """Quantile of a sample: probability, estimate and one-sided bounds (infinite where n is too small)."""

    probability: float
    estimate: float
    lower: float
    upper: float


@dataclass(frozen=True)
class ErrorSummary:
    """Summary of a sample of errors; NaN where it has too few values.

    n, missing: finite values, and others (no answer was reported).
    mean, mean_lower, mean_upper: mean and its two-sided interval at `confidence`.
    sd, sd_lower, sd_upper: standard deviation (n - 1) and its two-sided interval at `confidence`.
    rms, median: root mean square about zero, median.
    robust_sd: median absolute deviation about the median times 1.4826, the standard deviation of a normal core.
    largest: largest magnitude.
    quantiles: with order-statistic bounds at `confidence`.
    """

    n: int
    missing: int
    mean: float
    mean_lower: float
    mean_upper: float
    sd: float
    sd_lower: float
    sd_upper: float
    rms: float
    median: float
    robust_sd: float
    largest: float
    quantiles: tuple[Quantile, ...]
    confidence: float


def summarize(
    sample: Float[np.ndarray, " n"],
    quantiles: tuple[float, ...] = (0.5, 0.95, 0.99),
    confidence: float = 0.95,
    groups: Groups = None,
) -> ErrorSummary:
    """Summarize a sample of errors; values that are not finite are counted as missing and left out.

    For radial errors the quantiles 0.5 and 0.95 are the circular error probable and the 95 % radius about the truth.
    """
    values = np.asarray(sample, dtype=np.float64)
    finite, shared = values[np.isfinite(values)], None if groups is None else groups[np.isfinite(values)]
    n, missing = finite.size, values.size - finite.size
    median = float(np.median(finite)) if n else math.nan
    mean_lower, mean_upper = mean_interval(finite, confidence, shared)
    sd_lower, sd_upper = spread_interval(finite, confidence, shared)
    return ErrorSummary(
        n=n,
        missing=missing,
        mean=float(finite.mean()) if n else math.nan,
        mean_lower=mean_lower,
        mean_upper=mean_upper,
        sd=float(finite.std(ddof=1)) if n > 1 else math.nan,
        sd_lower=sd_lower,
        sd_upper=sd_upper,
        rms=float(np.sqrt(np.mean(finite**2))) if n else math.nan,
        median=median,
        robust_sd=1.4826 * float(np.median(np.abs(finite - median))) if n else math.nan,
        largest=float(np.abs(finite).max()) if n else math.nan,
        quantiles=tuple(_quantile(finite, probability, confidence, shared) for probability in quantiles),
        confidence=confidence,
    )


def _quantile(finite: Float[np.ndarray, " n"], probability: float, confidence: float, groups: Groups) -> Quantile:
    # A quantile beyond all but the last value is an extrapolation, not an estimate.
    is_estimate = finite.size * min(probability, 1.0 - probability) >= 1.0 - 1e-9
    estimate = float(np.quantile(finite, probability)) if is_estimate else math.nan
    return Quantile(probability, estimate, *quantile_bounds(finite, probability, confidence, groups))
