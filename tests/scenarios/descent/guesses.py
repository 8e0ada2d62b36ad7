"""A velocity estimator of a user's own, for tests: it believes the inertial unit."""

import time

from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome
from marsyard.sim.measurements import DescentMeasurements


class Inertial:
    """The inertial velocity over the second pair."""

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """Always an answer."""
        return VelocityEstimate(VelocityOutcome.VALID, measurements.interval_velocities_m_s[1, :2].copy())


class SlowInertial(Inertial):
    """The same, after a while: long enough to be late on the flight computer."""

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """Always an answer."""
        until = time.process_time() + 0.1
        while time.process_time() < until:
            pass
        return super().estimate(measurements)
