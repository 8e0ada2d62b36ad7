"""Tests of paired comparisons of algorithms: closed forms, and false alarm rates on shared terrains."""

from __future__ import annotations

import math

import numpy as np
import pytest

from marsyard.reports.statistics.changes import compare_errors, compare_successes

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
