"""Gyros of the field test: they measure the Earth's rotation, and drift with their temperature."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from marsyard.scenarios.fieldtest.parameters import DriftParameters
from marsyard.sim.dynamics import Motion, Trajectory
from marsyard.sim.dynamics.helicopter import HelicopterFlight
from marsyard.sim.measurements import ImuIncrements
from marsyard.sim.sensor.imu import DEG_H

#: Rotation rate of the Earth, rad/s (WGS 84).
EARTH_RATE_RAD_S = 7.292115e-5


@dataclass(frozen=True)
class EarthRotation:
    """Rotation of the surface-fixed world axes (east, north, up) in inertial space.

    - rate_rad_s: rotation vector per second, world axes
    """

    rate_rad_s: Float64[np.ndarray, "3"]

    @classmethod
    def at_latitude(cls, latitude_deg: float) -> EarthRotation:
        """Create the rotation at a geodetic latitude."""
        latitude = np.radians(latitude_deg)
        return cls(EARTH_RATE_RAD_S * np.array([0.0, np.cos(latitude), np.sin(latitude)]))

    def to_inertial(self, times_s: Float64[np.ndarray, "n"]) -> Rotation:
        """Compute the rotations from world axes at times to the inertial axes, which are the world axes at time 0."""
        return Rotation.from_rotvec(np.outer(times_s, self.rate_rad_s))


@dataclass(frozen=True)
class InertialTrajectory(Trajectory):
    """A trajectory with attitudes relative to inertial axes, as gyros measure them; other states are unchanged."""

    trajectory: Trajectory
    earth: EarthRotation

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last time of the trajectory."""
        return self.trajectory.span_s

    def motion(self, times_s: Float64[np.ndarray, "n"]) -> Motion:
        """Compute the true states; see `Trajectory.motion`."""
        motion = self.trajectory.motion(times_s)
        rates = motion.body_rates_rad_s + motion.attitudes.inv().apply(self.earth.rate_rad_s)
        attitudes = self.earth.to_inertial(times_s) * motion.attitudes
        return replace(motion, attitudes=attitudes, body_rates_rad_s=rates)


def add_thermal_drift(
    increments: ImuIncrements, p: DriftParameters, flight: HelicopterFlight, start_s: float
) -> ImuIncrements:
    """Add the temperature-dependent gyro bias; `start_s` is the true time at which the increments start.

    The temperature of the unit follows the air temperature with a first-order lag. The air is cooler from the end of
    the first pass over the targets to the end of the last pass along the line.
    """
    times = start_s + increments.period_s * (np.arange(len(increments.delta_angles_rad)) + 0.5)
    cooling, warming = (
        -np.expm1(-np.maximum(times - change_s, 0.0) / p.time_constant_s)
        for change_s in (flight.fly_overs_s[0][1], flight.passes[-1].end_s)
    )
    # the drift is that of the gyro along the body's x axis
    rates = DEG_H * p.across_deg_h_k * (p.change_k * (cooling - warming))
    delta_angles = increments.delta_angles_rad + np.outer(rates * increments.period_s, np.array([1.0, 0.0, 0.0]))
    return replace(increments, delta_angles_rad=delta_angles)
