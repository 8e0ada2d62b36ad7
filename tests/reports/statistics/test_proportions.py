"""Tests of Clopper-Pearson bounds and sample sizes for proportions."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from marsyard.reports.statistics.proportions import (
    additional_cases_needed,
    consumer_risk,
    minimum_sample_size,
    proportion_interval,
    proportion_lower,
    proportion_upper,
)

#: Minimum number of cases for (reliability, confidence), with 0 to 3 failures: binomial distribution.
SAMPLE_SIZES = {
    (0.99865, 0.90): (1705, 2880, 3941, 4947),
    (0.9973, 0.90): (852, 1440, 1970, 2473),
    (0.99, 0.90): (230, 388, 531, 667),
    (0.95, 0.95): (59, 93, 124, 153),
}
CONFIDENCES = st.sampled_from([0.5, 0.8, 0.9, 0.95, 0.99])
#: Pairs (successes, cases).
COUNTS = st.integers(0, 400).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n)))


def test_two_sided_interval_of_7_of_50_has_the_tabulated_bounds() -> None:
    """Clopper-Pearson interval to four decimals."""
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
    # Clopper & Pearson 1934: at the lower bound p, P(Bin(n, p) >= successes) = 1 - confidence
    successes, n = counts
    lower = proportion_lower(successes, n, confidence)
    if successes:
        assert stats.binom.sf(successes - 1, n, lower) == pytest.approx(1 - confidence, abs=1e-9)
    else:
        assert lower == 0.0


@given(COUNTS, CONFIDENCES)
def test_upper_bound_mirrors_the_lower_bound(counts: tuple[int, int], confidence: float) -> None:
    successes, n = counts
    mirrored_bound = 1.0 - proportion_lower(n - successes, n, confidence)
    assert proportion_upper(successes, n, confidence) == pytest.approx(mirrored_bound, abs=1e-12)


@given(COUNTS, CONFIDENCES)
def test_bound_rises_with_successes_and_falls_with_failures(counts: tuple[int, int], confidence: float) -> None:
    successes, n = counts
    bound = proportion_lower(successes, n, confidence)
    assert proportion_lower(successes + 1, n + 1, confidence) >= bound
    assert proportion_lower(successes, n + 1, confidence) <= bound


def test_bounds_without_cases_are_0_and_1() -> None:
    assert (proportion_lower(0, 0, 0.9), proportion_upper(0, 0, 0.9)) == (0.0, 1.0)


@pytest.mark.parametrize("counts", [(-1, 3), (4, 3)])
def test_invalid_counts_are_rejected(counts: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="successes"):
        proportion_lower(*counts, 0.9)


@pytest.mark.parametrize("confidence", [0.0, 1.0, -0.1, math.nan])
def test_invalid_confidence_is_rejected(confidence: float) -> None:
    with pytest.raises(ValueError, match="confidence"):
        proportion_lower(1, 2, confidence)


@pytest.mark.parametrize("true_rate", [0.5, 0.9, 0.99])
def test_exact_coverage_is_not_below_nominal(true_rate: float) -> None:
    # exact coverage: sum of the probabilities of all success counts of 60 cases
    n, confidence = 60, 0.9
    success_counts = np.arange(n + 1)
    weights = stats.binom.pmf(success_counts, n, true_rate)
    lower = np.array([proportion_lower(int(successes), n, confidence) for successes in success_counts])
    upper = np.array([proportion_upper(int(successes), n, confidence) for successes in success_counts])
    assert weights[lower <= true_rate].sum() >= confidence - 1e-12
    assert weights[upper >= true_rate].sum() >= confidence - 1e-12


@pytest.mark.parametrize(("reliability_and_confidence", "expected"), SAMPLE_SIZES.items())
def test_sample_sizes_agree_with_the_table(
    reliability_and_confidence: tuple[float, float], expected: tuple[int, ...]
) -> None:
    assert tuple(minimum_sample_size(*reliability_and_confidence, failures) for failures in range(4)) == expected


@given(st.floats(0.5, 0.999), st.sampled_from([0.8, 0.9, 0.95]), st.integers(0, 5))
def test_sample_size_is_the_smallest_that_meets_the_risk(reliability: float, confidence: float, failures: int) -> None:
    # independent method: n is the smallest with P(Bin(n, 1 - reliability) <= failures) <= 1 - confidence
    n = minimum_sample_size(reliability, confidence, failures)
    risk = 1 - confidence
    assert stats.binom.cdf(failures, n, 1 - reliability) <= risk * (1 + 1e-9)
    assert n == failures + 1 or stats.binom.cdf(failures, n - 1, 1 - reliability) > risk * (1 - 1e-9)


@pytest.mark.parametrize("reliability", [0.0, 1.0, 1.5])
def test_invalid_reliability_is_rejected(reliability: float) -> None:
    with pytest.raises(ValueError, match="reliability"):
        minimum_sample_size(reliability, 0.9)


def test_negative_failures_are_rejected() -> None:
    with pytest.raises(ValueError, match="failures"):
        minimum_sample_size(0.9, 0.9, -1)


def test_additional_cases_complete_the_minimum_sample_size() -> None:
    assert additional_cases_needed(24, 0, 0.99, 0.9) == 230 - 24
    assert additional_cases_needed(24, 1, 0.99, 0.9) == 388 - 24
    assert additional_cases_needed(500, 0, 0.99, 0.9) == 0


@pytest.mark.parametrize("n", [1, 5, 400])
def test_consumer_risk_without_success_is_1(n: int) -> None:
    assert consumer_risk(0, n, 0.9) == 1.0
    assert 0.0 < consumer_risk(1, n, 0.9) <= 1.0
