"""The guard against slow-downs, on ratios that are drawn: quiet where nothing changed, loud where something did."""

from __future__ import annotations

import time

import numpy as np
import pytest

from benchmarks.check import PAIRS, compare, log_ratios, select_slower

PATHS = ("one", "two", "three", "four", "five", "six")


def draw(rng: np.random.Generator, spread: float, times: float = 1.0) -> dict[str, list[float]]:
    return {name: (np.log(times) + spread * rng.standard_normal(PAIRS)).tolist() for name in PATHS}


@pytest.mark.parametrize("spread", [0.03, 0.2])
def test_noise_raises_no_alarm(spread: float) -> None:
    """At most 1 % of comparisons may call an unchanged program slower: more than 9 of 400 is less likely than 1 %."""
    rng = np.random.default_rng(1)
    alarms = sum(bool(select_slower(compare(draw(rng, spread), draw(rng, spread)))) for _ in range(400))
    assert alarms <= 9


def test_growth_within_what_is_allowed_is_none() -> None:
    rng = np.random.default_rng(2)
    alarms = sum(bool(select_slower(compare(draw(rng, 0.05, 1.1), draw(rng, 0.05)))) for _ in range(200))
    assert alarms <= 6


@pytest.mark.parametrize(("spread", "times"), [(0.05, 1.3), (0.2, 1.8)])
def test_a_slow_down_is_found(spread: float, times: float) -> None:
    rng = np.random.default_rng(3)
    found = 0
    for _ in range(100):
        now = draw(rng, spread) | {"three": draw(rng, spread, times)["three"]}
        found += [one.name for one in select_slower(compare(now, draw(rng, spread)))] == ["three"]
    assert found >= 95


def test_ratios_are_those_of_processor_time() -> None:
    def busy(seconds: float) -> None:
        end = time.process_time() + seconds
        while time.process_time() < end:
            pass

    ratios = log_ratios(lambda: busy(0.02), lambda: busy(0.01), 3)
    assert np.median(ratios) == pytest.approx(np.log(2.0), abs=0.1)
