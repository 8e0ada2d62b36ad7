"""Whether two sets of cases differ, free of how they were drawn on terrains: rates by an exact test, errors by ranks.

Cases on one terrain are alike. Where both sets have cases on the same terrains they are compared terrain by terrain,
given which the draws are independent: failures by the exact distribution of Mantel and Haenszel's sum of
hypergeometrics (J. Nat. Cancer Inst. 22, 1959), errors by van Elteren's sum of rank tests (Bull. Inst. Int. Statist.
37, 1960). Where they have few terrains in common, whole terrains are compared, each by its mean.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

#: Share of the cases of either set that must lie on terrains of both for a comparison terrain by terrain.
_COMMON = 0.5
#: Fewest values of either set for a rank test, whose normal approximation is poor below.
_FEWEST = 8
#: Most entries of an exact distribution; above it the normal distribution is as good.
_LARGEST_EXACT = 20_000


@dataclass(frozen=True)
class Sample:
    """One metric of a set of cases: its values, NaN where a case has none, and the terrain of each case."""

    values: Float[np.ndarray, " n"]
    terrains: Int[np.ndarray, " n"]

    def known(self) -> Sample:
        """The cases that have a value."""
        finite = np.isfinite(self.values)
        return Sample(self.values[finite], self.terrains[finite])

    def terrain_means(self) -> Float[np.ndarray, " terrains"]:
        """The mean on each terrain."""
        _, index = np.unique(self.terrains, return_inverse=True)
        return np.asarray(np.bincount(index, weights=self.values) / np.bincount(index))


def difference_p(now: Sample, before: Sample) -> float:
    """Two-sided probability of sets so different if both come from the same; NaN where there is too little to say.

    Values of 0 and 1 alone are taken as rates.
    """
    now, before = now.known(), before.known()
    if min(now.values.size, before.values.size) == 0:
        return math.nan
    rates = bool(np.isin(now.values, (0.0, 1.0)).all() and np.isin(before.values, (0.0, 1.0)).all())
    common = np.intersect1d(now.terrains, before.terrains)
    shares = [float(np.isin(one.terrains, common).mean()) for one in (now, before)]
    clustered = any(np.unique(one.terrains).size < one.values.size for one in (now, before))
    if min(shares) < _COMMON:
        if clustered:
            return _ranks_p([(now.terrain_means(), before.terrain_means())])
        pairs = [(now.values, before.values)]
    else:
        pairs = [(now.values[now.terrains == one], before.values[before.terrains == one]) for one in common]
    return _rates_p(pairs) if rates else _ranks_p(pairs)


#: Values of both sets, terrain by terrain.
Pairs = Sequence[tuple[Float[np.ndarray, " _"], Float[np.ndarray, " _"]]]


def _rates_p(pairs: Pairs) -> float:
    """Exact two-sided p of the number of ones in the first sets, given the ones in each pair: twice the lesser tail."""
    tables = [(int(a.sum()), a.size, int(a.sum() + b.sum()), a.size + b.size) for a, b in pairs]
    tables = [one for one in tables if 0 < one[2] < one[3]]
    if not tables:
        return 1.0
    seen = sum(one[0] for one in tables)
    if sum(min(n, ones) for _, n, ones, _ in tables) > _LARGEST_EXACT:
        return _normal_p(seen, tables)
    law, least = np.ones(1), 0
    for _, n, ones, total in tables:
        low, high = max(0, n + ones - total), min(n, ones)
        law = np.convolve(law, stats.hypergeom.pmf(np.arange(low, high + 1), total, ones, n))
        least += low
    place = seen - least
    return float(min(1.0, 2.0 * min(law[: place + 1].sum(), law[place:].sum())))


def _normal_p(seen: int, tables: Sequence[tuple[int, int, int, int]]) -> float:
    """Mantel and Haenszel's large-sample test, corrected for continuity."""
    _, n, ones, total = np.array(tables, dtype=np.float64).T
    variance = float((n * ones * (total - ones) * (total - n) / (total**2 * (total - 1.0))).sum())
    excess = max(0.0, abs(seen - float((n * ones / total).sum())) - 0.5)
    return float(2.0 * stats.norm.sf(excess / math.sqrt(variance)))


def _ranks_p(pairs: Pairs) -> float:
    """Van Elteren's test with ties; NaN for fewer than eight values of either set."""
    if min(sum(a.size for a, _ in pairs), sum(b.size for _, b in pairs)) < _FEWEST:
        return math.nan
    excess = variance = 0.0
    for first, second in pairs:
        n, total = first.size, first.size + second.size
        if total < 2 or n == total or n == 0:
            continue
        ranks = stats.rankdata(np.concatenate([first, second]))
        weight = 1.0 / (total + 1.0)
        excess += weight * (float(ranks[:n].sum()) - n * (total + 1.0) / 2.0)
        spread = float(((ranks - ranks.mean()) ** 2).sum())
        variance += weight**2 * n * (total - n) / (total * (total - 1.0)) * spread
    return 1.0 if variance == 0.0 else float(2.0 * stats.norm.sf(abs(excess) / math.sqrt(variance)))


def holm(p_values: Sequence[float]) -> list[float]:
    """p-values corrected for their number, NaN left out (Holm 1979): the family-wise error rate is held by them."""
    known = [(p, place) for place, p in enumerate(p_values) if not math.isnan(p)]
    corrected, largest = [math.nan] * len(p_values), 0.0
    for rank, (p, place) in enumerate(sorted(known)):
        largest = max(largest, min(1.0, p * (len(known) - rank)))
        corrected[place] = largest
    return corrected
