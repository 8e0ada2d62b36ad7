"""Tests of what instruments share: clocks and Gauss-Markov processes."""

import numpy as np
import pytest

from marsyard.sim.sensor import Clock, ClockParameters
from marsyard.sim.sensor.instrument import GaussMarkov


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


def test_process_is_stationary_from_the_start() -> None:
    rng = np.random.default_rng(0)
    process = GaussMarkov.draw(np.repeat([2.0, 5.0], 2000), 100.0, (-50.0, 250.0), rng)
    early, later = process.at(np.array([-50.0])), process.at(np.array([50.0]))
    # The standard errors from 2,000 channels are 1.6 % of the deviation and 0.02 of a correlation; tolerances are four
    # times that.
    for channels, sd in ((slice(0, 2000), 2.0), (slice(2000, 4000), 5.0)):
        assert np.std(early[0, channels]) == pytest.approx(sd, rel=0.065)
        assert np.std(later[0, channels]) == pytest.approx(sd, rel=0.065)
        # The two times differ by one correlation time.
        assert np.corrcoef(early[0, channels], later[0, channels])[0, 1] == pytest.approx(np.exp(-1.0), abs=0.08)


def test_process_rejects_times_outside_its_span() -> None:
    process = GaussMarkov.draw(np.ones(3), 100.0, (0.0, 10.0), np.random.default_rng(0))
    with pytest.raises(ValueError, match=r"outside the sampled errors, 0\.000 s"):
        process.at(np.array([-1.0]))
    with pytest.raises(ValueError, match="finite span"):
        GaussMarkov.draw(np.ones(3), 100.0, (-np.inf, 10.0), np.random.default_rng(0))
