"""Intervals of a small probability from independent simulations (replicates) and from importance sampling."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import t as student_t

from marsyard.campaigns.json_numbers import Number

#: Number of replicates from which a study cannot be decided by more of them.
_MAX_REPLICATES = 10_000


@dataclass(frozen=True)
class ProbabilityInterval:
    """Estimate of a probability with its two-sided interval.

    - estimate, lower, upper: probability, and bounds of the interval
    - confidence: two-sided confidence; each bound alone holds at (1 + confidence) / 2
    - log_sd: standard deviation of a logarithm, for the reader: of the estimate of one replicate
      (`replicate_interval`), or of the mean of all cases (`weighted_interval`)
    """

    estimate: Number
    lower: float
    upper: float
    confidence: float
    log_sd: Number


def unknown_interval(confidence: float) -> ProbabilityInterval:
    """Return the interval from 0 to 1, without an estimate."""
    return ProbabilityInterval(math.nan, 0.0, 1.0, confidence, math.nan)


def replicate_interval(estimates: Sequence[float], confidence: float) -> ProbabilityInterval:
    """Compute the interval of a probability from independent estimates, at least two.

    Estimates of subset simulations are close to lognormal. Their relative bias is the sum of the covariances of the
    levels' relative errors (Au & Beck 2001), which is at most half of their relative variance. If it is not negative,
    the probability is between the median and the mean of the estimates. With the mean m and variance v of n logarithms,
    and Student's quantile t, the lower bound is that of the median, m - t sqrt(v / n), and the upper bound Cox's for
    the mean, m + v / 2 + t sqrt(v / n + v^2 / (2 (n - 1))) (Olsson 2005, Journal of Statistics Education 13).
    """
    values = np.array(estimates, dtype=np.float64)
    if values.size < 2:
        raise ValueError(f"an interval needs at least 2 replicates, not {values.size}")
    logarithms = np.log(values)
    centre, variance = float(logarithms.mean()), float(logarithms.var(ddof=1))
    quantile = _student_quantile(confidence, values.size)
    lower = math.exp(centre - quantile * math.sqrt(variance / values.size))
    upper_error = quantile * math.sqrt(variance / values.size + variance**2 / (2.0 * (values.size - 1)))
    upper = min(math.exp(centre + 0.5 * variance + upper_error), 1.0)
    return ProbabilityInterval(float(values.mean()), lower, upper, confidence, math.sqrt(variance))


def _student_quantile(confidence: float, replicates: int) -> float:
    return float(student_t.ppf(0.5 * (1.0 + confidence), replicates - 1))


def additional_replicates(estimates: Sequence[float], confidence: float, max_probability: float) -> int | None:
    """Estimate the number of additional replicates whose interval (`replicate_interval`) is above the limit.

    - estimates: estimates of the present replicates, at least two; their spread is assumed to remain the same
    - confidence: two-sided confidence of the next interval

    None if the median is not so far above the limit that fewer than `_MAX_REPLICATES` decide.
    """
    logarithms = np.log(estimates)
    deviation, distance = float(logarithms.std(ddof=1)), float(logarithms.mean()) - math.log(max_probability)
    for count in range(len(estimates) + 1, _MAX_REPLICATES if distance > 0.0 else 0):
        if _student_quantile(confidence, count) * deviation / math.sqrt(count) <= distance:
            return count - len(estimates)
    return None


def weighted_interval(contributions: Sequence[float], confidence: float) -> ProbabilityInterval:
    """Compute the interval of a probability from the weighted violations of independent cases (importance sampling).

    The logarithm of the mean is treated as normal; its standard deviation is the relative standard error of the mean.
    Without a violation the bounds are 0 and 1.
    """
    values = np.array(contributions, dtype=np.float64)
    mean = float(values.mean())
    if values.size < 2 or mean <= 0.0:
        return ProbabilityInterval(0.0, 0.0, 1.0, confidence, math.inf)
    relative_error = float(values.std(ddof=1)) / math.sqrt(values.size) / mean
    factor = math.exp(float(student_t.ppf(0.5 * (1.0 + confidence), values.size - 1)) * relative_error)
    return ProbabilityInterval(mean, mean / factor, min(mean * factor, 1.0), confidence, relative_error)


def effective_number(weights: Sequence[float]) -> float:
    """Compute the number of equally weighted cases that are equivalent to these weights (Kish 1965); 0 without any."""
    values = np.array(weights, dtype=np.float64)
    square_sum = float(np.sum(values**2))
    return float(values.sum()) ** 2 / square_sum if square_sum > 0.0 else 0.0


def enclose(first: ProbabilityInterval, second: ProbabilityInterval) -> ProbabilityInterval:
    """Return the first interval, extended so that it contains the second one."""
    return replace(first, lower=min(first.lower, second.lower), upper=max(first.upper, second.upper))
