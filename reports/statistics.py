"""Intervals and sample sizes of success rates, and what a sample of errors says: numbers in, numbers out.

Success rates are bounded by the exact binomial interval of Clopper & Pearson ("The use of confidence or fiducial limits
illustrated in the case of the binomial", Biometrika 26, 1934). Quantiles are bounded by order statistics, free of any
assumption about the distribution (Wilks, "Determination of sample sizes for setting tolerance limits", Ann. Math.
Statist. 12, 1941). Means are bounded by the BCa bootstrap (Efron, "Better bootstrap confidence intervals", J. Amer.
Statist. Assoc. 82, 1987) as SciPy has it.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import stats

#: Above this many values the bootstrap's interval of a mean equals the central limit theorem's in what is printed.
_BOOTSTRAP_LARGEST_SAMPLE = 2000
_BOOTSTRAP_RESAMPLES = 2000
#: The bootstrap of a report draws from a fixed seed: the same rows give the same page.
_BOOTSTRAP_SEED = 19340401
_LARGEST_SAMPLE_SIZE = 2**40

#: A lower and an upper bound.
Interval = tuple[float, float]


def _check_confidence(confidence: float) -> None:
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"the confidence is {confidence}; it must lie between 0 and 1, both excluded")


def _check_counts(successes: float | int, n: float | int) -> None:
    if not 0 <= successes <= n:
        raise ValueError(f"{successes} successes of {n} cases; there can be none to all")


def proportion_lower(successes: float | int, n: float | int, confidence: float) -> float:
    """The one-sided lower Clopper-Pearson bound of a success rate.

    Parameters
    ----------
    successes, n
        Successes and cases; need not be whole (an effective sample size is not).
    confidence
        Probability, at least, that the bound lies below the true rate.

    Raises
    ------
    ValueError
        Where the counts or the confidence are out of range.

    Notes
    -----
    Clopper & Pearson 1934, by the quantile of the beta distribution. With no cases the bound is 0.
    """
    _check_confidence(confidence)
    _check_counts(successes, n)
    if successes <= 0:
        return 0.0
    return float(stats.beta.ppf(1.0 - confidence, successes, n - successes + 1.0))


def proportion_upper(successes: float | int, n: float | int, confidence: float) -> float:
    """The one-sided upper Clopper-Pearson bound of a success rate; see `proportion_lower`. With no cases it is 1."""
    _check_confidence(confidence)
    _check_counts(successes, n)
    return 1.0 - proportion_lower(n - successes, n, confidence)


def proportion_interval(successes: float | int, n: float | int, confidence: float) -> Interval:
    """The two-sided Clopper-Pearson interval with equal tails; see `proportion_lower`."""
    _check_confidence(confidence)
    one_sided = 0.5 * (1.0 + confidence)
    return proportion_lower(successes, n, one_sided), proportion_upper(successes, n, one_sided)


def minimum_sample_size(reliability: float, confidence: float, failures: int = 0) -> int:
    """The fewest cases that show a reliability at a confidence although so many of them failed.

    Notes
    -----
    The smallest n whose one-sided lower Clopper-Pearson bound with `failures` failures reaches `reliability`: for no
    failures the textbook ln(1 - confidence) / ln(reliability), rounded up.

    Raises
    ------
    ValueError
        Where the reliability or the confidence does not lie strictly between 0 and 1, or the failures are negative.
    """
    _check_confidence(confidence)
    if not 0.0 < reliability < 1.0:
        raise ValueError(f"the reliability is {reliability}; it must lie between 0 and 1, both excluded")
    if failures < 0:
        raise ValueError(f"{failures} failures; there cannot be fewer than none")
    enough = failures + 1
    while proportion_lower(enough - failures, enough, confidence) < reliability:
        enough *= 2
        if enough > _LARGEST_SAMPLE_SIZE:
            raise ValueError(f"no sample of practical size shows a reliability of {reliability}")
    too_few = failures
    while enough - too_few > 1:
        middle = (enough + too_few) // 2
        shown = proportion_lower(middle - failures, middle, confidence) >= reliability
        enough, too_few = (middle, too_few) if shown else (enough, middle)
    return enough


def further_cases_needed(n: int, failures: int, reliability: float, confidence: float) -> int:
    """How many more cases show the reliability at the confidence if none of them fails; 0 when it is shown."""
    return max(0, minimum_sample_size(reliability, confidence, failures) - n)


def quantile_bounds(sample: Float[np.ndarray, " n"], quantile: float, confidence: float) -> Interval:
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
    _check_confidence(confidence)
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


def mean_interval(sample: Float[np.ndarray, " n"], confidence: float) -> Interval:
    """Two-sided interval of the mean: BCa bootstrap, or the central limit theorem's in large samples.

    NaN for fewer than two values; the value itself where all are equal.
    """
    _check_confidence(confidence)
    values = np.asarray(sample, dtype=np.float64)
    if values.size < 2:
        return math.nan, math.nan
    mean, spread = float(values.mean()), float(values.std(ddof=1))
    if np.ptp(values) == 0.0:
        return mean, mean
    if values.size > _BOOTSTRAP_LARGEST_SAMPLE:
        half = float(stats.norm.ppf(0.5 * (1.0 + confidence))) * spread / math.sqrt(values.size)
        return mean - half, mean + half
    return _bootstrap_mean(values, confidence)


def _bootstrap_mean(values: Float[np.ndarray, " n"], confidence: float) -> Interval:
    with warnings.catch_warnings():
        # A degenerate bootstrap distribution (two values, say) is answered by NaN bounds, which the caller prints.
        warnings.simplefilter("ignore")
        result = stats.bootstrap(
            (values,),
            np.mean,
            confidence_level=confidence,
            n_resamples=_BOOTSTRAP_RESAMPLES,
            batch=200,
            vectorized=True,
            method="BCa",
            rng=np.random.default_rng(_BOOTSTRAP_SEED),
        )
    return float(result.confidence_interval.low), float(result.confidence_interval.high)


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
    sd, rms, median
        Standard deviation (n - 1), root mean square about zero, median.
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
) -> ErrorSummary:
    """Summarises a sample of errors; values that are not finite are counted as missing and left out.

    For radial errors the quantiles 0.5 and 0.95 are the circular error probable and the 95 % radius about the truth.
    """
    values = np.asarray(sample, dtype=np.float64)
    finite = values[np.isfinite(values)]
    n, missing = finite.size, values.size - finite.size
    median = float(np.median(finite)) if n else math.nan
    mean_lower, mean_upper = mean_interval(finite, confidence)
    return ErrorSummary(
        n=n,
        missing=missing,
        mean=float(finite.mean()) if n else math.nan,
        mean_lower=mean_lower,
        mean_upper=mean_upper,
        sd=float(finite.std(ddof=1)) if n > 1 else math.nan,
        rms=float(np.sqrt(np.mean(finite**2))) if n else math.nan,
        median=median,
        robust_sd=1.4826 * float(np.median(np.abs(finite - median))) if n else math.nan,
        largest=float(np.abs(finite).max()) if n else math.nan,
        quantiles=tuple(_quantile(finite, probability, confidence) for probability in quantiles),
        confidence=confidence,
    )


def _quantile(finite: Float[np.ndarray, " n"], probability: float, confidence: float) -> Quantile:
    # A quantile beyond all but the last value is an extrapolation, not an estimate.
    told = finite.size * min(probability, 1.0 - probability) >= 1.0 - 1e-9
    estimate = float(np.quantile(finite, probability)) if told else math.nan
    return Quantile(probability, estimate, *quantile_bounds(finite, probability, confidence))
