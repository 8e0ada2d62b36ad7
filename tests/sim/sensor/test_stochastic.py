"""Tests of the first-order Gauss-Markov process of slowly varying instrument errors: variance, correlation, span."""

import numpy as np
import pytest

from marsyard.sim.sensor.instrument import GaussMarkov


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
