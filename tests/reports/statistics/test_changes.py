"""Tests of two-sample comparisons: exact tests, permutations, shared terrains and Holm's correction."""

import math

import numpy as np
import pytest
from scipy import stats

from marsyard.reports.statistics.difference_tests import Sample, correct_holm, difference_p_value


def _make_sample(values: np.ndarray, terrains: np.ndarray | None = None) -> Sample:
    terrain_numbers = np.arange(values.size) if terrains is None else terrains
    return Sample(values.astype(np.float64), terrain_numbers.astype(np.int64))


def _make_single_terrain_sample(values: np.ndarray) -> Sample:
    return _make_sample(values, np.zeros(values.size))


def test_few_common_terrains_do_not_increase_false_alarms() -> None:
    """9 of 20 terrains are common, and terrains differ more than their cases: no p-value is too small."""
    rng = np.random.default_rng(5)
    first_terrains, second_terrains = np.repeat(np.arange(20), 6), np.repeat(np.arange(11, 31), 3)
    p_values = []
    for _ in range(400):
        terrain_errors = rng.normal(0.0, 2.0, 31)
        first, second = (
            _make_sample(terrain_errors[terrains] + rng.normal(size=terrains.size), terrains)
            for terrains in (first_terrains, second_terrains)
        )
        p_values.append(difference_p_value(first, second, 500))
    # Independent means: 40 of 400. The common terrains reduce the variance of the difference by 42 %, from
    # 2 (4 + 1/3) / 20 by 2 * 9 * 4 / 20^2. The limit is then at 2.15 instead of 1.64 standard deviations: 13 +- 3.5.
    assert np.sum(np.array(p_values) <= 0.1) < 28


def test_rates_on_one_terrain_agree_with_fishers_exact_test() -> None:
    new, old = np.repeat([1, 0], [7, 33]), np.repeat([1, 0], [2, 58])
    one_sided_p_value = stats.fisher_exact(np.array([[7, 33], [2, 58]]), "greater").pvalue
    assert difference_p_value(_make_single_terrain_sample(new), _make_single_terrain_sample(old)) == pytest.approx(
        2 * one_sided_p_value
    )


def test_errors_on_one_terrain_agree_with_the_mann_whitney_test() -> None:
    rng = np.random.default_rng(1)
    new, old = rng.exponential(1.4, 60), rng.exponential(1.0, 200)
    expected = stats.mannwhitneyu(new, old, use_continuity=False, method="asymptotic").pvalue
    # permutations end after 50 exceedances: relative standard deviation 1 / sqrt(50), tolerance of three
    assert difference_p_value(_make_single_terrain_sample(new), _make_single_terrain_sample(old)) == pytest.approx(
        expected, rel=3 / math.sqrt(50)
    )
    new_without_change = rng.exponential(1.0, 60)
    expected = stats.mannwhitneyu(new_without_change, old, use_continuity=False, method="asymptotic").pvalue
    assert expected > 0.05
    assert difference_p_value(
        _make_single_terrain_sample(new_without_change), _make_single_terrain_sample(old)
    ) == pytest.approx(expected)


def test_tied_values_agree_with_the_hypergeometric_test() -> None:
    # 5 of 20 against 6 of 140 with equal errors: the count in the first sample is hypergeometric. The normal
    # approximation is too small by a factor of 3.
    new, old = np.repeat([3.0, 0.0], [5, 15]), np.repeat([3.0, 0.0], [6, 134])
    exact = stats.hypergeom.sf(4, 160, 11, 20)
    normal = stats.mannwhitneyu(new, old, use_continuity=False, method="asymptotic").pvalue
    assert normal < exact / 2.5
    # at most 40,000 permutations
    assert difference_p_value(
        _make_single_terrain_sample(new), _make_single_terrain_sample(old), 40_000
    ) == pytest.approx(exact, rel=3 / math.sqrt(50))
    # no permutation of 1000 has an equal difference: p = (0 + 1) / (1000 + 1)
    assert difference_p_value(
        _make_single_terrain_sample(np.full(20, 3.0)), _make_single_terrain_sample(old), 1_000
    ) == pytest.approx(1 / 1_001)


def test_different_numbers_of_cases_per_terrain_are_not_a_change() -> None:
    # Skewed errors; new campaign: 1 case per terrain, old: 12. The median of the terrain means is lower for 1 case.
    rng = np.random.default_rng(5)

    def draw_campaign(first_terrain: int, cases: int) -> Sample:
        terrains = np.repeat(np.arange(first_terrain, first_terrain + 40), cases)
        return _make_sample(np.exp(1.5 * rng.normal(size=terrains.size)), terrains)

    p_values = [difference_p_value(draw_campaign(0, 1), draw_campaign(100, 12)) for _ in range(200)]
    # standard deviation of a rate of 5 % in 200 comparisons: 1.54 %
    assert np.mean(np.array(p_values) < 0.05) <= 0.05 + 3 * 0.0154


def test_large_counts_agree_with_the_exact_test() -> None:
    new, old = np.repeat([1, 0], [21_000, 30_000]), np.repeat([1, 0], [41_500, 60_500])
    exact = stats.fisher_exact(np.array([[21_000, 30_000], [41_500, 60_500]])).pvalue
    assert difference_p_value(_make_single_terrain_sample(new), _make_single_terrain_sample(old)) == pytest.approx(
        exact, rel=0.05
    )


def test_different_mix_of_terrains_is_not_a_change() -> None:
    # terrain 1 is difficult and has more cases in the new campaign: only the rate over all terrains changes
    rng = np.random.default_rng(2)

    def draw_campaign(easy: int, hard: int) -> Sample:
        terrains = np.repeat([0, 1], [easy, hard])
        return _make_sample(rng.random(easy + hard) < np.where(terrains == 1, 0.4, 0.02), terrains)

    p_values = [difference_p_value(draw_campaign(40, 160), draw_campaign(160, 40)) for _ in range(300)]
    # standard deviation of a rate of 5 % in 300 comparisons: 1.26 %
    assert np.mean(np.array(p_values) < 0.05) <= 0.05 + 3 * 0.0126


@pytest.mark.parametrize("is_rate", [True, False])
def test_correlated_cases_are_compared_by_terrain(is_rate: bool) -> None:
    # each campaign has new terrains with correlated cases: treating them as independent would give many false alarms
    rng = np.random.default_rng(3)

    def draw_campaign(first_terrain: int) -> Sample:
        terrains = np.repeat(np.arange(first_terrain, first_terrain + 20), 10)
        if is_rate:
            return _make_sample(rng.random(200) < rng.beta(0.5, 0.5, 20)[terrains - first_terrain], terrains)
        return _make_sample(rng.normal(rng.normal(0.0, 3.0, 20)[terrains - first_terrain]), terrains)

    campaign_pairs = [(draw_campaign(0), draw_campaign(100)) for _ in range(300)]
    assert np.mean([difference_p_value(*pair) < 0.05 for pair in campaign_pairs]) <= 0.05 + 3 * 0.0126


def test_too_few_values_give_nan() -> None:
    empty, short = _make_sample(np.full(5, math.nan)), _make_sample(np.array([0.3, 1.2, 4.0]))
    assert math.isnan(difference_p_value(empty, short))
    assert math.isnan(difference_p_value(short, short))
    assert difference_p_value(_make_single_terrain_sample(np.ones(40)), _make_single_terrain_sample(np.ones(40))) == 1.0


def test_holm_correction_agrees_with_the_closed_form() -> None:
    # Holm 1979, smallest of m = 3 p-values first: 0.01 * 3, max(0.02 * 2, 0.03), 0.5 * 1
    assert correct_holm([0.02, math.nan, 0.5, 0.01])[::2] == pytest.approx([0.04, 0.5])
    assert correct_holm([0.02, math.nan, 0.5, 0.01])[3] == pytest.approx(0.03)
    assert correct_holm([]) == []
