"""Tests of binomial bounds for correlated cases: coverage, design effect and terrain counts."""

from __future__ import annotations

import numpy as np
import pytest

from marsyard.reports.statistics.proportions import (
    ClusterMethod,
    clustered_evidence,
    number_terrains,
    proportion_lower,
    proportion_upper,
)

CASES_PER_TERRAIN = 8


def _draw_cases(
    rng: np.random.Generator, rate: float, correlation: float, terrains: int
) -> tuple[np.ndarray, np.ndarray]:
    """Draw beta-binomial cases; return successes and terrain numbers.

    The correlation r of a beta distribution with parameters a and b is 1 / (a + b + 1), so a + b = (1 - r) / r.
    """
    if correlation == 1.0:
        rates = (rng.random(terrains) < rate).astype(float)
    else:
        parameter_sum = (1 - correlation) / correlation
        rates = rng.beta(rate * parameter_sum, (1 - rate) * parameter_sum, terrains)
    terrain = np.repeat(np.arange(terrains), CASES_PER_TERRAIN)
    return rng.random(terrain.size) < rates[terrain], terrain


@pytest.mark.slow
@pytest.mark.parametrize("correlation", [0.05, 0.3, 1.0])
@pytest.mark.parametrize(("rate", "terrains"), [(0.99, 60), (0.95, 60), (0.8, 60), (0.9, 20)])
def test_bounds_for_clustered_cases_cover_the_true_rate(rate: float, terrains: int, correlation: float) -> None:
    # 400 campaigns: standard deviation of the coverage 1.5 %
    rng = np.random.default_rng(11)
    campaigns = [clustered_evidence(*_draw_cases(rng, rate, correlation, terrains), 0.9) for _ in range(400)]
    assert np.mean([evidence.lower <= rate for evidence in campaigns]) >= 0.9 - 3 * 0.015
    assert np.mean([evidence.upper >= rate for evidence in campaigns]) >= 0.9 - 3 * 0.015


@pytest.mark.parametrize(
    ("terrains", "cases_per_terrain", "answer_rate", "bad_fraction", "rates"),
    [(40, 8, 0.1, 0.3, (0.2, 0.99)), (49, 20, 0.05, 0.3, (0.0, 0.99)), (60, 8, 0.3, 0.1, (0.0, 1.0)),
     (60, 20, 0.2, 0.1, (0.0, 1.0)), (60, 8, 0.2, 0.3, (0.6, 0.97))],
)  # fmt: skip
def test_bounds_cover_the_rate_if_bad_terrains_have_fewer_answers(
    terrains: int, cases_per_terrain: int, answer_rate: float, bad_fraction: float, rates: tuple[float, float]
) -> None:
    """A bound that counts only terrains would miss the true rate in up to 99 % of these campaigns.

    `rates`: success rates of bad and good terrains; `answer_rate`: rate of answers on bad terrains.
    """
    rng = np.random.default_rng(15)
    weights = np.array([bad_fraction * answer_rate, 1.0 - bad_fraction])
    rate, n_missed = float(weights @ np.array(rates) / weights.sum()), np.zeros(2)
    for _ in range(400):
        is_bad = rng.random(terrains) < bad_fraction
        answers = rng.binomial(cases_per_terrain, np.where(is_bad, answer_rate, 1.0))
        terrain = np.repeat(np.arange(terrains), answers)
        success = rng.random(terrain.size) < np.where(is_bad, *rates)[terrain]
        evidence = clustered_evidence(success, terrain, 0.9)
        n_missed += evidence.lower > rate, evidence.upper < rate
    # 400 campaigns: standard deviation of the coverage 1.5 %
    assert (n_missed / 400 <= 0.1 + 2 * 0.015).all()


def test_bounds_for_independent_cases_miss_the_rate_of_clustered_cases() -> None:
    rng = np.random.default_rng(12)
    n_exceeded = 0
    for _ in range(300):
        success, _ = _draw_cases(rng, 0.8, 0.3, 60)
        n_exceeded += proportion_lower(int(success.sum()), success.size, 0.9) > 0.8
    assert n_exceeded / 300 > 0.2


def test_terrains_are_counted_if_failures_are_too_few() -> None:
    success, terrain = np.ones(600, dtype=bool), np.arange(600) % 60
    success[[0, 60, 1]] = False  # two on terrain 0, one on terrain 1
    evidence = clustered_evidence(success, terrain, 0.9)
    assert evidence.method is ClusterMethod.TERRAIN_COUNT
    assert (evidence.terrains, evidence.failed_terrains, evidence.effective_n) == (60, 2, 60.0)
    assert evidence.lower == proportion_lower(58, 60, 0.9)
    assert evidence.upper == 1.0


def test_99_percent_at_90_percent_confidence_needs_230_terrains() -> None:
    def lower_bound(terrains: int) -> float:
        return clustered_evidence(np.ones(10 * terrains, dtype=bool), np.arange(10 * terrains) % terrains, 0.9).lower

    assert lower_bound(229) < 0.99 <= lower_bound(230)


def test_design_effect_of_independent_cases_is_about_one() -> None:
    rng = np.random.default_rng(13)
    terrain = np.repeat(np.arange(400), 10)
    evidence = clustered_evidence(rng.random(4000) < 0.7, terrain, 0.9)
    assert evidence.method is ClusterMethod.KORN_GRAUBARD
    # relative standard deviation of a variance over 400 terrains: sqrt(2 / 399) = 7 %
    assert evidence.design_effect == pytest.approx(1.0, abs=0.25)


def test_design_effect_of_identical_cases_is_the_cluster_size() -> None:
    rng = np.random.default_rng(14)
    success_of_terrain = rng.random(200) < 0.7
    evidence = clustered_evidence(np.repeat(success_of_terrain, 5), np.repeat(np.arange(200), 5), 0.9)
    # 5 identical cases per terrain, times m / (m - 1) for m = 200 terrains
    assert evidence.design_effect == pytest.approx(5 * 200 / 199)
    assert evidence.effective_n <= 200
    assert evidence.lower < success_of_terrain.mean() < evidence.upper


def test_effective_sample_size_never_exceeds_the_cases() -> None:
    # each terrain has 1 failure in 10 cases: the rates of terrains vary less than for independent cases
    success = np.tile(np.arange(10) > 0, 100)
    evidence = clustered_evidence(success, np.repeat(np.arange(100), 10), 0.9)
    assert evidence.effective_n == 1000.0
    assert evidence.lower == proportion_lower(900, 1000, 0.9)
    assert evidence.upper == proportion_upper(900, 1000, 0.9)


def test_terrains_are_numbered_consecutively() -> None:
    for terrain in ([7, 3, 7, 5], [-2, 10**15, -2], [4]):
        terrain_ids = np.array(terrain, dtype=np.int64)
        np.testing.assert_array_equal(number_terrains(terrain_ids), np.unique(terrain_ids, return_inverse=True)[1])


@pytest.mark.parametrize(
    ("terrains", "n_failed_terrains", "is_estimated"), [(50, 10, True), (49, 10, False), (50, 9, False)]
)
def test_correlation_is_estimated_from_enough_terrains(
    terrains: int, n_failed_terrains: int, is_estimated: bool
) -> None:
    terrain = np.repeat(np.arange(terrains), 4)
    success = ~((terrain < n_failed_terrains) & (np.arange(terrain.size) % 4 == 0))
    method = ClusterMethod.KORN_GRAUBARD if is_estimated else ClusterMethod.TERRAIN_COUNT
    assert clustered_evidence(success, terrain, 0.9).method is method


def test_terrain_with_one_success_counts_as_success() -> None:
    success, terrain = np.zeros(40, dtype=bool), np.repeat(np.arange(20), 2)
    success[::4] = True  # one success on every second terrain
    evidence = clustered_evidence(success, terrain, 0.9)
    assert evidence.upper == proportion_upper(10, 20, 0.9)
