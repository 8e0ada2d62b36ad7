"""Comparison of two sets of cases that share terrains: rates by an exact test, errors by rank tests.

Cases on one terrain are correlated. Where both sets have cases on the same terrains, they are compared within each
terrain, where draws are independent: failures by the exact distribution of Mantel and Haenszel's sum of hypergeometrics
(J. Nat. Cancer Inst. 22, 1959), errors by van Elteren's sum of rank tests (Bull. Inst. Int. Statist. 37, 1960). Where
they have few terrains in common, whole terrains are compared, each by the mean of equally many cases.

Small p-values of ranks are computed by permutation. With many ties, for example rates of a few cases per terrain, the
rank sum is skewed, and its normal approximation is too small by a factor of two to three at 0.001.

Pairs of cases (two algorithms, or two campaigns of the same draws): McNemar's test with the exact binomial distribution
(Psychometrika 12, 1947) on the cases in which exactly one succeeds; Wilcoxon's signed ranks on differences of errors.
Where cases share terrains, the sums of the differences on each terrain are ranked: under the null hypothesis they are
symmetric about zero for any correlation within terrains.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats

from marsyard.reports.statistics.proportions import number_terrains
from marsyard.reports.statistics.samples import Groups, is_shared, mean_interval

#: Minimum fraction of the cases of either set on common terrains for a comparison within terrains.
_COMMON = 0.5
#: Minimum number of values of either set for a rank test; below it the normal approximation is poor.
_MIN_RANKED = 8
#: Maximum number of entries of an exact distribution; above it the normal one is as good.
_MAX_EXACT = 20_000
#: Fraction of the terrains of either set that have the number of cases used in a comparison of whole terrains.
_FULL = 0.8
#: p-value of the normal approximation below which permutations are used.
_PERMUTED_BELOW = 0.05
#: Permutations per batch; sufficient number of exceedances; maximum number of permuted values.
_BATCH, _MAX_EXCEEDANCES, _MAX_PERMUTED = 500, 50, 2_000_000_000
#: Fixed seed: the same rows give the same p-value.
_SEED = 19370101


@dataclass(frozen=True)
class Sample:
    """One metric of a set of cases: values (NaN where missing), and the terrain of each case."""

    values: Float[np.ndarray, " n"]
    terrains: Int[np.ndarray, " n"]

    def known(self) -> Sample:
        """Cases that have a value."""
        finite = np.isfinite(self.values)
        return Sample(self.values[finite], self.terrains[finite])

    def cases_on_terrains(self) -> Int[np.ndarray, " terrains"]:
        """Number of cases on each terrain."""
        return np.asarray(np.unique(self.terrains, return_counts=True)[1])

    def terrain_means(self, cases: int) -> Float[np.ndarray, " full"]:
        """Mean of the first `cases` cases on each terrain that has as many."""
        order = np.argsort(self.terrains, kind="stable")
        counts = self.cases_on_terrains()
        first = np.cumsum(counts) - counts
        chosen = first[counts >= cases, None] + np.arange(cases)
        return np.asarray(self.values[order][chosen].mean(axis=1))


def difference_p(now: Sample, before: Sample, permutations: int = 10_000) -> float:
    """Two-sided p-value of the difference of two sets; NaN where there is too little data.

    Values of only 0 and 1 are compared as rates. No p-value of ranks is below one over the permutations.
    """
    now, before = now.known(), before.known()
    if min(now.values.size, before.values.size) == 0:
        return math.nan
    common = np.intersect1d(now.terrains, before.terrains)
    if min(float(np.isin(one.terrains, common).mean()) for one in (now, before)) < _COMMON:
        # equally many cases on each terrain, since the variance of a mean depends on their number
        counts = (np.quantile(one.cases_on_terrains(), 1.0 - _FULL, method="lower") for one in (now, before))
        cases = int(min(counts))
        pairs = [(now.terrain_means(cases), before.terrain_means(cases))]
    else:
        pairs = [(now.values[now.terrains == one], before.values[before.terrains == one]) for one in common]
    rates = all(np.isin(values, (0.0, 1.0)).all() for pair in pairs for values in pair)
    return _test_rates(pairs) if rates else _test_ranks(pairs, permutations)


#: Values of both sets, terrain by terrain.
Pairs = Sequence[tuple[Float[np.ndarray, " _"], Float[np.ndarray, " _"]]]


def _test_rates(pairs: Pairs) -> float:
    """Exact two-sided p-value of the ones in the first sets, given the ones in each pair: twice the smaller tail."""
    tables = [(int(a.sum()), a.size, int(a.sum() + b.sum()), a.size + b.size) for a, b in pairs]
    tables = [one for one in tables if 0 < one[2] < one[3]]
    if not tables:
        return 1.0
    observed = sum(one[0] for one in tables)
    if sum(min(n, ones) for _, n, ones, _ in tables) > _MAX_EXACT:
        _, n, ones, total = np.array(tables, dtype=np.float64).T
        variance = float((n * ones * (total - ones) * (total - n) / (total**2 * (total - 1.0))).sum())
        excess = max(0.0, abs(observed - float((n * ones / total).sum())) - 0.5)
        return float(2.0 * stats.norm.sf(excess / math.sqrt(variance)))
    law, minimum = np.ones(1), 0
    for _, size, in_both, cases in tables:
        low, high = max(0, size + in_both - cases), min(size, in_both)
        law = np.convolve(law, stats.hypergeom.pmf(np.arange(low, high + 1), cases, in_both, size))
        minimum += low
    index = observed - minimum
    return float(min(1.0, 2.0 * min(law[: index + 1].sum(), law[index:].sum())))


def _test_ranks(pairs: Pairs, permutations: int) -> float:
    """Van Elteren's test with ties; NaN for fewer than eight values of either set.

    Small p-values are the fraction of the permutations within strata with at least the same excess; fewer are drawn
    where that is clearly large (Besag & Clifford, "Sequential Monte Carlo p-values", Biometrika 78, 1991).
    """
    if min(sum(a.size for a, _ in pairs), sum(b.size for _, b in pairs)) < _MIN_RANKED:
        return math.nan
    # scores of the values of both sets, of mean zero, and the size of the first set
    ranked = [(stats.rankdata(np.concatenate([a, b])), a.size) for a, b in pairs if a.size and b.size]
    strata = [((ranks - ranks.mean()) / (ranks.size + 1.0), n) for ranks, n in ranked]
    excess = abs(sum(float(scores[:n].sum()) for scores, n in strata))
    variance = sum(
        n * (scores.size - n) / (scores.size * (scores.size - 1.0)) * float((scores**2).sum()) for scores, n in strata
    )
    if variance == 0.0:
        return 1.0
    p = float(2.0 * stats.norm.sf(excess / math.sqrt(variance)))
    if p >= _PERMUTED_BELOW or permutations * sum(scores.size for scores, _ in strata) > _MAX_PERMUTED:
        return p
    rng = np.random.default_rng(_SEED)
    exceedances = drawn = 0
    while drawn < permutations and exceedances < _MAX_EXCEEDANCES:
        sums = np.zeros(_BATCH)
        for scores, n in strata:
            shuffled = rng.permuted(np.broadcast_to(scores, (_BATCH, scores.size)), axis=1)
            sums += shuffled[:, :n].sum(axis=1)
        # sums of the same scores in another order are the same
        exceedances += int((np.abs(sums) >= excess - 1e-9).sum())
        drawn += _BATCH
    return (exceedances + 1.0) / (drawn + 1.0)


def holm(p_values: Sequence[float]) -> list[float]:
    """p-values corrected for multiple tests, NaN left out (Holm 1979): controls the family-wise error rate."""
    known = sorted((p, index) for index, p in enumerate(p_values) if not math.isnan(p))
    corrected, largest = [math.nan] * len(p_values), 0.0
    for rank, (p, index) in enumerate(known):
        largest = max(largest, min(1.0, p * (len(known) - rank)))
        corrected[index] = largest
    return corrected


def compare_successes(
    first: Bool[np.ndarray, " n"], other: Bool[np.ndarray, " n"], groups: Groups = None
) -> tuple[int, int, float]:
    """Numbers of cases in which only the first and only the other succeeds, and the two-sided p-value."""
    only_first, only_other = int((first & ~other).sum()), int((other & ~first).sum())
    if groups is not None and is_shared(groups):
        return only_first, only_other, _test_signed_ranks(_sums(other.astype(np.float64) - first, groups))
    total = only_first + only_other
    p = 1.0 if total == 0 else float(stats.binomtest(only_first, total, 0.5).pvalue)
    return only_first, only_other, p


def compare_errors(
    differences: Float[np.ndarray, " n"], groups: Groups, confidence: float
) -> tuple[float, float, float, float]:
    """Mean of paired differences, its interval, and the two-sided p-value of symmetry about zero.

    NaN for no pairs; the interval is NaN for one.
    """
    if differences.size == 0:
        return math.nan, math.nan, math.nan, math.nan
    mean, interval = float(differences.mean()), mean_interval(differences, confidence, groups)
    sums = _sums(differences, groups) if groups is not None and is_shared(groups) else differences
    return mean, *interval, _test_signed_ranks(sums)


def _sums(differences: Float[np.ndarray, " n"], groups: Int[np.ndarray, " n"]) -> Float[np.ndarray, " terrains"]:
    return np.bincount(number_terrains(groups), weights=differences)


def _test_signed_ranks(differences: Float[np.ndarray, " n"]) -> float:
    changed = differences[differences != 0.0]
    return 1.0 if changed.size == 0 else float(stats.wilcoxon(changed).pvalue)
