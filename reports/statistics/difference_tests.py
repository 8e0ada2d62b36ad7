"""Tests of two sets of cases that are independent of each other (two campaigns), and Holm's correction.

Cases on one terrain are correlated. If both sets have cases on the same terrains, they are compared within each
terrain, where cases are independent. Rates are compared by the exact distribution of Mantel and Haenszel's sum of
hypergeometrics (J. Nat. Cancer Inst. 22, 1959), errors by van Elteren's sum of rank tests (Bull. Inst. Int. Statist.
37, 1960). If they have few terrains in common, terrains are compared instead of cases: each terrain is represented by
the mean of the same number of its cases. The means of a common terrain correlate positively. The difference of the sets
then varies less than that of the independent means that the test assumes: the p-value is too large, not too small.

Small p-values of ranks are computed by permutation. With many ties (rates of a few cases per terrain, for example), the
rank sum is skewed. At 0.001 the p-value of its normal approximation is then too small by a factor of two to three.

`marsyard.reports.statistics.paired_tests` compares two results of the same cases.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import stats


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
#: Fixed seed of the permutations, for reproducible reports, and their number per batch.
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


class _Table(NamedTuple):
    """Successes of one pair: numbers of successes and cases of the first set, and of both sets together."""

    first_successes: int
    first_cases: int
    successes: int
    cases: int


def _test_rates(pairs: Pairs) -> float:
    """Compute the exact two-sided p-value of rates, given the successes of each pair: twice the smaller tail."""
    all_tables = [_Table(int(a.sum()), a.size, int(a.sum() + b.sum()), a.size + b.size) for a, b in pairs]
    # equal results of all cases of a pair do not depend on the set
    tables = [table for table in all_tables if 0 < table.successes < table.cases]
    if not tables:
        return 1.0
    observed_sum = sum(table.first_successes for table in tables)
    if sum(min(table.first_cases, table.successes) for table in tables) > _MAX_EXACT:
        _, first_cases, successes, cases = np.array(tables, dtype=np.float64).T
        # mean and variance of the hypergeometric distribution; continuity correction of 0.5
        mean = float((first_cases * successes / cases).sum())
        variances = first_cases * successes * (cases - successes) * (cases - first_cases) / (cases**2 * (cases - 1.0))
        excess = max(0.0, abs(observed_sum - mean) - 0.5)
        return float(2.0 * stats.norm.sf(excess / math.sqrt(float(variances.sum()))))
    distribution, minimum = np.ones(1), 0
    for _, size, success_count, case_count in tables:
        low, high = max(0, size + success_count - case_count), min(size, success_count)
        probabilities = stats.hypergeom.pmf(np.arange(low, high + 1), case_count, success_count, size)
        distribution = np.convolve(distribution, probabilities)
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
