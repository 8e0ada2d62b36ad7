from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from marsyard.reports.statistics.changes import Sample, difference_p, holm


def _sample(values: np.ndarray, terrains: np.ndarray | None = None) -> Sample:
    places = np.arange(values.size) if terrains is None else terrains
    return Sample(values.astype(np.float64), places.astype(np.int64))


def _one(values: np.ndarray) -> Sample:
    return _sample(values, np.zeros(values.size))


def test_rates_on_one_terrain_are_compared_as_by_fisher() -> None:
    now, before = np.repeat([1, 0], [7, 33]), np.repeat([1, 0], [2, 58])
    greater = stats.fisher_exact(np.array([[7, 33], [2, 58]]), "greater").pvalue
    assert difference_p(_one(now), _one(before)) == pytest.approx(2 * greater)


def test_errors_on_one_terrain_are_compared_as_by_mann_and_whitney() -> None:
    rng = np.random.default_rng(1)
    now, before = rng.exponential(1.4, 60), rng.exponential(1.0, 200)
    expected = stats.mannwhitneyu(now, before, use_continuity=False, method="asymptotic").pvalue
    # by permutations, of which some fifty go beyond: three standard deviations
    assert difference_p(_one(now), _one(before)) == pytest.approx(expected, rel=3 / math.sqrt(50))
    quiet = rng.exponential(1.0, 60)
    expected = stats.mannwhitneyu(quiet, before, use_continuity=False, method="asymptotic").pvalue
    assert expected > 0.05
    assert difference_p(_one(quiet), _one(before)) == pytest.approx(expected)


def test_ranks_of_tied_values_are_compared_as_by_all_permutations() -> None:
    # 5 of 20 against 6 of 140 off by the same amount: the number among the first is hypergeometric. The normal
    # distribution gives a third of it.
    now, before = np.repeat([3.0, 0.0], [5, 15]), np.repeat([3.0, 0.0], [6, 134])
    exact = stats.hypergeom.sf(4, 160, 11, 20)
    normal = stats.mannwhitneyu(now, before, use_continuity=False, method="asymptotic").pvalue
    assert normal < exact / 2.5
    assert difference_p(_one(now), _one(before), 40_000) == pytest.approx(exact, rel=3 / math.sqrt(50))
    assert difference_p(_one(np.full(20, 3.0)), _one(before), 1_000) == pytest.approx(1 / 1_001)


def test_terrains_with_more_cases_are_no_change() -> None:
    # Means of skewed errors: of one case on each terrain tonight, of twelve before. Most lie lower tonight.
    rng = np.random.default_rng(5)

    def night(first: int, cases: int) -> Sample:
        terrains = np.repeat(np.arange(first, first + 40), cases)
        return _sample(np.exp(1.5 * rng.normal(size=terrains.size)), terrains)

    found = [difference_p(night(0, 1), night(100, 12)) for _ in range(200)]
    assert np.mean(np.array(found) < 0.05) <= 0.05 + 3 * 0.0154


def test_large_counts_agree_with_the_exact_test() -> None:
    now, before = np.repeat([1, 0], [21_000, 30_000]), np.repeat([1, 0], [41_500, 60_500])
    exact = stats.fisher_exact(np.array([[21_000, 30_000], [41_500, 60_500]])).pvalue
    assert difference_p(_one(now), _one(before)) == pytest.approx(exact, rel=0.05)


def test_terrains_that_differ_are_no_change() -> None:
    # Terrain 1 is hard, and tonight has more cases there: pooled it looks like a change.
    rng = np.random.default_rng(2)

    def night(easy: int, hard: int) -> Sample:
        terrains = np.repeat([0, 1], [easy, hard])
        return _sample(rng.random(easy + hard) < np.where(terrains == 1, 0.4, 0.02), terrains)

    p_values = [difference_p(night(40, 160), night(160, 40)) for _ in range(300)]
    assert np.mean(np.array(p_values) < 0.05) <= 0.05 + 3 * 0.0126
    pooled = [difference_p(_one(night(40, 160).values), _one(night(160, 40).values)) for _ in range(20)]
    assert max(pooled) < 0.05


@pytest.mark.parametrize("rates", [True, False])
def test_separate_terrains_are_compared_whole(rates: bool) -> None:
    # Every night has new terrains, whose cases are much alike: cases taken as independent alarm falsely most nights.
    rng = np.random.default_rng(3)

    def night(first: int) -> Sample:
        terrains = np.repeat(np.arange(first, first + 20), 10)
        if rates:
            return _sample(rng.random(200) < rng.beta(0.5, 0.5, 20)[terrains - first], terrains)
        return _sample(rng.normal(rng.normal(0.0, 3.0, 20)[terrains - first]), terrains)

    found = [(night(0), night(100)) for _ in range(300)]
    assert np.mean([difference_p(*pair) < 0.05 for pair in found]) <= 0.05 + 3 * 0.0126
    # pooled, in 40 of them
    assert np.mean([difference_p(_one(a.values), _one(b.values)) < 0.05 for a, b in found[:40]]) > 0.2


def test_too_few_values_give_nan() -> None:
    empty, few = _sample(np.full(5, math.nan)), _sample(np.array([0.3, 1.2, 4.0]))
    assert math.isnan(difference_p(empty, few))
    assert math.isnan(difference_p(few, few))
    assert difference_p(_one(np.ones(40)), _one(np.ones(40))) == 1.0


def test_holm_corrects_for_the_number_of_comparisons() -> None:
    # Holm 1979: 0.01 * 3, then 0.02 * 2 not below it, then 0.5.
    assert holm([0.02, math.nan, 0.5, 0.01])[::2] == pytest.approx([0.04, 0.5])
    assert holm([0.02, math.nan, 0.5, 0.01])[3] == pytest.approx(0.03)
    assert holm([]) == []
