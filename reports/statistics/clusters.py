"""Success rates from cases that share terrains: such cases are correlated, and n overstates the evidence.

Korn & Graubard ("Confidence intervals for proportions with small expected number of positive counts estimated from
survey data", Survey Methodology 24, 1998) use an effective sample size in the Clopper-Pearson interval: n divided by
the design effect, which is estimated from the terrains' failure rates. With few failures that estimate is unreliable
and the method passes falsely. Then whole terrains are counted, each as one case, or the rate of the cases is attributed
to as many independent ones as there are terrains, whichever is safer.

The bounds hold for the rate of a case of the population, also where bad terrains answer less often than others
(`tests/reports/statistics/test_clusters.py`). The lower bound does not hold where rare failing terrains have several
times as many cases as others: at a nominal 10 % it missed in 16 to 33 % of simulated campaigns, mostly those that drew
none of these terrains.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats

from marsyard.reports.statistics.proportions import proportion_lower, proportion_upper

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
