"""Attitude of the field test: measurements of the gyros, and the estimate from gyros and sightings of targets.

The gyros measure the Earth's rotation, and drift with their temperature. `solve_attitude` estimates the attitude at the
start of the flight and the constant gyro bias by Gauss-Newton iterations, and propagates the attitude from there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from marsyard.scenarios.fieldtest.parameters import DriftParameters
from marsyard.scenarios.fieldtest.targets import Sightings
from marsyard.sim.dynamics import Motion, Trajectory
from marsyard.sim.dynamics.helicopter import HelicopterFlight
from marsyard.sim.measurements import ImuIncrements
from marsyard.sim.sensor.imu import DEG_H
from marsyard.sim.sensor.inertial import InertialSolution

#: Rotation rate of the Earth, rad/s (WGS 84).
EARTH_RATE_RAD_S = 7.292115e-5
#: Gauss-Newton iterations of attitude and bias.
_ITERATIONS = 3
#: Blocks of the estimated change: rotation vector of the attitude at the start, inertial axes, and gyro bias.
_TURN, _BIAS = slice(0, 3), slice(3, 6)


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
    (_, first_fly_over_end_s), _ = flight.fly_overs_s
    times = start_s + increments.period_s * (np.arange(len(increments.delta_angles_rad)) + 0.5)
    cooling, warming = (
        -np.expm1(-np.maximum(times - change_s, 0.0) / p.time_constant_s)
        for change_s in (first_fly_over_end_s, flight.passes[-1].end_s)
    )
    # the drift is that of the gyro along the body's x axis
    rates = DEG_H * p.across_deg_h_k * (p.change_k * (cooling - warming))
    delta_angles = increments.delta_angles_rad + np.outer(rates * increments.period_s, np.array([1.0, 0.0, 0.0]))
    return replace(increments, delta_angles_rad=delta_angles)


def solve_attitude(
    increments: ImuIncrements,
    first: Sightings,
    second: Sightings,
    sighting_sd_rad: float,
    bias_sd_rad_s: float,
    earth: EarthRotation,
) -> InertialSolution:
    """Estimate the attitude during a flight from its gyros and both passes over the targets.

    - increments: gyro increments of the whole flight
    - first, second: sightings of the two passes
    - sighting_sd_rad: standard deviation of a measured direction
    - bias_sd_rad_s: standard deviation of the gyro bias for the IMU's class
    - earth: rotation that maps the attitudes from inertial axes to world axes
    """
    times = np.concatenate([first.times_s, second.times_s])
    body_directions = np.concatenate([first.body_directions, second.body_directions])
    world_directions = np.concatenate([first.world_directions, second.world_directions])
    inertial_directions = earth.to_inertial(times).apply(world_directions)
    bias = np.zeros(3)
    # attitude at the start of the flight
    measured_directions = _propagate(increments, bias).attitude(first.times_s).apply(first.body_directions)
    start, _ = Rotation.align_vectors(inertial_directions[: len(measured_directions)], measured_directions)
    for _ in range(_ITERATIONS):
        propagated = _propagate(increments, bias)
        predicted = (start * propagated.attitude(times)).apply(body_directions)
        # cross-product matrices of the predicted directions v: M w = v x w
        (x, y, z), zero = predicted.T, np.zeros(len(predicted))
        cross = np.moveaxis(np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]), 2, 0)
        # integral of the attitude matrix up to each time: rotation in the starting axes per unit of bias in body axes
        integral = np.cumsum(propagated.attitudes[:-1].as_matrix() * increments.period_s, axis=0)
        indices = np.clip(np.searchsorted(increments.times_s, times) - 1, 0, len(integral) - 1)
        bias_jacobian = np.einsum("nij,jk,nkl->nil", cross, start.as_matrix(), -integral[indices])
        rows = np.concatenate([-cross, -bias_jacobian], axis=2).reshape(-1, 6) / sighting_sd_rad
        prior = np.concatenate([np.zeros((3, 3)), np.eye(3)], axis=1) / bias_sd_rad_s
        residuals = np.concatenate([(inertial_directions - predicted).ravel() / sighting_sd_rad, -bias / bias_sd_rad_s])
        change = np.linalg.lstsq(np.concatenate([rows, prior]), residuals, rcond=None)[0]
        start = Rotation.from_rotvec(change[_TURN]) * start
        bias = bias + change[_BIAS]
    propagated = _propagate(increments, bias)
    to_world = earth.to_inertial(increments.times_s).inv()
    return replace(propagated, attitudes=to_world * start * propagated.attitudes)


def _propagate(increments: ImuIncrements, bias_rad_s: Float64[np.ndarray, "3"]) -> InertialSolution:
    """Propagate the attitude, relative to its initial value, with the gyro increments corrected for a bias."""
    corrected = replace(increments, delta_angles_rad=increments.delta_angles_rad - bias_rad_s * increments.period_s)
    return InertialSolution.propagate(corrected, Rotation.identity(), np.zeros(3), 0.0)
