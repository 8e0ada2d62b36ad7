"""Intervals of values on shared terrains: coverage by simulation, and closed forms where there are any."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from marsyard.reports.statistics.samples import (
    FEWEST_TERRAINS,
    mean_interval,
    quantile_bounds,
    spread_interval,
    summarize,
)


def _values(rng: np.random.Generator, terrains: int, correlation: float) -> tuple[np.ndarray, np.ndarray]:
    """Standard normal values, 1 to 14 a terrain, those of a terrain so correlated."""
    groups = np.repeat(np.arange(terrains), rng.integers(1, 15, terrains))
    of_terrain, own = rng.normal(size=terrains)[groups], rng.normal(size=groups.size)
    return math.sqrt(correlation) * of_terrain + math.sqrt(1.0 - correlation) * own, groups


@pytest.mark.parametrize(("terrains", "correlation"), [(12, 0.3), (60, 0.9)])
def test_intervals_of_mean_and_spread_cover(terrains: int, correlation: float) -> None:
    # 200 samples at 95 %: sd of the coverage 1.5 %.
    rng = np.random.default_rng(1)
    means, spreads, naive = 0, 0, 0
    for _ in range(200):
        values, groups = _values(rng, terrains, correlation)
        lower, upper = mean_interval(values, 0.95, groups)
        means += lower <= 0.0 <= upper
        lower, upper = spread_interval(values, 0.95, groups)
        spreads += lower <= 1.0 <= upper
        lower, upper = stats.t.interval(0.95, values.size - 1, values.mean(), stats.sem(values))
        naive += lower <= 0.0 <= upper
    assert min(means, spreads) / 200 >= 0.95 - 3 * 0.015
    assert naive / 200 < 0.85


@pytest.mark.parametrize(("terrains", "correlation"), [(20, 0.3), (60, 0.3), (60, 0.9)])
def test_bounds_of_a_quantile_cover(terrains: int, correlation: float) -> None:
    # 400 samples at 90 %: sd of the coverage 1.5 %.
    rng = np.random.default_rng(2)
    truth = stats.norm.ppf(0.9)
    bounds = []
    for _ in range(400):
        values, groups = _values(rng, terrains, correlation)
        bounds.append(quantile_bounds(values, 0.9, 0.9, groups))
    lower, upper = np.array(bounds).T
    assert np.mean(lower <= truth) >= 0.9 - 3 * 0.015
    assert np.mean(upper >= truth) >= 0.9 - 3 * 0.015


def test_a_quantile_takes_as_many_terrains_as_independent_values() -> None:
    # Wilks 1941: 59 for 95 % at 95 %; values that are alike on a terrain are worth one.
    for terrains, bounded in ((58, False), (59, True)):
        groups = np.repeat(np.arange(terrains), 10)
        assert math.isfinite(quantile_bounds(groups.astype(np.float64), 0.95, 0.95, groups)[1]) is bounded


def test_identical_values_of_a_terrain_count_once() -> None:
    # A terrain's value ten times over tells as much as once.
    values = np.random.default_rng(3).normal(size=100)
    groups = np.repeat(np.arange(100), 10)
    once, often = mean_interval(values, 0.95), mean_interval(np.repeat(values, 10), 0.95, groups)
    assert often == pytest.approx(once, abs=0.02)
    once, often = spread_interval(values, 0.95), spread_interval(np.repeat(values, 10), 0.95, groups)
    assert often == pytest.approx(once, rel=0.06)


def test_terrains_of_one_value_each_change_nothing() -> None:
    values = np.random.default_rng(4).normal(size=40)
    assert summarize(values, groups=np.arange(40)) == summarize(values)


def test_few_terrains_give_no_interval() -> None:
    values, groups = np.random.default_rng(5).normal(size=40), np.repeat(np.arange(FEWEST_TERRAINS - 1), 10)
    assert all(math.isnan(bound) for bound in mean_interval(values, 0.9, groups))
    assert all(math.isnan(bound) for bound in spread_interval(values, 0.9, groups))


def test_missing_values_are_removed_with_their_terrains() -> None:
    values, groups = np.random.default_rng(6).normal(size=60), np.repeat(np.arange(20), 3)
    with_gaps = np.concatenate([[math.nan], values, [math.inf]])
    summary = summarize(with_gaps, groups=np.concatenate([[7], groups, [99]]))
    assert (summary.mean_lower, summary.mean_upper) == mean_interval(values, 0.95, groups)
