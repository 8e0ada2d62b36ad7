"""Tests of two-sample comparisons: exact tests, permutations, shared terrains and Holm's correction."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from marsyard.reports.statistics.changes import Sample, difference_p, holm


def _make_sample(values: np.ndarray, terrains: np.ndarray | None = None) -> Sample:
    terrain_numbers = np.arange(values.size) if terrains is None else terrains
    return Sample(values.astype(np.float64), terrain_numbers.astype(np.int64))


def _make_single_terrain_sample(values: np.ndarray) -> Sample:
    return _make_sample(values, np.zeros(values.size))


def test_rates_on_one_terrain_agree_with_fisher() -> None:
    now, before = np.repeat([1, 0], [7, 33]), np.repeat([1, 0], [2, 58])
    greater = stats.fisher_exact(np.array([[7, 33], [2, 58]]), "greater").pvalue
    assert difference_p(_make_single_terrain_sample(now), _make_single_terrain_sample(before)) == pytest.approx(
        2 * greater
    )


def test_errors_on_one_terrain_agree_with_mann_whitney() -> None:
    rng = np.random.default_rng(1)
    now, before = rng.exponential(1.4, 60), rng.exponential(1.0, 200)
    expected = stats.mannwhitneyu(now, before, use_continuity=False, method="asymptotic").pvalue
    # about 50 permutations are more extreme: tolerance of three standard deviations
    assert difference_p(_make_single_terrain_sample(now), _make_single_terrain_sample(before)) == pytest.approx(
        expected, rel=3 / math.sqrt(50)
    )
    similar = rng.exponential(1.0, 60)
    expected = stats.mannwhitneyu(similar, before, use_continuity=False, method="asymptotic").pvalue
    assert expected > 0.05
    assert difference_p(_make_single_terrain_sample(similar), _make_single_terrain_sample(before)) == pytest.approx(
        expected
    )


def test_tied_values_agree_with_the_hypergeometric_test() -> None:
    # 5 of 20 against 6 of 140 with equal errors: the count in the first sample is hypergeometric. The normal
    # approximation is too small by a factor of 3.
    now, before = np.repeat([3.0, 0.0], [5, 15]), np.repeat([3.0, 0.0], [6, 134])
    exact = stats.hypergeom.sf(4, 160, 11, 20)
    normal = stats.mannwhitneyu(now, before, use_continuity=False, method="asymptotic").pvalue
    assert normal < exact / 2.5
    assert difference_p(_make_single_terrain_sample(now), _make_single_terrain_sample(before), 40_000) == pytest.approx(
        exact, rel=3 / math.sqrt(50)
    )
    assert difference_p(
        _make_single_terrain_sample(np.full(20, 3.0)), _make_single_terrain_sample(before), 1_000
    ) == pytest.approx(1 / 1_001)


def test_number_of_cases_per_terrain_is_no_change() -> None:
    # skewed errors with 1 case per terrain now and 12 before: most terrain means are lower now
    rng = np.random.default_rng(5)

    def draw_night(first: int, cases: int) -> Sample:
        terrains = np.repeat(np.arange(first, first + 40), cases)
        return _make_sample(np.exp(1.5 * rng.normal(size=terrains.size)), terrains)

    p_values = [difference_p(draw_night(0, 1), draw_night(100, 12)) for _ in range(200)]
    assert np.mean(np.array(p_values) < 0.05) <= 0.05 + 3 * 0.0154


def test_large_counts_agree_with_the_exact_test() -> None:
    now, before = np.repeat([1, 0], [21_000, 30_000]), np.repeat([1, 0], [41_500, 60_500])
    exact = stats.fisher_exact(np.array([[21_000, 30_000], [41_500, 60_500]])).pvalue
    assert difference_p(_make_single_terrain_sample(now), _make_single_terrain_sample(before)) == pytest.approx(
        exact, rel=0.05
    )


def test_different_shares_of_terrains_are_no_change() -> None:
    # terrain 1 is difficult and has more cases now: pooled rates change
    rng = np.random.default_rng(2)

    def draw_night(easy: int, hard: int) -> Sample:
        terrains = np.repeat([0, 1], [easy, hard])
        return _make_sample(rng.random(easy + hard) < np.where(terrains == 1, 0.4, 0.02), terrains)

    p_values = [difference_p(draw_night(40, 160), draw_night(160, 40)) for _ in range(300)]
    assert np.mean(np.array(p_values) < 0.05) <= 0.05 + 3 * 0.0126
    pooled = [
        difference_p(
            _make_single_terrain_sample(draw_night(40, 160).values),
            _make_single_terrain_sample(draw_night(160, 40).values),
        )
        for _ in range(20)
    ]
    assert max(pooled) < 0.05


@pytest.mark.parametrize("rates", [True, False])
def test_separate_terrains_are_compared_as_units(rates: bool) -> None:
    # new terrains every night with correlated cases: treating cases as independent gives many false alarms
    rng = np.random.default_rng(3)

    def draw_night(first: int) -> Sample:
        terrains = np.repeat(np.arange(first, first + 20), 10)
        if rates:
            return _make_sample(rng.random(200) < rng.beta(0.5, 0.5, 20)[terrains - first], terrains)
        return _make_sample(rng.normal(rng.normal(0.0, 3.0, 20)[terrains - first]), terrains)

    nights = [(draw_night(0), draw_night(100)) for _ in range(300)]
    assert np.mean([difference_p(*pair) < 0.05 for pair in nights]) <= 0.05 + 3 * 0.0126
    # pooled test of 40 nights
    assert (
        np.mean(
            [
                difference_p(_make_single_terrain_sample(a.values), _make_single_terrain_sample(b.values)) < 0.05
                for a, b in nights[:40]
            ]
        )
        > 0.2
    )


def test_too_few_values_give_nan() -> None:
    empty, few = _make_sample(np.full(5, math.nan)), _make_sample(np.array([0.3, 1.2, 4.0]))
    assert math.isnan(difference_p(empty, few))
    assert math.isnan(difference_p(few, few))
    assert difference_p(_make_single_terrain_sample(np.ones(40)), _make_single_terrain_sample(np.ones(40))) == 1.0


def test_holm_correction_of_p_values() -> None:
    # Holm 1979: 0.01 * 3, max(0.02 * 2, 0.03), 0.5
    assert holm([0.02, math.nan, 0.5, 0.01])[::2] == pytest.approx([0.04, 0.5])
    assert holm([0.02, math.nan, 0.5, 0.01])[3] == pytest.approx(0.03)
    assert holm([]) == []
