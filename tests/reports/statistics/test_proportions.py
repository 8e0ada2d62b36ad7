"""Tests of Clopper-Pearson bounds and sample sizes for proportions."""

import math
from collections.abc import Callable
from functools import partial

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


@given(COUNTS, CONFIDENCES)
def test_interval_agrees_with_scipy(counts: tuple[int, int], confidence: float) -> None:
    successes, n = counts
    if n == 0:
        return
    expected = stats.binomtest(successes, n).proportion_ci(confidence, method="exact")
    assert proportion_interval(successes, n, confidence) == pytest.approx((expected.low, expected.high), abs=1e-9)


def test_bounds_without_cases_are_0_and_1() -> None:
    assert (proportion_lower(0, 0, 0.9), proportion_upper(0, 0, 0.9)) == (0.0, 1.0)


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


@pytest.mark.parametrize(
    ("call", "message"),
    [
        *((partial(proportion_lower, *counts, 0.9), "successes") for counts in ((-1, 3), (4, 3))),
        *((partial(proportion_lower, 1, 2, confidence), "confidence") for confidence in (0.0, 1.0, -0.1, math.nan)),
        *((partial(minimum_sample_size, reliability, 0.9), "reliability") for reliability in (0.0, 1.0, 1.5)),
        (partial(minimum_sample_size, 0.9, 0.9, -1), "failures"),
    ],
)
def test_invalid_numbers_are_rejected(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()


def test_additional_cases_complete_the_minimum_sample_size() -> None:
    assert additional_cases_needed(24, 0, 0.99, 0.9) == 230 - 24
    assert additional_cases_needed(24, 1, 0.99, 0.9) == 388 - 24
    assert additional_cases_needed(500, 0, 0.99, 0.9) == 0


@pytest.mark.parametrize("n", [1, 5, 400])
def test_consumer_risk_without_success_is_1(n: int) -> None:
    assert consumer_risk(0, n, 0.9) == 1.0
    assert 0.0 < consumer_risk(1, n, 0.9) <= 1.0
