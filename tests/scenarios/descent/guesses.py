"""Custom velocity estimators for tests: they return the inertial velocity."""

import time

from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome
from marsyard.sim.measurements import DescentMeasurements


class Inertial:
    """Return the inertial velocity over the second pair."""

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """Return a valid velocity in each case."""
        return VelocityEstimate(VelocityOutcome.VALID, measurements.interval_velocities_m_s[1, :2].copy())


class SlowInertial(Inertial):
    """Return the same velocity after a delay that exceeds the deadline of the flight computer."""

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """Return a valid velocity after the delay."""
        until = time.process_time() + 0.1
        while time.process_time() < until:
            pass
        return super().estimate(measurements)
