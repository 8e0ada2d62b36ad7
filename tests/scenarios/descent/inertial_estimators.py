"""Custom velocity estimators for tests of algorithm selection: they return the measured inertial velocity."""

import time

from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome
from marsyard.sim.measurements import DescentMeasurements


class InertialEstimator:
    """Estimator that returns the inertial velocity over the second pair of images."""

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """Return the horizontal velocity (m/s) with the outcome VALID."""
        return VelocityEstimate(VelocityOutcome.VALID, measurements.interval_velocities_m_s[1, :2].copy())


class SlowInertialEstimator(InertialEstimator):
    """Estimator with a run time of 0.1 s; on the slower flight computer the answer comes after the firing."""

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """Return the velocity after 0.1 s of processor time."""
        end_s = time.process_time() + 0.1
        while time.process_time() < end_s:
            pass
        return super().estimate(measurements)
