"""Tests of statistics of samples: intervals of mean, standard deviation and quantiles."""

import math

import numpy as np
import pytest
from scipy import stats

from marsyard.reports.statistics.error_summary import summarize
from marsyard.reports.statistics.samples import mean_interval, quantile_bounds, standard_deviation_interval


@pytest.mark.parametrize(("quantile", "confidence", "n"), [(0.95, 0.95, 59), (0.99, 0.9, 230), (0.99, 0.95, 299)])
def test_quantile_bound_needs_the_sample_size_of_wilks(quantile: float, confidence: float, n: int) -> None:
    # Wilks 1941: the largest of n values is an upper bound of the quantile q if q^n <= 1 - confidence
    sample = np.arange(float(n))
    assert quantile_bounds(sample, quantile, confidence)[1] == n - 1
    assert quantile_bounds(sample[:-1], quantile, confidence)[1] == math.inf


def test_quantile_bounds_have_nominal_coverage() -> None:
    # with 1500 samples the coverage has a standard deviation of 0.8 %; the tolerance is three times that
    rng = np.random.default_rng(5)
    true_quantile = stats.norm.ppf(0.9)
    bounds = np.array([quantile_bounds(rng.standard_normal(80), 0.9, 0.9) for _ in range(1500)])
    assert np.mean(bounds[:, 0] <= true_quantile) >= 0.9 - 0.024
    assert np.mean(bounds[:, 1] >= true_quantile) >= 0.9 - 0.024


def test_standard_deviation_interval_of_eight_values_exists_at_any_confidence() -> None:
    lower, upper = standard_deviation_interval(np.arange(8.0), 0.99999)
    assert 0.0 < lower < np.std(np.arange(8.0), ddof=1) < upper < math.inf


def test_mean_interval_has_nominal_coverage() -> None:
    # the coverage of the BCa interval of 40 exponential values is about 2 % too low (Efron 1987)
    # with 250 samples the coverage has a standard deviation of 1.4 %
    rng = np.random.default_rng(6)
    intervals = np.array([mean_interval(rng.exponential(size=40), 0.95) for _ in range(250)])
    assert np.mean((intervals[:, 0] <= 1.0) & (intervals[:, 1] >= 1.0)) >= 0.95 - 0.02 - 3 * 0.014


def test_mean_interval_of_a_large_sample_agrees_with_the_normal_interval() -> None:
    values = np.random.default_rng(7).normal(3.0, 2.0, 10000)
    # 1.96 * 2 / sqrt(10000) = 0.039
    lower, upper = mean_interval(values, 0.95)
    assert upper - lower == pytest.approx(2 * 0.0392, rel=0.03)
    assert lower < 3.0 < upper


def test_mean_interval_needs_five_values() -> None:
    assert all(math.isnan(bound) for bound in mean_interval(np.array([1.0, 2.0, 4.0, 3.0]), 0.9))
    assert mean_interval(np.full(5, 2.5), 0.9) == (2.5, 2.5)
    lower, upper = mean_interval(np.array([1.0, 2.0, 4.0, 3.0, 5.0]), 0.9)
    assert 1.0 < lower < 3.0 < upper < 5.0


def test_summary_agrees_with_known_values() -> None:
    summary = summarize(np.array([3.0, -4.0, math.nan, 0.0, math.inf]))
    assert (summary.n, summary.missing, summary.median, summary.largest) == (3, 2, 0.0, 4.0)
    assert summary.mean == pytest.approx(-1 / 3)
    assert summary.rms == pytest.approx(math.sqrt(25 / 3))
    # median absolute deviation 3, times 1.4826 for a normal distribution
    assert summary.robust_sd == pytest.approx(1.4826 * 3.0)


@pytest.mark.parametrize("sample", [[], [math.nan], [2.0]])
def test_summary_of_too_few_values_is_nan(sample: list[float]) -> None:
    summary = summarize(np.array(sample, dtype=np.float64))
    assert summary.n == (sample == [2.0])
    assert math.isnan(summary.sd)
    assert all(quantile.upper == math.inf for quantile in summary.quantiles)


def test_radial_quantiles_of_normal_errors_agree_with_the_rayleigh_distribution() -> None:
    # quantile p of the Rayleigh distribution: sqrt(-2 ln(1 - p)); quantiles 0 and 1 are those of 50 % and 95 %
    rng = np.random.default_rng(8)
    summary = summarize(np.hypot(*rng.standard_normal((2, 20000))))
    assert summary.quantiles[0].estimate == pytest.approx(math.sqrt(2 * math.log(2)), abs=0.03)
    assert summary.quantiles[1].estimate == pytest.approx(math.sqrt(2 * math.log(20)), abs=0.05)


def test_standard_deviation_interval_has_nominal_coverage() -> None:
    # with 250 samples the coverage has a standard deviation of 1.4 %
    rng = np.random.default_rng(9)
    intervals = np.array([standard_deviation_interval(rng.normal(0.0, 2.0, 30), 0.95) for _ in range(250)])
    assert np.mean((intervals[:, 0] <= 2.0) & (intervals[:, 1] >= 2.0)) >= 0.95 - 3 * 0.014


def test_standard_deviation_interval_of_normal_values_agrees_with_chi_square() -> None:
    # independent method: (n - 1) s^2 / chi2, exact for normal values
    values = np.random.default_rng(10).normal(0.0, 3.0, 5000)
    squares = float(((values - values.mean()) ** 2).sum())
    exact = np.sqrt(squares / stats.chi2.ppf([0.975, 0.025], values.size - 1))
    assert standard_deviation_interval(values, 0.95) == pytest.approx(tuple(exact), rel=0.003)


def test_standard_deviation_interval_of_few_or_equal_values_is_nan_or_zero() -> None:
    assert all(math.isnan(bound) for bound in standard_deviation_interval(np.arange(7.0), 0.9))
    assert standard_deviation_interval(np.full(8, 2.5), 0.9) == (0.0, 0.0)
