"""Tests of the difference of two sets of cases: unpaired or paired, of rates or of errors, and Holm's correction.

Unpaired sets (two campaigns): cases on one terrain are correlated. If both sets have cases on the same terrains, they
are compared within each terrain, where cases are independent. Rates are compared by the exact distribution of Mantel
and Haenszel's sum of hypergeometrics (J. Nat. Cancer Inst. 22, 1959), errors by van Elteren's sum of rank tests (Bull.
Inst. Int. Statist. 37, 1960). If they have few terrains in common, terrains are compared instead of cases: each terrain
is represented by the mean of the same number of its cases. Small p-values of ranks are computed by permutation. With
many ties (rates of a few cases per terrain, for example), the rank sum is skewed. At 0.001 the p-value of its normal
approximation is then too small by a factor of two to three.

Paired sets (two algorithms, or two campaigns with the same draws): successes are compared by McNemar's test with the
exact binomial distribution (Psychometrika 12, 1947). If cases share terrains, the sums of the differences on each
terrain are ranked (Wilcoxon's signed ranks): under the null hypothesis these sums are symmetric about zero for any
correlation within terrains.

- Errors of two algorithms: the mean of their differences is tested by random changes of signs (Fisher), of the sums of
  terrains if cases share terrains. Its interval contains the means that this test does not reject: their bounds are
  quantiles of the means of random subsets (Hartigan, "Using subsample values as typical values", J. Amer. Statist.
  Assoc. 64, 1969). Estimate, interval and p-value therefore refer to the same quantity. Both are exact if the two
  algorithms are exchangeable, and accurate for the mean of many skewed differences.
- Errors of two campaigns with the same draws: Wilcoxon's signed-rank test.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats

from marsyard.reports.statistics.clusters import number_terrains
from marsyard.reports.statistics.samples import Groups, is_shared


def correct_holm(p_values: Sequence[float]) -> list[float]:
    """Correct p-values for multiple tests (Holm 1979), which limits the family-wise error rate; NaN remains NaN."""
    sorted_p = sorted((p, index) for index, p in enumerate(p_values) if not math.isnan(p))
    corrected_p, max_p = [math.nan] * len(p_values), 0.0
    for rank, (p, index) in enumerate(sorted_p):
        max_p = max(max_p, min(1.0, p * (len(sorted_p) - rank)))
        corrected_p[index] = max_p
    return corrected_p


#: Minimum fraction of the cases of each set on common terrains for a comparison within terrains.
_MIN_COMMON_FRACTION = 0.5
#: Minimum number of values of each set for a rank test; below it the normal approximation is poor.
_MIN_RANKED = 8
#: Maximum size of an exact distribution; for larger ones the normal approximation is sufficiently accurate.
_MAX_EXACT = 20_000
#: Minimum fraction of the terrains of each set that have enough cases for a terrain mean.
_FULL_FRACTION = 0.8
#: Permutations replace a p-value of the normal approximation below this value.
_PERMUTATION_LIMIT = 0.05
#: Fixed seed of permutations and random subsets, for reproducible reports, and their number per batch.
_SEED, _BATCH = 19370101, 500
#: Number of exceedances at which the sampling of permutations stops; maximum number of permuted values.
_MAX_EXCEEDANCES, _MAX_PERMUTED = 50, 2_000_000_000


@dataclass(frozen=True)
class Sample:
    """One metric of a set of cases: values (NaN where missing), and the terrain of each case."""

    values: Float[np.ndarray, " n"]
    terrains: Int[np.ndarray, " n"]

    def finite_cases(self) -> Sample:
        """Return the cases that have a value."""
        finite = np.isfinite(self.values)
        return Sample(self.values[finite], self.terrains[finite])

    def cases_on_terrains(self) -> Int[np.ndarray, " terrains"]:
        """Count the cases on each terrain."""
        return np.asarray(np.unique(self.terrains, return_counts=True)[1])

    def terrain_means(self, cases: int) -> Float[np.ndarray, " full"]:
        """Compute the mean of the first `cases` cases on each terrain with at least as many cases."""
        order = np.argsort(self.terrains, kind="stable")
        counts = self.cases_on_terrains()
        first_indices = np.cumsum(counts) - counts
        indices = first_indices[counts >= cases, None] + np.arange(cases)
        return np.asarray(self.values[order][indices].mean(axis=1))


@dataclass(frozen=True)
class Metric:
    """One metric of a campaign: a success rate with the values 0 and 1, or an error's magnitude, for each case."""

    name: str
    is_rate: bool
    sample: Sample

    @property
    def finite_values(self) -> Float[np.ndarray, " finite"]:
        """Values of the cases that are not excluded."""
        return self.sample.finite_cases().values

    @property
    def summary(self) -> float:
        """The rate, or the median error; NaN for no cases."""
        values = self.finite_values
        if values.size == 0:
            return math.nan
        return float(values.mean() if self.is_rate else np.median(values))


def difference_p_value(first: Sample, second: Sample, permutations: int = 10_000) -> float:
    """Compute the two-sided p-value of the difference of two sets; NaN for too few cases.

    Values of only 0 and 1 are compared as rates, other values by ranks. The minimum p-value of ranks is about
    1 / `permutations`.
    """
    first, second = first.finite_cases(), second.finite_cases()
    if min(first.values.size, second.values.size) == 0:
        return math.nan
    common_terrains = np.intersect1d(first.terrains, second.terrains)
    common_fractions = [float(np.isin(sample.terrains, common_terrains).mean()) for sample in (first, second)]
    if min(common_fractions) < _MIN_COMMON_FRACTION:
        # the same number of cases on each terrain, since the variance of a mean depends on this number
        counts = (
            np.quantile(sample.cases_on_terrains(), 1.0 - _FULL_FRACTION, method="lower") for sample in (first, second)
        )
        cases = int(min(counts))
        pairs = [(first.terrain_means(cases), second.terrain_means(cases))]
    else:
        pairs = [
            (first.values[first.terrains == terrain], second.values[second.terrains == terrain])
            for terrain in common_terrains
        ]
    are_rates = all(np.isin(values, (0.0, 1.0)).all() for pair in pairs for values in pair)
    return _test_rates(pairs) if are_rates else _test_ranks(pairs, permutations)


#: Values of both sets, terrain by terrain.
Pairs = Sequence[tuple[Float[np.ndarray, " _"], Float[np.ndarray, " _"]]]


def _test_rates(pairs: Pairs) -> float:
    """Compute the exact two-sided p-value of rates, given the successes of each pair: twice the smaller tail."""
    # for each pair: successes and cases of the first set, successes and cases of both sets
    tables = [(int(a.sum()), a.size, int(a.sum() + b.sum()), a.size + b.size) for a, b in pairs]
    tables = [table for table in tables if 0 < table[2] < table[3]]
    if not tables:
        return 1.0
    observed_sum = sum(table[0] for table in tables)
    if sum(min(size, successes) for _, size, successes, _ in tables) > _MAX_EXACT:
        _, first_sizes, success_counts, case_counts = np.array(tables, dtype=np.float64).T
        # mean and variance of the hypergeometric distribution; continuity correction of 0.5
        variance = float(
            (
                first_sizes
                * success_counts
                * (case_counts - success_counts)
                * (case_counts - first_sizes)
                / (case_counts**2 * (case_counts - 1.0))
            ).sum()
        )
        excess = max(0.0, abs(observed_sum - float((first_sizes * success_counts / case_counts).sum())) - 0.5)
        return float(2.0 * stats.norm.sf(excess / math.sqrt(variance)))
    distribution, minimum = np.ones(1), 0
    for _, size, successes, cases in tables:
        low, high = max(0, size + successes - cases), min(size, successes)
        distribution = np.convolve(distribution, stats.hypergeom.pmf(np.arange(low, high + 1), cases, successes, size))
        minimum += low
    index = observed_sum - minimum
    return float(min(1.0, 2.0 * min(distribution[: index + 1].sum(), distribution[index:].sum())))


def _test_ranks(pairs: Pairs, permutations: int) -> float:
    """Compute the two-sided p-value of van Elteren's test with ties; NaN for fewer than eight values of one set.

    Small p-values are the fraction of permutations within strata with at least the same excess; sampling stops early if
    that fraction is clearly large (Besag & Clifford, "Sequential Monte Carlo p-values", Biometrika 78, 1991).
    """
    if min(sum(a.size for a, _ in pairs), sum(b.size for _, b in pairs)) < _MIN_RANKED:
        return math.nan
    # scores of the values of both sets, and the size of the first set: ranks minus their mean, divided by the number of
    # values plus 1 (the weight of van Elteren's test)
    ranked_pairs = [(stats.rankdata(np.concatenate([a, b])), a.size) for a, b in pairs if a.size and b.size]
    strata = [((ranks - ranks.mean()) / (ranks.size + 1.0), first_size) for ranks, first_size in ranked_pairs]
    excess = abs(sum(float(scores[:first_size].sum()) for scores, first_size in strata))
    # variance of a sum of scores that are drawn without replacement
    variance = sum(
        first_size * (scores.size - first_size) / (scores.size * (scores.size - 1.0)) * float((scores**2).sum())
        for scores, first_size in strata
    )
    if variance == 0.0:
        return 1.0
    p_value = float(2.0 * stats.norm.sf(excess / math.sqrt(variance)))
    if p_value >= _PERMUTATION_LIMIT or permutations * sum(scores.size for scores, _ in strata) > _MAX_PERMUTED:
        return p_value
    rng = np.random.default_rng(_SEED)
    exceedances = n_permutations = 0
    while n_permutations < permutations and exceedances < _MAX_EXCEEDANCES:
        sums = np.zeros(_BATCH)
        for scores, first_size in strata:
            shuffled = rng.permuted(np.broadcast_to(scores, (_BATCH, scores.size)), axis=1)
            sums += shuffled[:, :first_size].sum(axis=1)
        # the tolerance makes sums of the same scores in another order equal
        exceedances += int((np.abs(sums) >= excess - 1e-9).sum())
        n_permutations += _BATCH
    # the observed order counts as one of the permutations
    return (exceedances + 1.0) / (n_permutations + 1.0)


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
