"""Tests of the GPS receiver."""

import numpy as np
import pytest

from marsyard.sim.sensor import Gps
from tests.sim.sensor.test_ranging import DESCENT, RTK


def test_receiver_errors_have_the_specified_deviations() -> None:
    errors, time = [], np.array([2.0])
    true_position = DESCENT.motion(time).positions_m[0]
    for seed in range(200):
        rng = np.random.default_rng(seed)
        gps = Gps.draw(RTK, (0.0, 10.0), rng)
        errors.append(gps.measure(DESCENT, time, rng).values[0] - true_position)
    # The standard errors from 400 and 200 values are 3.5 % and 5 %; the tolerance is three times that.
    assert np.std(np.array(errors)[:, :2]) == pytest.approx(np.hypot(0.01, 0.01), rel=0.11)
    assert np.std(np.array(errors)[:, 2]) == pytest.approx(np.hypot(0.015, 0.02), rel=0.15)
