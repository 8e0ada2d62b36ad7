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

    Estimates of subset simulations are close to lognormal; their bias is small compared with the interval of a few
    replicates (docs/rare-violations.md). The interval is Cox's for the mean of a lognormal distribution with Student's
    t quantile (Olsson 2005, Journal of Statistics Education 13): with the mean m and variance v of n logarithms,
    m + v / 2 +- t sqrt(v / n + v^2 / (2 (n - 1))).
    """
    values = np.array(estimates, dtype=np.float64)
    if values.size < 2:
        raise ValueError(f"an interval needs at least 2 replicates, not {values.size}")
    logarithms = np.log(values)
    variance = float(logarithms.var(ddof=1))
    centre = float(logarithms.mean()) + 0.5 * variance
    half_width = _log_half_width(variance, values.size, confidence)
    lower, upper = math.exp(centre - half_width), min(math.exp(centre + half_width), 1.0)
    return ProbabilityInterval(float(values.mean()), lower, upper, confidence, math.sqrt(variance))


def _log_half_width(variance: float, replicates: int, confidence: float) -> float:
    """Compute the half-width of Cox's interval, as a logarithm, from the variance of the logarithms of estimates."""
    quantile = float(student_t.ppf(0.5 * (1.0 + confidence), replicates - 1))
    return quantile * math.sqrt(variance / replicates + variance**2 / (2.0 * (replicates - 1)))


def additional_replicates(estimates: Sequence[float], confidence: float, max_probability: float) -> int | None:
    """Estimate the number of additional replicates whose interval (`replicate_interval`) excludes the limit.

    - estimates: estimates of the present replicates, at least two; their spread is assumed to remain the same
    - confidence: two-sided confidence of the next interval

    None if the estimate is so close to the limit that fewer than `_MAX_REPLICATES` do not decide.
    """
    variance = float(np.log(estimates).var(ddof=1))
    distance = abs(math.log(max_probability / float(np.mean(estimates))))
    for count in range(len(estimates) + 1, _MAX_REPLICATES if distance > 0.0 else 0):
        if _log_half_width(variance, count, confidence) <= distance:
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
