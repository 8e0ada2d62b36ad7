from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from marsyard.reports.statistics.proportions import (
    LaterLook,
    confidence_at,
    planned_looks,
    proportion_lower,
    proportion_upper,
    spent_fraction,
)


def test_looks_halve_from_the_last_case() -> None:
    assert [look.cases for look in planned_looks(1000)] == [31, 62, 125, 250, 500, 1000]
    assert [look.cases for look in planned_looks(64)] == [16, 32, 64]
    assert [look.cases for look in planned_looks(20)] == [20]


@given(st.integers(1, 10**9))
def test_the_whole_risk_is_spent_and_no_more(cases: int) -> None:
    looks = planned_looks(cases)
    assert sum(look.share for look in looks) == pytest.approx(1.0)
    assert all(look.share > 0.0 for look in looks)
    assert looks[-1].cases == cases


def test_spent_fraction_of_a_look() -> None:
    looks = planned_looks(64)
    assert [spent_fraction(looks, cases) for cases in (1, 16, 17, 64, 900)] == [0.25, 0.25, 0.25, 0.5, 0.5]
    assert confidence_at(0.9, 0.25) == pytest.approx(0.975)


def test_a_campaign_without_cases_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one"):
        planned_looks(0)


@pytest.mark.parametrize("asked", [0.9, 0.99])
def test_false_verdicts_are_no_more_than_the_confidence_leaves(asked: float) -> None:
    # Exact, not sampled: of all ways in which 512 cases can go, those in which some look decides; at a true rate just
    # at, or just below, the one asked every PASS is false (and the FAIL likewise from above).
    looks, risk = planned_looks(512), 0.1
    for falsely in ("PASS", "FAIL"):
        alive, decided, before = np.ones(1), 0.0, 0
        for look in looks:
            added = look.cases - before
            before = look.cases
            failures = np.arange(added + 1)
            alive = np.convolve(alive, stats.binom.pmf(failures, added, 1.0 - asked))
            confidence = confidence_at(1.0 - risk, look.share)
            for k in range(alive.size):
                good = look.cases - k
                passed = proportion_lower(good, look.cases, confidence) >= asked
                failed = proportion_upper(good, look.cases, confidence) < asked
                if passed or failed:
                    decided += alive[k] if (passed if falsely == "PASS" else failed) else 0.0
                    alive[k] = 0.0
        assert 0.0 < decided <= risk


def test_repeated_looks_without_spending_pass_falsely() -> None:
    # The reason for all this: judged at full risk at every look, a rate just below the one asked passes far too often.
    rng = np.random.default_rng(4)
    looks = planned_looks(1000)
    passed = 0
    for _ in range(400):
        failed = np.cumsum(rng.random(1000) < 0.1)
        passed += any(proportion_lower(n - int(failed[n - 1]), n, 0.9) >= 0.9 for n in (look.cases for look in looks))
    assert passed / 400 > 0.15


def _follow_advice(rng: np.random.Generator, first: int, most: int, passes: LaterLook, fails: LaterLook) -> set[str]:
    """Verdicts of one campaign at a true rate of 0.99, asked 0.99 at 0.9, which is appended to as it advises."""
    cases, failures, verdicts = first, int(rng.binomial(first, 0.01)), set()
    pass_risk = fail_risk = 0.1
    while True:
        if stats.binom.cdf(cases - failures, cases, 0.99) < fail_risk:
            verdicts.add("FAIL")
        if stats.binom.cdf(failures, cases, 0.01) <= pass_risk:
            return verdicts | {"PASS"}
        if cases >= most:
            return verdicts
        needed = min(most, passes.cases_needed(cases, failures))
        failures += int(rng.binomial(needed - cases, 0.01))
        cases = needed
        pass_risk, fail_risk = passes.risk_of_bound(cases), fails.risk_of_bound(cases)


@pytest.mark.parametrize("first", [24, 230])
def test_appending_as_advised_keeps_the_confidence(first: int) -> None:
    """At most 5,000 cases; with the ordinary bounds at each look 38.6 % of these campaigns passed falsely."""
    rng = np.random.default_rng(21)
    passes, fails = LaterLook(0.01, 0.1, first), LaterLook(0.99, 0.1, first)
    for look in (passes, fails):
        object.__setattr__(look, "risk_of_bound", cache(look.risk_of_bound))
        object.__setattr__(look, "cases_needed", cache(look.cases_needed))
    verdicts = [_follow_advice(rng, first, 5000, passes, fails) for _ in range(1500)]
    # one standard deviation of a share of 10 % of 1,500 is 0.8 %
    for verdict in ("PASS", "FAIL"):
        assert np.mean([verdict in one for one in verdicts]) <= 0.1 + 2 * 0.008


@pytest.mark.parametrize("first", [1, 24, 230, 388])
@pytest.mark.parametrize(("rate", "confidence"), [(0.01, 0.9), (0.1, 0.95), (0.95, 0.9)])
def test_a_look_at_any_time_keeps_the_risk_exactly(first: int, rate: float, confidence: float) -> None:
    """Looks at every tenth case after the first look, exact: the chance of a verdict at any of them is below the risk.

    No rule for when to look can do worse.
    """
    risk, look = 1.0 - confidence, LaterLook(rate, 1.0 - confidence, first)
    counts = np.arange(first + 1)
    undecided = stats.binom.pmf(counts, first, rate)
    undecided[stats.binom.cdf(counts, first, rate) <= risk] = 0.0
    decided = 1.0 - undecided.sum()
    for cases in range(first + 1, first + 1501):
        undecided = np.convolve(undecided, [1.0 - rate, rate])
        if cases % 10 == 0:
            verdict = stats.binom.cdf(np.arange(cases + 1), cases, rate) <= look.risk_of_bound(cases)
            decided += undecided[verdict].sum()
            undecided[verdict] = 0.0
    assert decided <= risk


@given(st.integers(0, 400), st.integers(0, 5), st.sampled_from([0.5, 0.9, 0.99]))
def test_the_advised_number_of_cases_is_the_minimum(first: int, failures: int, asked: float) -> None:
    look = LaterLook(1.0 - asked, 0.1, first)
    needed = look.cases_needed(max(first, failures), failures)

    def passes(cases: int) -> bool:
        return proportion_lower(cases - failures, cases, 1.0 - look.risk_of_bound(cases)) >= asked

    assert passes(needed)
    assert needed == max(first, failures) or not passes(needed - 1)
