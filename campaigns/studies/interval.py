"""Intervals of a small probability from independent simulations (replicates), and the verdict on its upper limit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from scipy.stats import t as student_t


class RareVerdict(StrEnum):
    """Verdict on a probability that must not exceed a limit."""

    PASS = "PASS"  # noqa: S105  (a verdict, not a password)
    FAIL = "FAIL"
    INSUFFICIENT = "INSUFFICIENT"


@dataclass(frozen=True)
class ProbabilityInterval:
    """Estimate of a probability with its two-sided interval.

    - estimate, lower, upper: probability, and bounds of the interval
    - confidence: two-sided confidence; each bound alone holds at (1 + confidence) / 2
    - log_sd: standard deviation of the logarithm of one replicate's estimate
    """

    estimate: float
    lower: float
    upper: float
    confidence: float
    log_sd: float


def replicate_interval(estimates: Sequence[float], reached: Sequence[bool], confidence: float) -> ProbabilityInterval:
    """Compute the interval of a probability from independent estimates, at least two.

    reached: whether each replicate reached a violation

    Estimates of subset simulations are close to lognormal and unbiased. The interval is Cox's for the mean of a
    lognormal distribution with Student's t quantile (Olsson 2005, Journal of Statistics Education 13): with the mean m
    and variance v of n logarithms, m + v / 2 +- t sqrt(v / n + v^2 / (2 (n - 1))). If a replicate
    reached no violation, its estimate is an upper limit, and the lower bound is 0.
    """
    values = np.array(estimates, dtype=np.float64)
    count = values.size
    if count < 2:
        raise ValueError(f"an interval needs at least 2 replicates, not {count}")
    logarithms = np.log(values)
    variance = float(logarithms.var(ddof=1))
    centre = float(logarithms.mean()) + 0.5 * variance
    quantile = float(student_t.ppf(0.5 * (1.0 + confidence), count - 1))
    half_width = quantile * math.sqrt(variance / count + variance**2 / (2.0 * (count - 1)))
    lower = math.exp(centre - half_width) if all(reached) else 0.0
    return ProbabilityInterval(
        float(values.mean()), lower, min(math.exp(centre + half_width), 1.0), confidence, math.sqrt(variance)
    )


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


def decide(interval: ProbabilityInterval, max_probability: float) -> RareVerdict:
    """Compare the bounds of a probability with its limit."""
    if interval.upper <= max_probability:
        return RareVerdict.PASS
    return RareVerdict.FAIL if interval.lower > max_probability else RareVerdict.INSUFFICIENT


def additional_replicates(interval: ProbabilityInterval, replicates: int, max_probability: float) -> int | None:
    """Estimate the number of additional replicates that decide the verdict.

    None if the estimate is so close to the limit that fewer than 10,000 replicates do not decide it.
    The spread of the replicates is assumed to remain the same.
    """
    distance = abs(math.log(max_probability / interval.estimate)) if interval.estimate > 0.0 else math.inf
    if distance == 0.0:
        return None
    variance, confidence = interval.log_sd**2, interval.confidence
    for count in range(replicates + 1, 10_000):
        quantile = float(student_t.ppf(0.5 * (1.0 + confidence), count - 1))
        if quantile * math.sqrt(variance / count + variance**2 / (2.0 * (count - 1))) <= distance:
            return count - replicates
    return None
