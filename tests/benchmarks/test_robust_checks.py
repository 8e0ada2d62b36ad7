"""Tests of the limit states with a known change to FAIL."""

import numpy as np
import pytest

from benchmarks.validation import robust_checks
from benchmarks.validation.robust_checks import _STATES
from marsyard.reports.dispersion_changes import ChangeKind


@pytest.mark.parametrize("state", _STATES, ids=lambda state: state.name)
def test_rates_are_those_of_drawn_cases(state: robust_checks._State) -> None:
    """The rate without a change and the permitted rate after the exact change: 400,000 cases, five deviations."""
    rng = np.random.default_rng(5)
    for change, rate in ((0.0, state.rate(0.0)), (state.exact, state.permitted)):
        z = rng.standard_normal((400_000, 2))
        if state.kind is ChangeKind.MEAN_UP:
            z[:, 0] += change
        else:
            z[:, 0] *= 1.0 + change if state.kind is ChangeKind.WIDER else 1.0 - change
        member = state.belongs(z)
        drawn = (member & state.fails(z)).sum() / member.sum()
        assert drawn == pytest.approx(rate, abs=5.0 * np.sqrt(rate * (1.0 - rate) / member.sum()))
    assert state.rate(0.0) < 0.7 * state.permitted


def test_wrong_weights_miss_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cases that are weighted for a 25 % smaller shift give a change that is too large."""
    state = _STATES[0]
    z = np.random.default_rng(6).standard_normal((150_000, 2))
    assert state.find(z).change == pytest.approx(state.exact, rel=0.1)
    correct = robust_checks.list_changes
    monkeypatch.setattr(robust_checks, "list_changes", lambda dispersion, values: correct(dispersion, 0.75 * values))
    assert state.find(z).change > 1.1 * state.exact
