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

SIZE = 8


def _cases(rng: np.random.Generator, rate: float, correlation: float, terrains: int) -> tuple[np.ndarray, np.ndarray]:
    """Cases on terrains whose own success rates are beta distributed: beta-binomial, correlated on a terrain."""
    if correlation == 1.0:
        rates = (rng.random(terrains) < rate).astype(float)
    else:
        weight = (1 - correlation) / correlation
        rates = rng.beta(rate * weight, (1 - rate) * weight, terrains)
    terrain = np.repeat(np.arange(terrains), SIZE)
    return rng.random(terrain.size) < rates[terrain], terrain


@pytest.mark.parametrize("correlation", [0.05, 0.3, 1.0])
@pytest.mark.parametrize(("rate", "terrains"), [(0.99, 60), (0.95, 60), (0.8, 60), (0.9, 20)])
def test_bounds_cover_clustered_cases(rate: float, terrains: int, correlation: float) -> None:
    # 400 campaigns: one standard deviation of the coverage is 1.5 %.
    rng = np.random.default_rng(11)
    shown = [clustered_evidence(*_cases(rng, rate, correlation, terrains), 0.9) for _ in range(400)]
    assert np.mean([evidence.lower <= rate for evidence in shown]) >= 0.9 - 3 * 0.015
    assert np.mean([evidence.upper >= rate for evidence in shown]) >= 0.9 - 3 * 0.015


@pytest.mark.parametrize(
    ("terrains", "size", "answering", "bad", "rates"),
    [(40, 8, 0.1, 0.3, (0.2, 0.99)), (49, 20, 0.05, 0.3, (0.0, 0.99)), (60, 8, 0.3, 0.1, (0.0, 1.0)),
     (60, 20, 0.2, 0.1, (0.0, 1.0)), (60, 8, 0.2, 0.3, (0.6, 0.97))],
)  # fmt: skip
def test_bounds_hold_where_bad_terrains_answer_less_often(
    terrains: int, size: int, answering: float, bad: float, rates: tuple[float, float]
) -> None:
    """Counting whole terrains alone, the upper bound missed the answers' rate in up to 99 % of these campaigns."""
    rng = np.random.default_rng(15)
    weights = np.array([bad * answering, 1.0 - bad])
    rate, missed = float(weights @ np.array(rates) / weights.sum()), np.zeros(2)
    for _ in range(400):
        is_bad = rng.random(terrains) < bad
        answers = rng.binomial(size, np.where(is_bad, answering, 1.0))
        terrain = np.repeat(np.arange(terrains), answers)
        success = rng.random(terrain.size) < np.where(is_bad, *rates)[terrain]
        evidence = clustered_evidence(success, terrain, 0.9)
        missed += evidence.lower > rate, evidence.upper < rate
    assert (missed / 400 <= 0.1 + 2 * 0.015).all()


def test_bounds_for_independent_cases_fall_short() -> None:
    # The reason for all this: with correlated cases the plain bound lies above the truth far too often.
    rng = np.random.default_rng(12)
    passed_over = 0
    for _ in range(300):
        success, _ = _cases(rng, 0.8, 0.3, 60)
        passed_over += proportion_lower(int(success.sum()), success.size, 0.9) > 0.8
    assert passed_over / 300 > 0.2


def test_too_few_failures_count_terrains() -> None:
    success, terrain = np.ones(600, dtype=bool), np.arange(600) % 60
    success[[0, 60, 1]] = False  # two on terrain 0, one on terrain 1
    evidence = clustered_evidence(success, terrain, 0.9)
    assert evidence.method is ClusterMethod.TERRAIN_COUNT
    assert (evidence.terrains, evidence.failed_terrains, evidence.effective_n) == (60, 2, 60.0)
    assert evidence.lower == proportion_lower(58, 60, 0.9)
    assert evidence.upper == 1.0


def test_a_reliability_takes_as_many_terrains_as_cases() -> None:
    # Issue 8: 99 % at 90 % confidence needs 230 terrains.
    def lower(terrains: int) -> float:
        return clustered_evidence(np.ones(10 * terrains, dtype=bool), np.arange(10 * terrains) % terrains, 0.9).lower

    assert lower(229) < 0.99 <= lower(230)


def test_design_effect_of_independent_cases_is_about_one() -> None:
    rng = np.random.default_rng(13)
    terrain = np.repeat(np.arange(400), 10)
    evidence = clustered_evidence(rng.random(4000) < 0.7, terrain, 0.9)
    assert evidence.method is ClusterMethod.KORN_GRAUBARD
    # Relative standard deviation of a variance over 400 terrains: sqrt(2 / 399) = 7 %.
    assert evidence.design_effect == pytest.approx(1.0, abs=0.25)


def test_design_effect_of_identical_cases_is_their_number() -> None:
    rng = np.random.default_rng(14)
    fate = rng.random(200) < 0.7
    evidence = clustered_evidence(np.repeat(fate, 5), np.repeat(np.arange(200), 5), 0.9)
    # 5 cases a terrain, all alike; times m / (m - 1) for the variance over m = 200 terrains.
    assert evidence.design_effect == pytest.approx(5 * 200 / 199)
    assert evidence.effective_n <= 200
    assert evidence.lower < fate.mean() < evidence.upper


def test_effective_sample_size_never_exceeds_the_cases() -> None:
    # Every terrain fails once in ten: less variance than independent cases have.
    success = np.tile(np.arange(10) > 0, 100)
    evidence = clustered_evidence(success, np.repeat(np.arange(100), 10), 0.9)
    assert evidence.effective_n == 1000.0
    assert evidence.lower == proportion_lower(900, 1000, 0.9)
    assert evidence.upper == proportion_upper(900, 1000, 0.9)


def test_terrains_are_counted_without_gaps() -> None:
    for terrain in ([7, 3, 7, 5], [-2, 10**15, -2], [4]):
        numbered = np.array(terrain, dtype=np.int64)
        np.testing.assert_array_equal(number_terrains(numbered), np.unique(numbered, return_inverse=True)[1])


@pytest.mark.parametrize(("terrains", "failing", "estimated"), [(50, 10, True), (49, 10, False), (50, 9, False)])
def test_correlation_is_estimated_from_enough_terrains(terrains: int, failing: int, estimated: bool) -> None:
    terrain = np.repeat(np.arange(terrains), 4)
    success = ~((terrain < failing) & (np.arange(terrain.size) % 4 == 0))
    method = ClusterMethod.KORN_GRAUBARD if estimated else ClusterMethod.TERRAIN_COUNT
    assert clustered_evidence(success, terrain, 0.9).method is method


def test_a_terrain_with_a_single_success_has_succeeded() -> None:
    success, terrain = np.zeros(40, dtype=bool), np.repeat(np.arange(20), 2)
    success[::4] = True  # one of two cases on every second terrain
    evidence = clustered_evidence(success, terrain, 0.9)
    assert evidence.upper == proportion_upper(10, 20, 0.9)
