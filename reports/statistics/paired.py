"""Two algorithms on the same cases: whether one succeeds more often, and whose errors are smaller.

Successes: McNemar's test with the exact binomial distribution (Psychometrika 12, 1947) on the cases in which just one
succeeds. Errors: Wilcoxon's signed ranks on the differences. Where cases share terrains, the terrain is the pair: the
sums of its differences are symmetric about zero if the algorithms are alike, however much its cases go together.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats

from marsyard.reports.statistics.clusters import terrain_index
from marsyard.reports.statistics.samples import Groups, mean_interval
from marsyard.reports.statistics.shared import is_shared


def compared_successes(
    first: Bool[np.ndarray, " n"], other: Bool[np.ndarray, " n"], groups: Groups = None
) -> tuple[int, int, float]:
    """Cases in which just the first and just the other succeeds, and the two-sided probability of so uneven a split."""
    only_first, only_other = int((first & ~other).sum()), int((other & ~first).sum())
    if groups is not None and is_shared(groups):
        return only_first, only_other, _signed_ranks_p(_sums(other.astype(np.float64) - first, groups))
    total = only_first + only_other
    p = 1.0 if total == 0 else float(stats.binomtest(only_first, total, 0.5).pvalue)
    return only_first, only_other, p


def compared_errors(
    differences: Float[np.ndarray, " n"], groups: Groups, confidence: float
) -> tuple[float, float, float, float]:
    """Mean of paired differences, its interval, and the two-sided probability that they are symmetric about zero.

    NaN for no pairs; the interval is NaN for one.
    """
    if differences.size == 0:
        return math.nan, math.nan, math.nan, math.nan
    mean, interval = float(differences.mean()), mean_interval(differences, confidence, groups)
    sums = _sums(differences, groups) if groups is not None and is_shared(groups) else differences
    return mean, *interval, _signed_ranks_p(sums)


def _sums(differences: Float[np.ndarray, " n"], groups: Int[np.ndarray, " n"]) -> Float[np.ndarray, " terrains"]:
    return np.bincount(terrain_index(groups), weights=differences)


def _signed_ranks_p(differences: Float[np.ndarray, " n"]) -> float:
    """Wilcoxon's two-sided p; 1 where nothing differs."""
    moved = differences[differences != 0.0]
    return 1.0 if moved.size == 0 else float(stats.wilcoxon(moved).pvalue)
