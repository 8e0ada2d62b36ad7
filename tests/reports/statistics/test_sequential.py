from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from reports.statistics.proportions import proportion_lower, proportion_upper
from reports.statistics.sequential import confidence_at, looks_of, spent_share


def test_looks_halve_from_the_last_case() -> None:
    assert [look.cases for look in looks_of(1000)] == [31, 62, 125, 250, 500, 1000]
    assert [look.cases for look in looks_of(64)] == [16, 32, 64]
    assert [look.cases for look in looks_of(20)] == [20]


@given(st.integers(1, 10**9))
def test_the_whole_risk_is_spent_and_no_more(cases: int) -> None:
    looks = looks_of(cases)
    assert sum(look.share for look in looks) == pytest.approx(1.0)
    assert all(look.share > 0.0 for look in looks)
    assert looks[-1].cases == cases


def test_share_of_a_judgement() -> None:
    looks = looks_of(64)
    assert [spent_share(looks, cases) for cases in (1, 16, 17, 64, 900)] == [0.25, 0.25, 0.25, 0.5, 0.5]
    assert confidence_at(0.9, 0.25) == pytest.approx(0.975)


def test_a_campaign_without_cases_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one"):
        looks_of(0)


@pytest.mark.parametrize("asked", [0.9, 0.99])
def test_false_verdicts_are_no_more_than_the_confidence_leaves(asked: float) -> None:
    # Exact, not sampled: of all ways in which 512 cases can go, those in which some look decides; at a true rate just
    # at, or just below, the one asked every PASS is false (and the FAIL likewise from above).
    looks, risk = looks_of(512), 0.1
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


def test_peeking_without_a_share_passes_falsely() -> None:
    # The reason for all this: judged at full risk at every look, a rate just below the one asked passes far too often.
    rng = np.random.default_rng(4)
    looks = looks_of(1000)
    passed = 0
    for _ in range(400):
        failed = np.cumsum(rng.random(1000) < 0.1)
        passed += any(proportion_lower(n - int(failed[n - 1]), n, 0.9) >= 0.9 for n in (look.cases for look in looks))
    assert passed / 400 > 0.15
