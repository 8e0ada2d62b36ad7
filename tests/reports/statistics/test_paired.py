"""Tests of paired comparisons of algorithms: closed forms, and false alarm rates on shared terrains."""

import math

import numpy as np
import pytest

from marsyard.reports.statistics.paired_tests import compare_errors, compare_successes, symmetry_p_value

#: Terrain numbers of 200 cases: 8 cases on each of 25 terrains.
TERRAINS = np.repeat(np.arange(25), 8)


def test_mcnemar_p_value_agrees_with_the_binomial_test() -> None:
    first_succeeds = np.array([True] * 9 + [False] * 1 + [True] * 5)
    second_succeeds = np.array([False] * 9 + [True] * 1 + [True] * 5)
    only_first, only_second, p_value = compare_successes(first_succeeds, second_succeeds)
    assert (only_first, only_second) == (9, 1)
    assert p_value == pytest.approx(2 * (1 + 10) / 2**10)  # two-sided binomial test, n = 10
    assert compare_successes(first_succeeds, first_succeeds)[2] == 1.0


@pytest.mark.slow
def test_equal_algorithms_on_shared_terrains_have_the_nominal_false_alarm_rate() -> None:
    # Which algorithm is better depends on the terrain. 150 repetitions: standard deviation of a rate of 5 % is 1.8 %.
    rng = np.random.default_rng(1)
    success_alarms, error_alarms, independent_alarms = 0, 0, 0
    for _ in range(150):
        terrain_effect = rng.normal(size=25)[TERRAINS]
        differences = terrain_effect + 0.1 * rng.normal(size=TERRAINS.size)
        success_alarms += compare_successes(terrain_effect < 0.5, terrain_effect > -0.5, TERRAINS)[2] < 0.05
        independent_alarms += compare_successes(terrain_effect < 0.5, terrain_effect > -0.5)[2] < 0.05
        error_alarms += compare_errors(differences, TERRAINS, 0.9)[3] < 0.05
    assert max(success_alarms, error_alarms) / 150 <= 0.05 + 3 * 0.018
    assert independent_alarms / 150 > 0.3


@pytest.mark.slow
def test_paired_mean_interval_covers_the_mean_on_shared_terrains() -> None:
    # 200 repetitions at 90 %: standard deviation 2.1 %
    rng = np.random.default_rng(2)
    draws = (0.3 + rng.normal(size=25)[TERRAINS] + 0.3 * rng.normal(size=TERRAINS.size) for _ in range(200))
    results = np.array([compare_errors(sample, TERRAINS, 0.9) for sample in draws])
    assert np.mean((results[:, 1] <= 0.3) & (results[:, 2] >= 0.3)) >= 0.9 - 3 * 0.021


def test_no_pairs_give_nan() -> None:
    assert all(math.isnan(value) for value in compare_errors(np.zeros(0), None, 0.9))
    mean, lower, upper, p_value = compare_errors(np.zeros(1), None, 0.9)
    assert (mean, p_value) == (0.0, 1.0)
    assert math.isnan(lower)
    assert math.isnan(upper)


def test_interval_of_few_differences_is_exact() -> None:
    """Six differences have 64 sign changes, and 64 subsets."""
    differences = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    mean, lower, upper, p_value = compare_errors(differences, None, 0.9)
    assert mean == 3.5
    # only the empty subset has no positive sum: 2 * 1 / 64
    assert p_value == 2 / 64
    # 5 % of 64 are 3.2: the empty subset, 1 and 1.5 (of 1 and 2) are rejected, and 2 (of 2) is not
    assert (lower, upper) == (2.0, 5.0)
    # 31 of the 63 subsets of symmetric differences have a negative sum, as many a positive one
    assert compare_errors(np.array([-3.0, -2.0, -1.0, 1.0, 2.0, 3.0]), None, 0.9)[3] == 1.0


@pytest.mark.parametrize("size", [20, 50, 150])
@pytest.mark.parametrize("shared", [False, True])
def test_interval_excludes_zero_if_and_only_if_the_p_value_is_small(size: int, shared: bool) -> None:
    """Differences with ties and zeros, skewed, with a mean of different size."""
    rng = np.random.default_rng(size)
    decisions = set()
    for shift in np.linspace(-0.6, 0.6, 25):
        differences = np.round(rng.exponential(size=size) - 1.0 + shift, 1)
        groups = rng.integers(0, size // 2, size) if shared else None
        mean, lower, upper, p_value = compare_errors(differences, groups, 0.9)
        excludes_zero = lower > 0.0 or upper < 0.0
        assert excludes_zero == (p_value <= 0.1 + 1e-9)
        assert lower <= mean <= upper
        decisions.add(excludes_zero)
    assert decisions == {False, True}


def test_skewed_differences_do_not_contradict_themselves() -> None:
    """The mean difference is zero and the median is not: a test of symmetry rejects, the test of the mean does not."""
    quantiles = (np.arange(200) + 0.5) / 200
    differences = -np.log(1.0 - quantiles)
    differences -= differences.mean()
    assert symmetry_p_value(differences, None) < 0.05
    mean, lower, upper, p_value = compare_errors(differences, None, 0.9)
    assert mean == pytest.approx(0.0, abs=1e-12)
    assert lower < -0.05 < 0.05 < upper
    assert p_value > 0.9
    # the same differences on 40 terrains of different size
    terrains = np.repeat(np.arange(40), np.tile([2, 8], 20))
    _, lower, upper, p_value = compare_errors(differences[np.random.default_rng(1).permutation(200)], terrains, 0.9)
    assert lower < 0.0 < upper
    assert p_value > 0.1


@pytest.mark.slow
def test_interval_of_skewed_differences_covers_their_mean() -> None:
    """400 repetitions at 90 %: standard deviation 1.5 %; intervals of skewed means are slightly short."""
    rng = np.random.default_rng(3)
    for terrains in (None, np.repeat(np.arange(50), 2)):
        draws = [rng.exponential(size=100) for _ in range(400)]
        results = np.array([compare_errors(sample - 1.0, terrains, 0.9) for sample in draws])
        assert 0.86 <= np.mean((results[:, 1] <= 0.0) & (results[:, 2] >= 0.0)) <= 0.94
        assert 0.06 <= np.mean(results[:, 3] <= 0.1) <= 0.14


def test_many_differences_use_the_normal_distribution() -> None:
    rng = np.random.default_rng(6)
    differences = rng.normal(0.05, 1.0, 2001)
    many = compare_errors(differences, None, 0.9)
    few = compare_errors(differences[:-1], None, 0.9)
    assert many[:3] == pytest.approx(few[:3], abs=0.004)
    assert many[3] == pytest.approx(few[3], abs=0.005)
    assert compare_errors(np.zeros(3000), None, 0.9) == (0.0, 0.0, 0.0, 1.0)
