"""Tests of clock offset and time tag jitter."""

import numpy as np
import pytest

from marsyard.sim.sensor import Clock, ClockParameters


def test_clock_offset_is_common_and_jitter_is_independent() -> None:
    parameters = ClockParameters(offset_s=0.1, offset_sd_s=0.02, jitter_sd_s=0.003)
    offsets, jitters = [], []
    for seed in range(400):
        rng = np.random.default_rng(seed)
        clock = Clock.draw(parameters, rng)
        errors = clock.tags(np.array([1.0, 2.0]), rng) - [1.0, 2.0]
        offsets.append(clock.offset_s)
        jitters.append((errors[0] - errors[1]) / np.sqrt(2.0))
        assert errors.mean() == pytest.approx(clock.offset_s, abs=0.015)
    # The standard errors from 400 values are 3.5 % of the deviation and 0.001 s of the mean; tolerances are three times
    # that.
    assert np.mean(offsets) == pytest.approx(0.1, abs=0.003)
    assert np.std(offsets) == pytest.approx(0.02, rel=0.11)
    assert np.std(jitters) == pytest.approx(0.003, rel=0.11)


def test_error_free_tags_are_exact() -> None:
    rng = np.random.default_rng(0)
    np.testing.assert_array_equal(Clock.draw(ClockParameters(), rng).tags(np.array([1.5, 2.5]), rng), [1.5, 2.5])
