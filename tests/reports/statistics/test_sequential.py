"""Tests of sequential evaluation: planned looks, risk of a wrong verdict per look, and additional cases.

A look is one evaluation of the verdict during a campaign (interim analysis).
"""

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from marsyard.reports.statistics.proportions import proportion_lower, proportion_upper
from marsyard.reports.statistics.sequential import SequentialTest, confidence_at, planned_looks, risk_fraction_at


def test_planned_looks_halve_the_number_of_cases() -> None:
    assert [look.cases for look in planned_looks(1000)] == [31, 62, 125, 250, 500, 1000]
    assert [look.cases for look in planned_looks(64)] == [16, 32, 64]
    assert [look.cases for look in planned_looks(20)] == [20]


@given(st.integers(1, 10**9))
def test_looks_spend_the_full_risk(cases: int) -> None:
    looks = planned_looks(cases)
    assert sum(look.risk_fraction for look in looks) == pytest.approx(1.0)
    assert all(look.risk_fraction > 0.0 for look in looks)
    assert looks[-1].cases == cases


def test_risk_fraction_is_that_of_the_next_planned_look() -> None:
    looks = planned_looks(64)
    assert [risk_fraction_at(looks, cases) for cases in (1, 16, 17, 64, 900)] == [0.25, 0.25, 0.25, 0.5, 0.5]
    assert confidence_at(0.9, 0.25) == pytest.approx(0.975)


def test_campaign_without_cases_is_rejected() -> None:
    with pytest.raises(ValueError, match="at least one"):
        planned_looks(0)


@pytest.mark.parametrize("required_rate", [0.9, 0.99])
def test_probability_of_false_verdicts_is_below_the_risk(required_rate: float) -> None:
    # Exact probability that any look at up to 512 cases gives a verdict. The true rate is the required rate.
    # p_undecided: probability of each number of failures without a verdict at earlier looks.
    looks, risk = planned_looks(512), 0.1
    for wrong_verdict in ("PASS", "FAIL"):
        p_undecided, p_verdict, previous_cases = np.ones(1), 0.0, 0
        for look in looks:
            new_cases = look.cases - previous_cases
            previous_cases = look.cases
            failure_counts = np.arange(new_cases + 1)
            p_undecided = np.convolve(p_undecided, stats.binom.pmf(failure_counts, new_cases, 1.0 - required_rate))
            confidence = confidence_at(1.0 - risk, look.risk_fraction)
            for failures in range(p_undecided.size):
                successes = look.cases - failures
                is_pass = proportion_lower(successes, look.cases, confidence) >= required_rate
                is_fail = proportion_upper(successes, look.cases, confidence) < required_rate
                if is_pass or is_fail:
                    p_verdict += p_undecided[failures] if (is_pass if wrong_verdict == "PASS" else is_fail) else 0.0
                    p_undecided[failures] = 0.0
        assert 0.0 < p_verdict <= risk


def _simulate_verdicts(
    rng: np.random.Generator, first_cases: int, max_cases: int, pass_test: SequentialTest, fail_test: SequentialTest
) -> set[str]:
    """Return the verdicts of a campaign that appends the additional cases needed; true and required rate are 0.99."""
    cases, failures, verdicts = first_cases, int(rng.binomial(first_cases, 0.01)), set()
    pass_level = fail_level = 0.1
    while True:
        if stats.binom.cdf(cases - failures, cases, 0.99) < fail_level:
            verdicts.add("FAIL")
        if stats.binom.cdf(failures, cases, 0.01) <= pass_level:
            return verdicts | {"PASS"}
        if cases >= max_cases:
            return verdicts
        cases_needed = min(max_cases, pass_test.cases_needed(cases, failures))
        failures += int(rng.binomial(cases_needed - cases, 0.01))
        cases = cases_needed
        pass_level, fail_level = pass_test.significance_level(cases), fail_test.significance_level(cases)


@pytest.mark.slow
@pytest.mark.parametrize("first_cases", [24, 230])
def test_appending_the_cases_needed_keeps_the_confidence(first_cases: int) -> None:
    """Campaigns have at most 5000 cases. With uncorrected bounds at each evaluation, 38.6 % of them would pass."""
    rng = np.random.default_rng(21)
    pass_test, fail_test = SequentialTest(0.01, 0.1, first_cases), SequentialTest(0.99, 0.1, first_cases)
    # cache the methods for a fast simulation; `SequentialTest` is frozen
    for sequential_test in (pass_test, fail_test):
        object.__setattr__(sequential_test, "significance_level", cache(sequential_test.significance_level))
        object.__setattr__(sequential_test, "cases_needed", cache(sequential_test.cases_needed))
    verdicts = [_simulate_verdicts(rng, first_cases, 5000, pass_test, fail_test) for _ in range(1500)]
    # standard deviation of a fraction of 10 % of 1500: 0.8 %
    for verdict in ("PASS", "FAIL"):
        assert np.mean([verdict in campaign_verdicts for campaign_verdicts in verdicts]) <= 0.1 + 2 * 0.008


@pytest.mark.slow
@pytest.mark.parametrize("first_cases", [1, 24, 230, 388])
@pytest.mark.parametrize(("rate", "confidence"), [(0.01, 0.9), (0.1, 0.95), (0.95, 0.9)])
def test_frequent_looks_keep_the_risk(first_cases: int, rate: float, confidence: float) -> None:
    """The exact probability of a verdict is at most the risk if the campaign is evaluated after each 10 cases."""
    risk, sequential_test = 1.0 - confidence, SequentialTest(rate, 1.0 - confidence, first_cases)
    counts = np.arange(first_cases + 1)
    p_undecided = stats.binom.pmf(counts, first_cases, rate)
    p_undecided[stats.binom.cdf(counts, first_cases, rate) <= risk] = 0.0
    p_verdict = 1.0 - p_undecided.sum()
    for cases in range(first_cases + 1, first_cases + 1501):
        p_undecided = np.convolve(p_undecided, [1.0 - rate, rate])
        if cases % 10 == 0:
            is_decided = stats.binom.cdf(np.arange(cases + 1), cases, rate) <= sequential_test.significance_level(cases)
            p_verdict += p_undecided[is_decided].sum()
            p_undecided[is_decided] = 0.0
    assert p_verdict <= risk


@given(st.integers(0, 400), st.integers(0, 5), st.sampled_from([0.5, 0.9, 0.99]))
def test_number_of_cases_needed_is_the_minimum(first_cases: int, failures: int, required_rate: float) -> None:
    sequential_test = SequentialTest(1.0 - required_rate, 0.1, first_cases)
    cases_needed = sequential_test.cases_needed(max(first_cases, failures), failures)

    def passes(cases: int) -> bool:
        return (
            proportion_lower(cases - failures, cases, 1.0 - sequential_test.significance_level(cases)) >= required_rate
        )

    assert passes(cases_needed)
    assert cases_needed == max(first_cases, failures) or not passes(cases_needed - 1)


def test_cases_needed_at_a_rate_of_events_support_the_verdict() -> None:
    test, n, events = SequentialTest(0.05, 0.1, 259), 259, 9
    total = test.cases_needed(n, events, events / n)

    def lower_bound(cases: int) -> float:
        failures = events / n * cases
        return proportion_lower(cases - failures, cases, 1.0 - test.significance_level(cases))

    assert lower_bound(total) >= 0.95 > lower_bound(int(0.98 * total))
    assert test.cases_needed(n, events) < total
