"""On-board navigation filter of the helicopter: an error-state Kalman filter of inertial unit, RTK, compass and tilt.

The filter is an instrument: an algorithm under test receives only its poses, with time-correlated errors.

Fifteen errors are estimated (landing paper, section IV, and its reference [12]): position, velocity, attitude
(multiplicative), gyro bias and accelerometer bias. Time-correlated errors of the readings, the receiver's wander and
the constant errors of compass and inclinometers, are *considered* (Schmidt 1966): they are part of the covariance and
never estimated. Otherwise the covariance would claim that averaging removes them.

The filter knows the standard deviations of the instruments' parameters, not the drawn errors. The receiver reports its
own position deviation. Solutions are propagated from their time to that of their delivery by inertial navigation. The
noise of inclinometers and compass grows with the helicopter's acceleration. Readings outside the gate are rejected, as
are those of stuck instruments. After a number of rejected solutions the filter restarts at the next one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float64, Int64
from pydantic import Field
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.frames import rigid
from marsyard.sim.parameters import Parameters, Positive
from marsyard.sim.sensor.imu import DEG_H, DEG_SQRT_H, MILLI_G, STANDARD_GRAVITY_M_S2, ImuIncrements, ImuParameters
from marsyard.sim.sensor.navigation import kernels
from marsyard.sim.sensor.satellite_navigation import RtkParameters, RtkSolutions, SolutionErrors
from marsyard.sim.sensor.tilt_compass import TiltCompassParameters, TiltCompassReadings


class FilterParameters(Parameters):
    """Assumptions of the filter in addition to the parameters of its instruments."""

    initial_position_sd_m: Annotated[Positive, Field(description="deviation of position before the first fix, m")] = (
        30.0
    )
    initial_velocity_sd_m_s: Annotated[Positive, Field(description="deviation of velocity before that, m/s")] = 3.0
    initial_tilt_sd_deg: Annotated[Positive, Field(description="deviation of pitch and roll before readings, deg")] = (
        5.0
    )
    initial_heading_sd_deg: Annotated[Positive, Field(description="deviation of heading before readings, deg")] = 20.0
    disturbance: Annotated[Positive, Field(description="assumed tilt error over acceleration over gravity")] = 3.0
    unmodelled_acceleration_m_s2: Annotated[Positive, Field(description="assumed unmodelled acceleration, m/s2")] = 0.3
    gate: Annotated[Positive, Field(description="maximum normalised innovation of an accepted reading")] = 5.0
    max_rejected_fixes: Annotated[int, Field(ge=1, description="rejected solutions in a row before a restart")] = 10
    max_repeated_fixes: Annotated[int, Field(ge=2, description="equal readings in a row of a stuck instrument")] = 8


@dataclass(frozen=True)
class FilterState:
    """State, covariance and memory of the filter between two runs (see `kernels`)."""

    state: Float64[np.ndarray, "16"]
    covariance: Float64[np.ndarray, "24 24"]
    memory: Float64[np.ndarray, "5"]


@dataclass(frozen=True)
class Innovations:
    """Measured less expected readings.

    - kinds: `kernels.POSITION_FIX`, `VELOCITY_FIX`, `COMPASS` or `INCLINOMETER`
    - axes: component of the reading
    - normalised: innovation over its expected standard deviation
    - used: whether it passed the gate
    """

    times_s: Float64[np.ndarray, "n"]
    kinds: Int64[np.ndarray, "n"]
    axes: Int64[np.ndarray, "n"]
    normalised: Float64[np.ndarray, "n"]
    used: Bool[np.ndarray, "n"]


@dataclass(frozen=True)
class NavigationSolution:
    """Estimates at each boundary of the inertial unit's samples; times are its tags.

    - positions_m, velocities_m_s: world axes
    - attitudes: rotations from body to world axes
    - gyro_biases_rad_s, accelerometer_biases_m_s2: estimates, body axes
    - deviations: standard deviations of the fifteen estimated errors, SI units, in the order of the states
    - kept_at, covariances: boundaries with stored covariances, and these
    - end: filter state at the last boundary
    """

    increments: ImuIncrements
    positions_m: Float64[np.ndarray, "m 3"]
    velocities_m_s: Float64[np.ndarray, "m 3"]
    attitudes: Rotation
    gyro_biases_rad_s: Float64[np.ndarray, "m 3"]
    accelerometer_biases_m_s2: Float64[np.ndarray, "m 3"]
    deviations: Float64[np.ndarray, "m 15"]
    kept_at: Int64[np.ndarray, "k"]
    covariances: Float64[np.ndarray, "k 15 15"]
    innovations: Innovations
    end: FilterState

    def pose(self, time_s: float) -> RigidTransform:
        """Extrapolate the pose to a time tag from the boundary before it. Raises ValueError outside the boundaries."""
        tags = self.increments.times_s
        if not tags[0] <= time_s <= tags[-1]:
            raise ValueError(f"navigation is known from {tags[0]:.4f} s to {tags[-1]:.4f} s, not at {time_s:.4f} s")
        k = min(int(np.searchsorted(tags, time_s, side="right")), tags.size - 1) - 1
        fraction = (time_s - tags[k]) / max(tags[k + 1] - tags[k], np.finfo(float).tiny)
        step = self.increments.period_s
        turn = self.increments.delta_angles_rad[k] - step * self.gyro_biases_rad_s[k]
        attitude = self.attitudes[k] * Rotation.from_rotvec(fraction * turn)
        return rigid(attitude, self.positions_m[k] + fraction * step * self.velocities_m_s[k])


@dataclass(frozen=True)
class NavigationFilter:
    """The filter for instruments with these parameters and this gravity."""

    parameters: FilterParameters
    imu: ImuParameters
    rtk: RtkParameters
    compass: TiltCompassParameters
    gravity_m_s2: float

    def initialize(self, solutions: RtkSolutions, readings: TiltCompassReadings) -> FilterState:
        """Create the initial state at the first readings. Raises ValueError without solution or compass reading."""
        valid = np.flatnonzero(np.isfinite(solutions.positions_m[:, 0]))
        if valid.size == 0 or readings.times_s.size == 0:
            raise ValueError("the filter needs a solution of the receiver and a reading of the compass to start at")
        p, i, c = self.parameters, self.imu, self.compass
        state = np.zeros(kernels.STATE)
        up = readings.up_body[0]
        pitch, roll = -np.arcsin(np.clip(up[0], -1.0, 1.0)), np.arctan2(up[1], up[2])
        attitude = Rotation.from_euler("ZYX", np.array([0.5 * np.pi - readings.headings_rad[0], pitch, roll]))
        state[: kernels.STATE_GYRO_BIAS] = np.concatenate(
            [solutions.positions_m[valid[0]], solutions.velocities_m_s[valid[0]], attitude.as_quat()]
        )
        gyro_bias = float(np.hypot(i.gyro_bias_deg_h, i.gyro_wander_deg_h) * DEG_H)
        # with scale and misalignment errors under gravity: 1 ppm is 1e-3 mg, 1 mrad is 1 mg
        scale_mg, misalignment_mg = 1e-3 * i.accelerometer_scale_ppm, i.accelerometer_misalignment_mrad
        biases_mg = [i.accelerometer_bias_mg, i.accelerometer_wander_mg, scale_mg, misalignment_mg]
        accelerometer_bias = float(np.linalg.norm(np.array(biases_mg))) * 1e-3 * STANDARD_GRAVITY_M_S2
        tilted = float(c.tilt_bias_deg * np.tan(np.radians(c.dip_deg)))
        heading_biases_deg = [c.heading_bias_deg, c.hard_iron_deg, c.soft_iron_deg, tilted]
        # in the order of the error vector
        deviations = np.concatenate(
            [
                np.repeat([p.initial_position_sd_m, p.initial_velocity_sd_m_s], 3),
                np.radians([p.initial_tilt_sd_deg, p.initial_tilt_sd_deg, p.initial_heading_sd_deg]),
                np.repeat([gyro_bias, accelerometer_bias, 1.0], 3),
                self.rtk.velocity_wander_m_s,
                [float(np.radians(np.linalg.norm(np.array(heading_biases_deg))))],
                np.full(2, np.radians(c.tilt_bias_deg)),
            ]
        )
        return FilterState(state, np.diag(deviations**2), np.array([-1.0, 0.0, 0.0, 0.0, 0.0]))

    def run(
        self,
        start: FilterState,
        increments: ImuIncrements,
        solutions: RtkSolutions,
        readings: TiltCompassReadings,
        keep_s: Float64[np.ndarray, "k"] | None = None,
    ) -> NavigationSolution:
        """Filter the readings over the increments; store covariances at the last boundary before each time `keep_s`."""
        tags = increments.times_s
        stored = np.zeros(0) if keep_s is None else keep_s
        kept_at = np.sort(np.clip(np.searchsorted(tags, stored, side="right") - 1, 0, tags.size - 1)).astype(np.int64)
        covariance, memory = start.covariance.copy(), start.memory.copy()
        inputs = kernels.Inputs(
            times=tags,
            step=increments.period_s,
            angles=increments.delta_angles_rad,
            velocities=increments.delta_velocities_m_s,
            gps=self._gps_rows(solutions),
            tilts=self._tilt_rows(readings),
            kept_at=kept_at,
        )
        tuning = self._tuning(increments.period_s)
        states, covariances, deviations, log = kernels.run(inputs, start.state, covariance, memory, tuning)
        blocks = [kernels.VELOCITY, kernels.QUATERNION, kernels.STATE_GYRO_BIAS, kernels.STATE_ACCELEROMETER_BIAS]
        positions, velocities, quaternions, gyro_biases, accelerometer_biases = np.split(states, blocks, axis=1)
        kinds, axes = log[:, 1:3].astype(np.int64).T
        return NavigationSolution(
            increments=increments,
            positions_m=positions,
            velocities_m_s=velocities,
            attitudes=Rotation.from_quat(quaternions),
            gyro_biases_rad_s=gyro_biases,
            accelerometer_biases_m_s2=accelerometer_biases,
            deviations=deviations,
            kept_at=kept_at,
            covariances=covariances,
            innovations=Innovations(log[:, 0], kinds, axes, log[:, 3], log[:, 4] == 1.0),
            end=FilterState(states[-1].copy(), covariance, memory),
        )

    def _gps_rows(self, s: RtkSolutions) -> Float64[np.ndarray, "n 15"]:
        """Solutions in the kernels' columns; reported deviations are split as in the receiver's parameters."""
        fixed, floating = self.rtk.fixed, self.rtk.floating
        wanders, noises = (
            np.where(s.fixed[:, None], _fraction(fixed, part), _fraction(floating, part)) * s.reported_m
            for part in ("wander_m", "noise_m")
        )
        arrivals = s.times_s + self.rtk.latency_s
        rows = np.column_stack([s.times_s, arrivals, s.positions_m, s.velocities_m_s, wanders, noises, s.fixed])
        rows[_is_stuck(s.positions_m, self.parameters.max_repeated_fixes), kernels.GPS_POSITION] = np.nan
        return rows

    def _tilt_rows(self, r: TiltCompassReadings) -> Float64[np.ndarray, "n 5"]:
        """Readings in the kernels' columns."""
        rows = np.column_stack([r.times_s, r.up_body, 0.5 * np.pi - r.headings_rad])
        for column, values in ((kernels.UP, r.up_body), (kernels.YAW, r.headings_rad[:, None])):
            rows[_is_stuck(values, self.parameters.max_repeated_fixes), column] = np.nan
        return rows

    def _tuning(self, step_s: float) -> kernels.Tuning:
        i, r, c, p = self.imu, self.rtk, self.compass, self.parameters
        force_wander = i.accelerometer_wander_mg * MILLI_G
        return kernels.Tuning(
            gravity_m_s2=self.gravity_m_s2,
            attitude_density=i.angular_random_walk_deg_sqrt_h * DEG_SQRT_H,
            velocity_density=1e-3 * i.velocity_random_walk_ug_sqrt_hz * MILLI_G,
            # a Gauss-Markov bias is a random walk of this density over times much shorter than its correlation time
            gyro_bias_density=i.gyro_wander_deg_h * DEG_H * float(np.sqrt(2.0 / i.gyro_wander_s)),
            accelerometer_bias_density=force_wander * float(np.sqrt(2.0 / i.accelerometer_wander_s)),
            wander_kept_fixed=float(np.exp(-step_s / r.fixed.correlation_s)),
            wander_kept_floating=float(np.exp(-step_s / r.floating.correlation_s)),
            velocity_wander_m_s=r.velocity_wander_m_s,
            velocity_wander_kept=float(np.exp(-step_s / r.velocity_correlation_s)),
            velocity_noise_m_s=r.velocity_noise_m_s,
            tilt_noise_rad=float(np.radians(c.tilt_noise_deg)),
            heading_noise_rad=float(np.radians(np.hypot(c.heading_noise_deg, c.count_deg / np.sqrt(12.0)))),
            tan_dip=float(np.tan(np.radians(c.dip_deg))),
            lag_s=c.lag_s,
            disturbance=p.disturbance,
            unmodelled_acceleration_m_s2=p.unmodelled_acceleration_m_s2,
            gate=p.gate,
            max_rejected_fixes=p.max_rejected_fixes,
            first_position_m=p.initial_position_sd_m,
            first_velocity_m_s=p.initial_velocity_sd_m_s,
            first_tilt_rad=float(np.radians(p.initial_tilt_sd_deg)),
        )


def _fraction(errors: SolutionErrors, part: str) -> Float64[np.ndarray, "3"]:
    """Fraction of a solution's standard deviation that is wander or noise; 0 for solutions without errors."""
    return np.asarray(np.array(getattr(errors, part)) / np.maximum(errors.total_m, np.finfo(float).tiny))


def _is_stuck(values: Float64[np.ndarray, "n columns"], max_repeats: int) -> Bool[np.ndarray, "n"]:
    """Whether each reading ends a run of more than `max_repeats` equal ones."""
    same = np.concatenate([[False], np.all(values[1:] == values[:-1], axis=1)])[: len(values)]
    numbers = np.arange(len(values))
    begins = np.maximum.accumulate(np.where(same, 0, numbers))
    return np.asarray(numbers - begins >= max_repeats)
