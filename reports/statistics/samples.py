"""What a sample of numbers says: quantiles, mean, spread, each with bounds.

Quantiles are bounded by order statistics, free of any assumption about the distribution (Wilks, "Determination of
sample sizes for setting tolerance limits", Ann. Math. Statist. 12, 1941; as Hanson & Beard use them for a stated
consumer risk, NASA/TP-2010-216447). Means and spreads are bounded by the BCa bootstrap (`.bootstrap`); a spread's
interval reaches at least as far as Bonett's ("Approximate confidence interval for standard deviation of nonnormal
distributions", Comput. Statist. Data Anal. 50, 2006), since BCa alone covers too little in small samples.
Where values share terrains (`groups`) all of these are by terrains: `marsyard.reports.statistics.shared`. `python -m
benchmarks.validation --only intervals --only shared` measures their coverage.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

from marsyard.reports.statistics.bootstrap import LARGEST_SAMPLE, bca
from marsyard.reports.statistics.proportions import Interval, check_confidence
from marsyard.reports.statistics.shared import is_shared, shared_mean, shared_quantile, shared_spread

#: Which values are from one terrain: its number for each; None where all are independent.
Groups = Int[np.ndarray, " n"] | None
#: Fewest values that say anything of their spread.
_FEWEST_OF_SPREAD = 8


def quantile_bounds(
    sample: Float[np.ndarray, " n"], quantile: float, confidence: float, groups: Groups = None
) -> Interval:
    """One-sided lower and upper order-statistic bounds of a quantile, each at the confidence.

    Returns
    -------
    lower, upper
        The bounds; -inf or inf where the sample is too small to give one (for the upper bound of the 99 % quantile at
        95 % confidence: fewer than 299 values).

    Notes
    -----
    Wilks 1941. The r-th smallest of n values lies at or above the quantile q with probability
    P(Bin(n, q) <= r - 1): the upper bound is the smallest such value with that probability at the confidence.
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
    """The smallest of the ordered values that bounds the quantile from above at the confidence."""
    n = ordered.size
    # `ppf` gives the smallest k with P(Bin <= k) >= confidence; the value of 1-based rank k + 1 is the bound.
    rank = int(stats.binom.ppf(confidence, n, quantile))
    return float(ordered[rank]) if rank < n else math.inf


def mean_interval(sample: Float[np.ndarray, " n"], confidence: float, groups: Groups = None) -> Interval:
    """Two-sided interval of the mean: BCa bootstrap, or the central limit theorem's in large samples.

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
    if values.size > LARGEST_SAMPLE:
        half = float(stats.norm.ppf(0.5 * (1.0 + confidence))) * spread / math.sqrt(values.size)
        return mean - half, mean + half
    return bca((values,), np.mean, confidence)


def spread_interval(sample: Float[np.ndarray, " n"], confidence: float, groups: Groups = None) -> Interval:
    """Two-sided interval of the standard deviation: BCa bootstrap and Bonett's, whichever reaches further.

    NaN for fewer than eight values, or five terrains; 0 where all are equal. In large samples Bonett's alone.
    """
    check_confidence(confidence)
    values = np.asarray(sample, dtype=np.float64)
    if values.size < _FEWEST_OF_SPREAD:
        return math.nan, math.nan
    if np.ptp(values) == 0.0:
        return 0.0, 0.0
    if groups is not None and is_shared(groups):
        return shared_spread(values, groups, confidence)
    lower, upper = _bonett(values, confidence)
    if values.size > LARGEST_SAMPLE:
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
    """One quantile of a sample: probability, estimate and one-sided bounds (infinite where n does not allow one)."""

    probability: float
    estimate: float
    lower: float
    upper: float


@dataclass(frozen=True)
class ErrorSummary:
    """What a sample of errors says; NaN where it has too few values to say it.

    Attributes
    ----------
    n, missing
        Finite values, and those that were not finite (no answer was reported).
    mean, mean_lower, mean_upper
        Mean and its two-sided interval at `confidence`.
    sd, sd_lower, sd_upper
        Standard deviation (n - 1) and its two-sided interval at `confidence`.
    rms, median
        Root mean square about zero, median.
    robust_sd
        Median absolute deviation about the median times 1.4826: the standard deviation of a normal core.
    largest
        The largest magnitude.
    quantiles
        Quantiles with order-statistic bounds at `confidence`.
    confidence
        Confidence of the bounds.
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
    """Summarises a sample of errors; values that are not finite are counted as missing and left out.

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
    told = finite.size * min(probability, 1.0 - probability) >= 1.0 - 1e-9
    estimate = float(np.quantile(finite, probability)) if told else math.nan
    return Quantile(probability, estimate, *quantile_bounds(finite, probability, confidence, groups))
