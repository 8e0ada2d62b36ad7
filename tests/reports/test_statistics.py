from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from reports.statistics import (
    further_cases_needed,
    mean_interval,
    minimum_sample_size,
    proportion_interval,
    proportion_lower,
    proportion_upper,
    quantile_bounds,
    summarize,
)

#: `design.md`, "Minimum number of cases for a reliability at a confidence, by failures seen (binomial)".
SAMPLE_SIZES = {
    (0.99865, 0.90): (1705, 2880, 3941, 4947),
    (0.9973, 0.90): (852, 1440, 1970, 2473),
    (0.99, 0.90): (230, 388, 531, 667),
    (0.95, 0.95): (59, 93, 124, 153),
}
CONFIDENCES = st.sampled_from([0.5, 0.8, 0.9, 0.95, 0.99])
COUNTS = st.integers(0, 400).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n)))


def test_two_sided_interval_of_seven_in_fifty() -> None:
    # Issue 8, bar 1: k = 7, n = 50, 95 %: 0.0582 to 0.2674.
    lower, upper = proportion_interval(7, 50, 0.95)
    assert (round(lower, 4), round(upper, 4)) == (0.0582, 0.2674)


@given(COUNTS, CONFIDENCES)
def test_interval_agrees_with_scipy(counts: tuple[int, int], confidence: float) -> None:
    successes, n = counts
    if n == 0:
        return
    expected = stats.binomtest(successes, n).proportion_ci(confidence, method="exact")
    assert proportion_interval(successes, n, confidence) == pytest.approx((expected.low, expected.high), abs=1e-9)


@given(COUNTS, CONFIDENCES)
def test_lower_bound_solves_its_equation(counts: tuple[int, int], confidence: float) -> None:
    # Clopper & Pearson 1934: at the lower bound p, P(Bin(n, p) >= successes) is what the confidence leaves.
    successes, n = counts
    lower = proportion_lower(successes, n, confidence)
    if successes:
        assert stats.binom.sf(successes - 1, n, lower) == pytest.approx(1 - confidence, abs=1e-9)
    else:
        assert lower == 0.0


@given(COUNTS, CONFIDENCES)
def test_upper_bound_mirrors_the_lower_one(counts: tuple[int, int], confidence: float) -> None:
    successes, n = counts
    mirrored = 1.0 - proportion_lower(n - successes, n, confidence)
    assert proportion_upper(successes, n, confidence) == pytest.approx(mirrored, abs=1e-12)


@given(COUNTS, CONFIDENCES)
def test_one_more_success_raises_the_bound_and_one_more_failure_lowers_it(
    counts: tuple[int, int], confidence: float
) -> None:
    successes, n = counts
    bound = proportion_lower(successes, n, confidence)
    assert proportion_lower(successes + 1, n + 1, confidence) >= bound
    assert proportion_lower(successes, n + 1, confidence) <= bound


def test_no_cases_bound_nothing() -> None:
    assert (proportion_lower(0, 0, 0.9), proportion_upper(0, 0, 0.9)) == (0.0, 1.0)


@pytest.mark.parametrize("counts", [(-1, 3), (4, 3)])
def test_impossible_counts_are_refused(counts: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="successes"):
        proportion_lower(*counts, 0.9)


@pytest.mark.parametrize("confidence", [0.0, 1.0, -0.1, math.nan])
def test_impossible_confidence_is_refused(confidence: float) -> None:
    with pytest.raises(ValueError, match="confidence"):
        proportion_lower(1, 2, confidence)


@pytest.mark.parametrize("true_rate", [0.5, 0.9, 0.99])
def test_coverage_is_exactly_at_least_nominal(true_rate: float) -> None:
    # Not sampled: the coverage is summed over all outcomes of 60 cases.
    n, confidence = 60, 0.9
    outcomes = np.arange(n + 1)
    weights = stats.binom.pmf(outcomes, n, true_rate)
    lower = np.array([proportion_lower(int(k), n, confidence) for k in outcomes])
    upper = np.array([proportion_upper(int(k), n, confidence) for k in outcomes])
    assert weights[lower <= true_rate].sum() >= confidence - 1e-12
    assert weights[upper >= true_rate].sum() >= confidence - 1e-12


@pytest.mark.parametrize(("stated", "expected"), SAMPLE_SIZES.items())
def test_sample_sizes_of_the_design(stated: tuple[float, float], expected: tuple[int, ...]) -> None:
    assert tuple(minimum_sample_size(*stated, failures) for failures in range(4)) == expected


@given(st.floats(0.5, 0.999), st.sampled_from([0.8, 0.9, 0.95]), st.integers(0, 5))
def test_sample_size_is_the_smallest(reliability: float, confidence: float, failures: int) -> None:
    # Second method: P(Bin(n, 1 - reliability) <= failures) falls to 1 - confidence at n and not before.
    n = minimum_sample_size(reliability, confidence, failures)
    risk = 1 - confidence
    assert stats.binom.cdf(failures, n, 1 - reliability) <= risk * (1 + 1e-9)
    assert n == failures + 1 or stats.binom.cdf(failures, n - 1, 1 - reliability) > risk * (1 - 1e-9)


@pytest.mark.parametrize("reliability", [0.0, 1.0, 1.5])
def test_certainty_has_no_sample_size(reliability: float) -> None:
    with pytest.raises(ValueError, match="reliability"):
        minimum_sample_size(reliability, 0.9)


def test_negative_failures_are_refused() -> None:
    with pytest.raises(ValueError, match="failures"):
        minimum_sample_size(0.9, 0.9, -1)


def test_further_cases() -> None:
    assert further_cases_needed(24, 0, 0.99, 0.9) == 230 - 24
    assert further_cases_needed(24, 1, 0.99, 0.9) == 388 - 24
    assert further_cases_needed(500, 0, 0.99, 0.9) == 0


@pytest.mark.parametrize(("quantile", "confidence", "n"), [(0.95, 0.95, 59), (0.99, 0.9, 230), (0.99, 0.95, 299)])
def test_wilks_sample_size_is_the_first_to_bound_a_quantile(quantile: float, confidence: float, n: int) -> None:
    # Wilks 1941: the largest of n values bounds the quantile q from above once q ** n <= 1 - confidence.
    sample = np.arange(float(n))
    assert quantile_bounds(sample, quantile, confidence)[1] == n - 1
    assert quantile_bounds(sample[:-1], quantile, confidence)[1] == math.inf


def test_quantile_bounds_cover() -> None:
    # 1,500 samples: one standard deviation of the coverage is 0.8 %.
    rng = np.random.default_rng(5)
    truth = stats.norm.ppf(0.9)
    bounds = np.array([quantile_bounds(rng.standard_normal(80), 0.9, 0.9) for _ in range(1500)])
    assert np.mean(bounds[:, 0] <= truth) >= 0.9 - 0.024
    assert np.mean(bounds[:, 1] >= truth) >= 0.9 - 0.024


def test_mean_interval_covers() -> None:
    # BCa on 40 exponential values: its coverage is below nominal by about 2 % (Efron 1987); 250 samples: sd 1.4 %.
    rng = np.random.default_rng(6)
    intervals = np.array([mean_interval(rng.exponential(size=40), 0.95) for _ in range(250)])
    assert np.mean((intervals[:, 0] <= 1.0) & (intervals[:, 1] >= 1.0)) >= 0.95 - 0.02 - 3 * 0.014


def test_mean_interval_of_a_large_sample() -> None:
    values = np.random.default_rng(7).normal(3.0, 2.0, 10000)
    # 1.96 * 2 / sqrt(10000) = 0.039
    lower, upper = mean_interval(values, 0.95)
    assert upper - lower == pytest.approx(2 * 0.0392, rel=0.03)
    assert lower < 3.0 < upper


def test_mean_interval_of_few_values() -> None:
    assert all(math.isnan(bound) for bound in mean_interval(np.array([1.0]), 0.9))
    assert mean_interval(np.full(5, 2.5), 0.9) == (2.5, 2.5)
    assert len(mean_interval(np.array([1.0, 2.0]), 0.9)) == 2


def test_summary_of_known_values() -> None:
    summary = summarize(np.array([3.0, -4.0, math.nan, 0.0, math.inf]))
    assert (summary.n, summary.missing, summary.median, summary.largest) == (3, 2, 0.0, 4.0)
    assert summary.mean == pytest.approx(-1 / 3)
    assert summary.rms == pytest.approx(math.sqrt(25 / 3))
    assert summary.robust_sd == pytest.approx(1.4826 * 3.0)


@pytest.mark.parametrize("sample", [[], [math.nan], [2.0]])
def test_summary_of_next_to_nothing(sample: list[float]) -> None:
    summary = summarize(np.array(sample, dtype=np.float64))
    assert summary.n == (sample == [2.0])
    assert math.isnan(summary.sd)
    assert all(quantile.upper == math.inf for quantile in summary.quantiles)


def test_circular_error_of_a_normal_scatter() -> None:
    # For two independent normal parts of unit deviation the median radius is sqrt(2 ln 2) = 1.1774.
    rng = np.random.default_rng(8)
    summary = summarize(np.hypot(*rng.standard_normal((2, 20000))))
    assert summary.quantiles[0].estimate == pytest.approx(math.sqrt(2 * math.log(2)), abs=0.03)
    assert summary.quantiles[1].estimate == pytest.approx(math.sqrt(2 * math.log(20)), abs=0.05)
