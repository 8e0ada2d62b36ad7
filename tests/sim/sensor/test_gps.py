"""Tests of the GPS receiver."""

import numpy as np
import pytest

from marsyard.sim.sensor import Gps, GpsParameters
from tests.sim.sensor.motions import Swaying

#: A carrier-phase receiver with a nearby base station, resolved integer ambiguities and errors of 2 cm.
RECEIVER = GpsParameters(
    horizontal_noise_m=0.01, vertical_noise_m=0.015, horizontal_wander_m=0.01, vertical_wander_m=0.02, correlation_s=120
)


def test_receiver_errors_have_the_specified_deviations() -> None:
    errors, time = [], np.array([2.0])
    descent = Swaying(position_m=(2500.0, 2500.0, 2000.0), velocity_m_s=(10.0, 0.0, -75.0))
    true_position = descent.motion(time).positions_m[0]
    for seed in range(200):
        rng = np.random.default_rng(seed)
        gps = Gps.draw(RECEIVER, (0.0, 10.0), rng)
        errors.append(gps.measure(descent, time, rng).values[0] - true_position)
    # The standard errors from 400 and 200 values are 3.5 % and 5 %; the tolerance is three times that.
    assert np.std(np.array(errors)[:, :2]) == pytest.approx(np.hypot(0.01, 0.01), rel=0.11)
    assert np.std(np.array(errors)[:, 2]) == pytest.approx(np.hypot(0.015, 0.02), rel=0.15)
