"""Errors of on-board inertial navigation at the start of a descent, propagated along a nominal flight.

The flight begins at the last attitude measurement by stars (the star reference). It continues through spinning cruise,
entry and parachute phase to the start of the descent. The time steps resolve the spin:

    d(attitude)/dt = R (bias + sensitivity error x body rate) + noise
    d(velocity)/dt = attitude x (R f) + R (bias + sensitivity error x f) + noise

R is the nominal attitude and f the nominal specific force. Both errors are in world axes, to first order (Titterton and
Weston, Strapdown Inertial Navigation Technology, ch. 12). The effect of the errors on gravity is neglected. The sensor
errors are the same as in the descent.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from marsyard.sim.error_sources import ACCELERATION, ATTITUDE
from marsyard.sim.frames import multiply_quaternions
from marsyard.sim.parameters import NonNegative, Parameters, Positive
from marsyard.sim.sensor.imu import Imu
from marsyard.sim.sensor.instrument import Times, Vector, Vectors

#: Propagation steps per second: at 2 rpm the relative error of the midpoint rule over the spin is 5e-5.
STEPS_PER_S = 5.0
_MEAN_SIN4 = 3.0 / 8.0  #: Mean of sin^4, the assumed profile of the deceleration during entry.


@dataclass(frozen=True)
class NavigationErrors:
    """Navigation errors at one time.

    - attitude_rad: rotation vector from the true to the estimated attitude, world axes
    - velocity_m_s: estimated minus true velocity, world axes
    """

    attitude_rad: Vector
    velocity_m_s: Vector

    def apply(self, attitude: Rotation, velocity_m_s: Vector) -> tuple[Rotation, Vector]:
        """Add the errors to a true attitude and velocity."""
        return Rotation.from_rotvec(self.attitude_rad) * attitude, velocity_m_s + self.velocity_m_s


class ApproachParameters(Parameters):
    """Parameters of the flight from the last star reference to the descent, by default of the MER landings.

    Nominal times and speeds: Desai and Knocke (2007), rounded. Assumed: the errors of the star reference, and the
    scale factor error of the spin-axis gyro after its calibration against the stars during cruise.
    """

    attitude_sd_deg: Annotated[
        NonNegative, ATTITUDE, Field(description="attitude error at the reference per axis, deg")
    ] = 0.05
    velocity_sd_m_s: Annotated[
        NonNegative, ACCELERATION, Field(description="velocity error at the reference per axis, m/s")
    ] = 1.0
    spin_scale_ppm: Annotated[NonNegative, ATTITUDE, Field(description="scale factor error of the spin gyro, ppm")] = (
        100.0
    )
    cruise_s: Annotated[NonNegative, Field(le=20000.0, description="time from star reference to entry, s")] = 900.0
    entry_s: Annotated[Positive, Field(le=2000.0, description="time from entry to parachute deployment, s")] = 240.0
    parachute_s: Annotated[Positive, Field(le=2000.0, description="time from deployment to the descent, s")] = 80.0
    spin_rpm: Annotated[float, Field(ge=-10.0, le=10.0, description="spin until deployment, rpm")] = 2.0
    heading_deg: Annotated[float, Field(ge=-360.0, le=720.0, description="azimuth of the velocity at entry")] = 80.0
    entry_off_nadir_deg: Annotated[float, Field(ge=0.0, le=180.0, description="nadir angle at entry, deg")] = 78.0
    deploy_off_nadir_deg: Annotated[float, Field(ge=0.0, le=180.0, description="nadir angle at deployment, deg")] = 62.0
    upright_s: Annotated[Positive, Field(description="time from deployment until the body is upright, s")] = 30.0
    entry_delta_v_m_s: Annotated[Positive, Field(description="velocity change from entry to deployment, m/s")] = 5000.0
    parachute_delta_v_m_s: Annotated[NonNegative, Field(description="velocity change under the parachute, m/s")] = 340.0
    inflation_s: Annotated[Positive, Field(description="time constant of this velocity change, s")] = 8.0
    gravity_m_s2: Annotated[NonNegative, Field(description="local gravity, m/s2")] = 3.71

    @property
    def duration_s(self) -> float:
        """Duration from the star reference to the start of the descent, s."""
        return self.cruise_s + self.entry_s + self.parachute_s


@dataclass(frozen=True)
class Approach:
    """Nominal profile from the last star reference to the start of the descent at `end_s`."""

    parameters: ApproachParameters
    end_s: float

    @property
    def start_s(self) -> float:
        """Time of the star reference, s."""
        return self.end_s - self.parameters.duration_s

    def calibrate(self, imu: Imu, rng: np.random.Generator) -> Imu:
        """Replace the scale factor error of the z gyro (the spin axis) by its residual after calibration."""
        scale = imu.gyro.scale.copy()
        scale[2] = 1e-6 * self.parameters.spin_scale_ppm * float(rng.standard_normal())
        return replace(imu, gyro=replace(imu.gyro, scale=scale))

    def errors(self, imu: Imu, rng: np.random.Generator) -> NavigationErrors:
        """Propagate the errors to the start of the descent; the time span of `imu` must include the flight."""
        p = self.parameters
        count = int(np.ceil(p.duration_s * STEPS_PER_S))
        step = p.duration_s / count
        times = self.start_s + step * (np.arange(count) + 0.5)
        attitudes, rates, forces = self.attitudes(times), self.body_rates(times), self.specific_forces(times)
        attitude_increments = attitudes.apply(imu.gyro.bias_at(times) + rates @ imu.gyro.sensitivity_error.T) * step
        attitude_increments += imu.gyro.random_walk * np.sqrt(step) * rng.standard_normal(attitude_increments.shape)
        initial_attitude = np.radians(p.attitude_sd_deg) * rng.standard_normal(3)
        attitude = initial_attitude + np.cumsum(attitude_increments, axis=0)
        force_errors = imu.accelerometer.bias_at(times) + forces @ imu.accelerometer.sensitivity_error.T
        midpoint_attitude = attitude - 0.5 * attitude_increments
        increments = (np.cross(midpoint_attitude, attitudes.apply(forces)) + attitudes.apply(force_errors)) * step
        increments += imu.accelerometer.random_walk * np.sqrt(step) * rng.standard_normal(increments.shape)
        velocity = p.velocity_sd_m_s * rng.standard_normal(3) + increments.sum(axis=0)
        return NavigationErrors(attitude_rad=attitude[-1], velocity_m_s=velocity)

    def attitudes(self, times_s: Times) -> Rotation:
        """Compute nominal rotations from body to world axes: body -z along the velocity, with spin about this axis."""
        pitch = Rotation.from_rotvec(np.interp(times_s, *self._pitch_profile())[:, None] * self._pitch_axis())
        spin = Rotation.from_rotvec(self._spin_angle(times_s)[:, None] * np.array([0.0, 0.0, 1.0]))
        return Rotation.from_quat(multiply_quaternions(pitch.as_quat(), spin.as_quat()))

    def body_rates(self, times_s: Times) -> Vectors:
        """Compute nominal angular velocities, body axes, rad/s."""
        # the pitch axis is fixed in world axes and rotates with the spin in body axes
        times, angles = self._pitch_profile()
        knot_rates = np.concatenate([[0.0], np.diff(angles) / np.diff(times), [0.0]])
        pitch_rates = knot_rates[np.searchsorted(times, times_s, side="right")]
        angle, (first, second, _) = self._spin_angle(times_s), self._pitch_axis()
        x = pitch_rates * (np.cos(angle) * first + np.sin(angle) * second)
        y = pitch_rates * (np.cos(angle) * second - np.sin(angle) * first)
        return np.stack([x, y, np.where(times_s < self._deploy_s(), self._spin_rate(), 0.0)], axis=1)

    def specific_forces(self, times_s: Times) -> Vectors:
        """Compute nominal specific forces, body axes, m/s2: drag along the spin axis."""
        p = self.parameters
        entry_fraction = np.clip((times_s - (self._deploy_s() - p.entry_s)) / p.entry_s, 0.0, 1.0)
        drag = p.entry_delta_v_m_s / (p.entry_s * _MEAN_SIN4) * np.sin(np.pi * entry_fraction) ** 4
        since_deployment_s = np.maximum(times_s - self._deploy_s(), 0.0)
        braking = p.parachute_delta_v_m_s / p.inflation_s * np.exp(-since_deployment_s / p.inflation_s) + p.gravity_m_s2
        drag += np.where(times_s >= self._deploy_s(), braking, 0.0)
        return np.asarray(drag[:, None] * np.array([0.0, 0.0, 1.0]))

    def _deploy_s(self) -> float:
        return self.end_s - self.parameters.parachute_s

    def _spin_rate(self) -> float:
        return float(2.0 * np.pi * self.parameters.spin_rpm / 60.0)

    def _spin_angle(self, times_s: Times) -> Times:
        return np.asarray(self._spin_rate() * (np.minimum(times_s, self._deploy_s()) - self.start_s))

    def _pitch_axis(self) -> Vector:
        """Return the horizontal unit vector, world axes, about which the body pitches."""
        # a rotation about this axis tilts nadir towards the heading a; axis = (0, 0, -1) x (sin a, cos a, 0)
        heading = np.radians(self.parameters.heading_deg)
        return np.array([np.cos(heading), -np.sin(heading), 0.0])

    def _pitch_profile(self) -> tuple[Vector, Vector]:
        """Return the times at which the pitch rate changes, and the angles of the velocity from nadir."""
        p = self.parameters
        times = self._deploy_s() + np.array([-p.entry_s, 0.0, p.upright_s])
        return times, np.radians([p.entry_off_nadir_deg, p.deploy_off_nadir_deg, 0.0])
