"""Fixture of one simulated lander flight (parachute and powered descent) for the tests of localisation."""

import numpy as np
import pytest

from marsyard.scenarios.localisation.flight import LanderFlight, ProfileParameters

#: Height of the level ground.
GROUND_M = -100.0
GRAVITY_M_S2 = 3.72


@pytest.fixture(scope="session")
def flight() -> LanderFlight:
    """Return a flight with the default parameters that starts 4200 m above the ground, not above the world's origin."""
    start = np.array([300.0, -200.0, GROUND_M + 4200.0])
    parameters = ProfileParameters()
    rng = np.random.default_rng(1)
    return LanderFlight.simulate(parameters, start, rng, ground_height_m=GROUND_M, gravity_m_s2=GRAVITY_M_S2)
