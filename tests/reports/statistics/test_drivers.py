"""Tests of `estimate_driver` (effect of a condition on errors): rank correlation, explained variance, intervals."""

import math

import numpy as np
import pytest
from scipy import stats

from marsyard.reports.statistics.drivers import Driver, estimate_driver


def _estimate_driver(condition: np.ndarray, errors: np.ndarray, groups: np.ndarray | None = None) -> Driver:
    result = estimate_driver(condition, errors, groups, 0.9)
    assert result is not None
    return result


def test_linear_driver_has_the_expected_rank_correlation() -> None:
    rng = np.random.default_rng(1)
    condition, noise = rng.normal(size=(2, 4000))
    result = _estimate_driver(condition, condition + noise)
    assert result.correlation == pytest.approx(stats.spearmanr(condition, condition + noise).statistic)
    # Spearman's coefficient of a normal pair with Pearson's 1 / sqrt(2): 6 / pi asin(0.7071 / 2) = 0.690
    assert result.lower < 0.690 < result.upper
    # explained variance of the ranks: square of the coefficient
    assert result.fraction == pytest.approx(0.690**2, abs=0.03)
    assert result.p_value < 1e-9


def test_quadratic_driver_explains_variance_without_correlation() -> None:
    rng = np.random.default_rng(2)
    condition = rng.uniform(-1.0, 1.0, 2000)
    result = _estimate_driver(condition, condition**2 + rng.normal(0.0, 0.05, 2000))
    assert abs(result.correlation) < 0.06
    assert result.fraction_lower > 0.8


@pytest.mark.parametrize("n", [60, pytest.param(600, marks=pytest.mark.slow)])
def test_intervals_of_an_unrelated_condition_contain_zero(n: int) -> None:
    # 200 samples: standard deviation of the coverage 2.1 % at 90 %, 1.5 % at 95 %
    rng = np.random.default_rng(3)
    results = [_estimate_driver(rng.normal(size=n), rng.exponential(size=n)) for _ in range(200)]
    assert np.mean([result.lower <= 0.0 <= result.upper for result in results]) >= 0.9 - 3 * 0.021
    assert np.mean([result.p_value < 0.1 for result in results]) <= 0.1 + 3 * 0.021
    # one-sided lower bound: above zero in at most 5 % of samples
    assert np.mean([result.fraction_lower > 0.0 for result in results]) <= 0.05 + 3 * 0.015


def test_interval_for_a_condition_of_the_terrain_counts_terrains() -> None:
    # Errors differ between 40 terrains and do not depend on the slope. The interval for 800 independent cases excludes
    # zero in more than 10 % of samples.
    rng = np.random.default_rng(4)
    groups = np.repeat(np.arange(40), 20)
    n_missed = {True: 0, False: 0}
    for _ in range(100):
        slope, terrain_error = rng.normal(size=(2, 40))
        errors = terrain_error[groups] + rng.normal(size=800)
        for use_groups in n_missed:
            result = _estimate_driver(slope[groups], errors, groups if use_groups else None)
            n_missed[use_groups] += not result.lower <= 0.0 <= result.upper
    assert n_missed[True] / 100 <= 0.1 + 3 * 0.03
    assert n_missed[False] / 100 > 0.5


def test_binary_condition_has_a_significant_effect() -> None:
    condition = np.repeat([0.0, 1.0], [90, 10])
    result = _estimate_driver(condition, np.where(condition == 1.0, 5.0, 1.0) + np.linspace(0.0, 0.5, 100))
    assert result.fraction > 0.2
    assert result.p_value < 1e-4


def test_constant_or_short_samples_give_no_result() -> None:
    assert estimate_driver(np.ones(50), np.arange(50.0), None, 0.9) is None
    assert estimate_driver(np.arange(19.0), np.arange(19.0), None, 0.9) is None


def test_explained_fraction_is_1_for_constant_responses() -> None:
    """Two conditions with constant responses: the explained fraction is 1 and the F ratio infinite."""
    condition = np.repeat([400.0, 800.0], 20)
    result = estimate_driver(condition, condition / 400.0, None, 0.9)
    assert (result.fraction, result.fraction_lower, result.fraction_upper) == (1.0, 1.0, 1.0)
    # none of 20,000 permutations separates the 20 events: the smallest p-value of the test
    assert result.p_value == pytest.approx(1.0 / 20_001)
    assert result.correlation == pytest.approx(1.0)


def test_few_events_in_one_bin_have_the_exact_probability() -> None:
    """Three events in one of six bins of 15 cases: six times C(15, 3) of C(90, 3) choices."""
    condition, failed = np.arange(90.0), np.zeros(90)
    failed[[16, 20, 27]] = 1.0
    assert _estimate_driver(condition, failed).p_value == pytest.approx(
        6 * math.comb(15, 3) / math.comb(90, 3), rel=0.1
    )
    # a flag that equals the failures: one of C(90, 2) choices, below the resolution of the test
    failed[16] = 0.0
    assert 0.0 < _estimate_driver(failed, failed).p_value < 1e-3
