"""Tests of two results of the same cases: of two algorithms, or of two campaigns with the same draws.

Successes are compared by McNemar's test with the exact binomial distribution (Psychometrika 12, 1947). If cases share
terrains, the sums of the differences on each terrain are ranked (Wilcoxon's signed ranks): under the null hypothesis
these sums are symmetric about zero for any correlation within terrains.

- Errors of two algorithms: the mean of their differences is tested by random changes of signs (Fisher), of the sums of
  terrains if cases share terrains. Its interval contains the means that this test does not reject: their bounds are
  quantiles of the means of random subsets (Hartigan, "Using subsample values as typical values", J. Amer. Statist.
  Assoc. 64, 1969). Estimate, interval and p-value therefore refer to the same quantity. Both are exact if the two
  algorithms are exchangeable, and accurate for the mean of many skewed differences.
- Errors of two campaigns with the same draws: Wilcoxon's signed-rank test.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats

from marsyard.reports.statistics.clusters import number_terrains
from marsyard.reports.statistics.samples import Groups, is_shared

#: Fixed seed of the random subsets, for reproducible reports, and their number per batch.
_SEED, _BATCH = 19370101, 500
#: Maximum number of subsets of groups; maximum number of groups, above which a mean is normally distributed.
_MAX_SUBSETS, _MAX_FLIPPED = 10_000, 2_000


class SuccessDifference(NamedTuple):
    """Numbers of cases where only the first and only the other succeeds, and the two-sided p-value."""

    only_first: int
    only_other: int
    p_value: float


class ErrorDifference(NamedTuple):
    """Mean of paired differences, bounds of its interval, and the two-sided p-value of a mean of zero."""

    mean: float
    lower: float
    upper: float
    p_value: float


def compare_successes(
    first: Bool[np.ndarray, " n"], other: Bool[np.ndarray, " n"], groups: Groups = None
) -> SuccessDifference:
    """Compare the successes of the same cases."""
    only_first, only_other = int((first & ~other).sum()), int((other & ~first).sum())
    if groups is not None and is_shared(groups):
        p_value = _test_signed_ranks(_sum_groups(other.astype(np.float64) - first, groups))
        return SuccessDifference(only_first, only_other, p_value)
    total = only_first + only_other
    p_value = 1.0 if total == 0 else float(stats.binomtest(only_first, total, 0.5).pvalue)
    return SuccessDifference(only_first, only_other, p_value)


def compare_errors(differences: Float[np.ndarray, " n"], groups: Groups, confidence: float) -> ErrorDifference:
    """Compute the mean of paired differences, its interval, and the two-sided p-value of a mean of zero.

    Interval and p-value belong to one test: the interval contains zero if and only if the p-value is above
    1 - confidence. NaN for no pairs; the interval is NaN for too few pairs (or terrains) for its confidence.
    """
    if differences.size == 0:
        return ErrorDifference(math.nan, math.nan, math.nan, math.nan)
    sums, sizes = differences, np.ones(differences.size)
    if groups is not None and is_shared(groups):
        sums, sizes = _sum_groups(differences, groups), _sum_groups(np.ones(differences.size), groups)
    mean = float(differences.mean())
    if sums.size > _MAX_FLIPPED:
        error = math.sqrt(sums.size / (sums.size - 1.0) * float(((sums - mean * sizes) ** 2).sum())) / differences.size
        half_width = float(stats.norm.ppf(0.5 * (1.0 + confidence))) * error
        p_value = 1.0 if mean == 0.0 else float(2.0 * stats.norm.sf(abs(mean) / error)) if error > 0.0 else 0.0
        return ErrorDifference(mean, mean - half_width, mean + half_width, p_value)
    low, high = _subset_means(sums, sizes)
    # the bounds are the first means that the test does not reject; the tolerance is for rounding errors
    index = math.floor(0.5 * (1.0 - confidence) * low.size + 1e-9)
    lower, upper = float(low[index]), float(high[high.size - 1 - index])
    n_exceedances = min(int((low <= 0.0).sum()), int((high >= 0.0).sum()))
    p_value = min(1.0, 2.0 * n_exceedances / low.size)
    if not math.isfinite(upper - lower):
        lower = upper = math.nan
    return ErrorDifference(mean, lower, upper, p_value)


def _subset_means(
    sums: Float[np.ndarray, " groups"], sizes: Float[np.ndarray, " groups"]
) -> tuple[Float[np.ndarray, " subsets"], Float[np.ndarray, " subsets"]]:
    """Compute the sorted means of random subsets of groups, for lower and for upper bounds.

    The empty subset is the observed sample: its mean is minus infinity for lower bounds, and infinity for upper bounds.
    All subsets are used if they are fewer than `_MAX_SUBSETS`.
    """
    n = sums.size
    if 2**n <= _MAX_SUBSETS:
        subsets = np.arange(1, 2**n)[:, None] >> np.arange(n) & 1
        total, size = subsets @ sums, subsets @ sizes
    else:
        rng = np.random.default_rng(_SEED)
        batches = [rng.integers(0, 2, (_BATCH, n), dtype=np.int8) for _ in range(_MAX_SUBSETS // _BATCH)]
        # without the first subset, in place of which the empty one is added
        total, size = (np.concatenate([batch @ values for batch in batches])[1:] for values in (sums, sizes))
    is_empty = size == 0.0
    means = np.divide(total, size, out=np.zeros(total.size), where=~is_empty)
    return (
        np.sort(np.append(np.where(is_empty, -math.inf, means), -math.inf)),
        np.sort(np.append(np.where(is_empty, math.inf, means), math.inf)),
    )


def symmetry_p_value(differences: Float[np.ndarray, " n"], groups: Groups) -> float:
    """Compute the two-sided p-value of paired differences that are symmetric about zero (signed ranks)."""
    if groups is not None and is_shared(groups):
        return _test_signed_ranks(_sum_groups(differences, groups))
    return _test_signed_ranks(differences)


def _sum_groups(differences: Float[np.ndarray, " n"], groups: Int[np.ndarray, " n"]) -> Float[np.ndarray, " terrains"]:
    """Sum the differences on each terrain."""
    return np.bincount(number_terrains(groups), weights=differences)


def _test_signed_ranks(differences: Float[np.ndarray, " n"]) -> float:
    """Compute the p-value of Wilcoxon's signed-rank test without the zero differences; 1 if all are zero."""
    nonzero = differences[differences != 0.0]
    return 1.0 if nonzero.size == 0 else float(stats.wilcoxon(nonzero).pvalue)
