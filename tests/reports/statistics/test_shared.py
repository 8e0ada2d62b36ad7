"""Tests of statistics of samples with several values per terrain: simulated coverage, and closed forms."""

import math

import numpy as np
import pytest
from scipy import stats

from marsyard.reports.statistics.error_summary import summarize
from marsyard.reports.statistics.samples import (
    MIN_TERRAINS,
    mean_interval,
    quantile_bounds,
    standard_deviation_interval,
)


def _draw_values(rng: np.random.Generator, terrains: int, correlation: float) -> tuple[np.ndarray, np.ndarray]:
    """Draw standard normal values, 1 to 14 per terrain, with a correlation between the values of a terrain.

    Return the values and their terrain numbers (`groups`).
    """
    groups = np.repeat(np.arange(terrains), rng.integers(1, 15, terrains))
    terrain_effect, case_effect = rng.normal(size=terrains)[groups], rng.normal(size=groups.size)
    return math.sqrt(correlation) * terrain_effect + math.sqrt(1.0 - correlation) * case_effect, groups


@pytest.mark.parametrize(("terrains", "correlation"), [(12, 0.3), (60, 0.9)])
@pytest.mark.slow
def test_intervals_of_mean_and_standard_deviation_have_nominal_coverage(terrains: int, correlation: float) -> None:
    # 200 samples at 95 %: standard deviation of the coverage 1.5 %
    rng = np.random.default_rng(1)
    n_mean_covering, n_sd_covering = 0, 0
    for _ in range(200):
        values, groups = _draw_values(rng, terrains, correlation)
        lower, upper = mean_interval(values, 0.95, groups)
        n_mean_covering += lower <= 0.0 <= upper
        lower, upper = standard_deviation_interval(values, 0.95, groups)
        n_sd_covering += lower <= 1.0 <= upper
    assert min(n_mean_covering, n_sd_covering) / 200 >= 0.95 - 3 * 0.015


@pytest.mark.parametrize(("terrains", "correlation"), [(20, 0.3), (60, 0.3), (60, 0.9)])
@pytest.mark.slow
def test_quantile_bounds_have_nominal_coverage(terrains: int, correlation: float) -> None:
    # 400 samples at 90 %: standard deviation of the coverage 1.5 %
    rng = np.random.default_rng(2)
    true_quantile = stats.norm.ppf(0.9)
    bounds = []
    for _ in range(400):
        values, groups = _draw_values(rng, terrains, correlation)
        bounds.append(quantile_bounds(values, 0.9, 0.9, groups))
    lower, upper = np.array(bounds).T
    assert np.mean(lower <= true_quantile) >= 0.9 - 3 * 0.015
    assert np.mean(upper >= true_quantile) >= 0.9 - 3 * 0.015


def test_quantile_bound_needs_59_terrains() -> None:
    # Wilks 1941: 59 values for 95 % at 95 %; equal values of a terrain count as one
    for terrains, is_bounded in ((58, False), (59, True)):
        groups = np.repeat(np.arange(terrains), 10)
        assert math.isfinite(quantile_bounds(groups.astype(np.float64), 0.95, 0.95, groups)[1]) is is_bounded


def test_identical_values_of_a_terrain_count_once() -> None:
    values = np.random.default_rng(3).normal(size=100)
    groups = np.repeat(np.arange(100), 10)
    interval_of_single_values, interval_of_repeated_values = (
        mean_interval(values, 0.95),
        mean_interval(np.repeat(values, 10), 0.95, groups),
    )
    assert interval_of_repeated_values == pytest.approx(interval_of_single_values, abs=0.02)
    interval_of_single_values, interval_of_repeated_values = (
        standard_deviation_interval(values, 0.95),
        standard_deviation_interval(np.repeat(values, 10), 0.95, groups),
    )
    assert interval_of_repeated_values == pytest.approx(interval_of_single_values, rel=0.06)


def test_one_value_per_terrain_equals_independent_values() -> None:
    values = np.random.default_rng(4).normal(size=40)
    assert summarize(values, groups=np.arange(40)) == summarize(values)


def test_few_terrains_give_no_interval() -> None:
    values, groups = np.random.default_rng(5).normal(size=40), np.repeat(np.arange(MIN_TERRAINS - 1), 10)
    assert all(math.isnan(bound) for bound in mean_interval(values, 0.9, groups))
    assert all(math.isnan(bound) for bound in standard_deviation_interval(values, 0.9, groups))


def test_missing_values_are_removed_with_their_terrains() -> None:
    values, groups = np.random.default_rng(6).normal(size=60), np.repeat(np.arange(20), 3)
    with_gaps = np.concatenate([[math.nan], values, [math.inf]])
    summary = summarize(with_gaps, groups=np.concatenate([[7], groups, [99]]))
    assert (summary.mean_lower, summary.mean_upper) == mean_interval(values, 0.95, groups)
