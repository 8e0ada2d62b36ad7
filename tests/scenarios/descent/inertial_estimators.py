"""Custom velocity estimators for tests of algorithm selection: they return the measured inertial velocity."""

from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome
from marsyard.sim.measurements import DescentMeasurements


class InertialEstimator:
    """Estimator that returns the inertial velocity over the second pair of images."""

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """Return the horizontal velocity (m/s) with the outcome VALID."""
        return VelocityEstimate(VelocityOutcome.VALID, measurements.interval_velocities_m_s[1, :2].copy())
