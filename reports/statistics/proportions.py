"""Success rates: exact binomial bounds, also for cases that share terrains, and the number of cases required.

Bounds: Clopper & Pearson, "The use of confidence or fiducial limits illustrated in the case of the binomial",
Biometrika 26, 1934.
"""

from __future__ import annotations

import bisect
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats

_LARGEST_SAMPLE_SIZE = 2**40
#: A lower and an upper bound.
Interval = tuple[float, float]


def check_confidence(confidence: float) -> None:
    """Raise ValueError where a confidence does not lie between 0 and 1."""
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"the confidence is {confidence}; it must lie between 0 and 1, both excluded")


def _check_counts(successes: float | int, n: float | int) -> None:
    if not 0 <= successes <= n:
        raise ValueError(f"{successes} successes of {n} cases; there can be none to all")


def proportion_lower(successes: float | int, n: float | int, confidence: float) -> float:
    """One-sided lower Clopper-Pearson bound of a success rate, by the beta quantile; 0 for no cases.

    The numbers need not be whole (an effective sample size is not). Raises ValueError where they or the confidence are
    out of range.
    """
    check_confidence(confidence)
    _check_counts(successes, n)
    if successes <= 0:
        return 0.0
    return float(stats.beta.ppf(1.0 - confidence, successes, n - successes + 1.0))


def proportion_upper(successes: float | int, n: float | int, confidence: float) -> float:
    """One-sided upper Clopper-Pearson bound of a success rate; see `proportion_lower`. 1 for no cases."""
    check_confidence(confidence)
    _check_counts(successes, n)
    return 1.0 - proportion_lower(n - successes, n, confidence)


def proportion_interval(successes: float | int, n: float | int, confidence: float) -> Interval:
    """Two-sided Clopper-Pearson interval with equal tails; see `proportion_lower`."""
    check_confidence(confidence)
    one_sided = 0.5 * (1.0 + confidence)
    return proportion_lower(successes, n, one_sided), proportion_upper(successes, n, one_sided)


def minimum_sample_size(reliability: float, confidence: float, failures: int = 0) -> int:
    """Smallest number of cases that shows a reliability at a confidence with a given number of failures.

    The one-sided lower Clopper-Pearson bound reaches the reliability: without failures at the textbook
    ln(1 - confidence) / ln(reliability), rounded up. Raises ValueError where reliability or confidence do not lie
    strictly between 0 and 1, or the failures are negative.
    """
    check_confidence(confidence)
    if not 0.0 < reliability < 1.0:
        raise ValueError(f"the reliability is {reliability}; it must lie between 0 and 1, both excluded")
    if failures < 0:
        raise ValueError(f"{failures} failures; there cannot be fewer than none")

    def is_shown(cases: int) -> bool:
        return proportion_lower(cases - failures, cases, confidence) >= reliability

    upper = failures + 1
    while not is_shown(upper):
        upper *= 2
        if upper > _LARGEST_SAMPLE_SIZE:
            raise ValueError(f"no sample of practical size shows a reliability of {reliability}")
    cases = range(failures + 1, upper)
    return cases.start + bisect.bisect_left(cases, True, key=is_shown)


def further_cases_needed(n: int, failures: int, reliability: float, confidence: float) -> int:
    """Number of additional cases without failure that show the reliability at the confidence; 0 when it is shown."""
    return max(0, minimum_sample_size(reliability, confidence, failures) - n)


def consumer_risk(successes: float | int, n: float | int, rate: float) -> float:
    """Probability of evidence at least as good if the true rate only just equals `rate`; 1 for no successes.

    It is at most 1 - confidence exactly where the one-sided lower Clopper-Pearson bound at that confidence reaches the
    rate (Hanson & Beard, NASA/TP-2010-216447).
    """
    _check_counts(successes, n)
    return 1.0 if successes <= 0 else float(stats.beta.cdf(rate, successes, n - successes + 1.0))


#: Minimum number of terrains, and of terrains with a failure (and with a success), to estimate the design effect.
#: Chosen by simulation (`tests/reports/statistics/test_clusters.py`) so that the bounds keep their confidence.
_MIN_TERRAINS = 50
_MIN_MIXED_TERRAINS = 10


class ClusterMethod(StrEnum):
    """Method of the bounds of clustered cases."""

    KORN_GRAUBARD = "Korn-Graubard effective sample size"
    TERRAIN_COUNT = "whole terrains counted"


@dataclass(frozen=True)
class ClusteredEvidence:
    """Evidence for a success rate from cases that share terrains.

    terrains, failed_terrains: distinct terrains, and those on which at least one case failed.
    method: method of the bounds.
    design_effect: variance of the success rate over that of as many independent cases; NaN where it cannot be
    estimated. effective_n, effective_successes: equivalent independent cases, and successes that give the lower bound.
    lower, upper: one-sided bounds of the success rate of a case, each at the requirement's confidence.
    """

    terrains: int
    failed_terrains: int
    method: ClusterMethod
    design_effect: float
    effective_n: float
    effective_successes: float
    lower: float
    upper: float


def clustered_evidence(
    success: Bool[np.ndarray, " n"], terrain: Int[np.ndarray, " n"], confidence: float
) -> ClusteredEvidence:
    """Bounds of a success rate, each at `confidence`, for at least one case; `terrain` numbers the terrain of each.

    Few terrains with failures or successes are counted whole. Otherwise the bounds are those of Clopper and Pearson
    with the effective sample size of Korn & Graubard 1998, never larger than n.
    """
    index = number_terrains(terrain)
    sizes = np.bincount(index).astype(np.float64)
    successes = np.bincount(index, weights=success.astype(np.float64))
    failed, succeeded = int((successes < sizes).sum()), int((successes > 0).sum())
    n, terrains = float(sizes.sum()), sizes.size
    if terrains >= _MIN_TERRAINS and min(failed, succeeded) >= _MIN_MIXED_TERRAINS:
        method, design_effect = ClusterMethod.KORN_GRAUBARD, _estimate_design_effect(successes, sizes)
        # The second factor pays for estimating the variance from so many terrains only.
        freedom = (stats.t.ppf(confidence, n - 1) / stats.t.ppf(confidence, terrains - 1)) ** 2
        effective_n = min(n, n / max(design_effect, 1e-9) * float(freedom))
        min_successes = max_successes = float(successes.sum() / n * effective_n)
    else:
        # With equally many cases on each, a terrain has a failure at least as often as a case fails, and a success at
        # least as often as a case succeeds: both bounds are safe. Where bad terrains have fewer cases (they answer less
        # often) or more, the rate of the cases is on the safe side of the terrains' rate for one of the two bounds.
        method, design_effect, effective_n = ClusterMethod.TERRAIN_COUNT, float("nan"), float(terrains)
        of_cases = terrains * float(successes.sum() / n)
        min_successes, max_successes = min(float(terrains - failed), of_cases), max(float(succeeded), of_cases)
    lower = proportion_lower(min_successes, effective_n, confidence)
    upper = proportion_upper(max_successes, effective_n, confidence)
    return ClusteredEvidence(terrains, failed, method, design_effect, effective_n, min_successes, lower, upper)


def _estimate_design_effect(successes: Float[np.ndarray, " terrains"], sizes: Float[np.ndarray, " terrains"]) -> float:
    """Variance of the rate over terrains (Taylor linearisation) over the binomial one."""
    terrains, n = sizes.size, sizes.sum()
    rate = successes.sum() / n
    residuals = successes - rate * sizes
    variance = terrains / (terrains - 1) * float((residuals**2).sum()) / n**2
    return float(variance / (rate * (1.0 - rate) / n))


def number_terrains(terrain: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Consecutive terrain numbers from 0, in the order of the given ones."""
    first, last = int(terrain.min()), int(terrain.max())
    if last - first > 4 * terrain.size:
        return np.unique(terrain, return_inverse=True)[1]
    # without sorting, which takes most of a report of a million cases
    shifted = terrain - first
    return np.asarray((np.cumsum(np.bincount(shifted) > 0) - 1)[shifted])
