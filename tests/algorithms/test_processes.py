"""Tests of clocks that measure the limits of programs."""

import os
import time

import pytest

from marsyard.algorithms.exchange.process import AwakeClock
from marsyard.algorithms.processes import processor_time_s


def test_suspension_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    readings = iter([0.0, 0.5, 1.0, 3601.0, 3601.5])
    monkeypatch.setattr(time, "monotonic", lambda: next(readings))
    clock = AwakeClock()
    assert [clock.elapsed_s() for _ in range(4)] == [0.5, 1.0, 2.0, 2.5]


def test_processor_time_is_that_of_the_process() -> None:
    start_s, own_start_s = processor_time_s(os.getpid()), time.process_time()
    while time.process_time() < own_start_s + 0.05:
        pass
    assert processor_time_s(os.getpid()) - start_s == pytest.approx(time.process_time() - own_start_s, abs=0.02)
