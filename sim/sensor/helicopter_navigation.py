"""On-board navigation filter of the helicopter: an error-state Kalman filter for inertial unit, RTK, compass and tilt.

The filter is modelled as an instrument: an algorithm under test receives only its pose estimates.

Fifteen errors are estimated (landing paper, section IV, and its reference [12]): position, velocity, attitude
(multiplicative), gyro bias and accelerometer bias. Time-correlated errors of the readings (that of the receiver, called
wander, and constant errors of compass and inclinometers) are *considered* (Schmidt 1966): they are part of the
covariance, but not estimated. Without them the covariance would be too small, because averaging does not
remove these errors.

The filter uses the standard deviations in the instruments' parameters, not the sampled errors. The receiver reports the
standard deviation of its position. Each RTK solution (position fix) is propagated from its time to its delivery time by
inertial navigation. The assumed noise of inclinometers and compass grows with acceleration. Readings outside the gate
and readings of stuck instruments are rejected. After `max_rejected_fixes` rejected solutions the filter restarts at the
next solution.

The landing paper is Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float64
from pydantic import Field
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.frames import rigid
from marsyard.sim.measurements import ImuIncrements
from marsyard.sim.parameters import Parameters, Positive
from marsyard.sim.sensor.imu import DEG_H, DEG_SQRT_H, MILLI_G, STANDARD_GRAVITY_M_S2, ImuParameters
from marsyard.sim.sensor.kernels import navigation as kernels
from marsyard.sim.sensor.rtk import RtkParameters, RtkSolutions, SolutionErrors
from marsyard.sim.sensor.tilt_compass import TiltCompassParameters, TiltCompassReadings


class FilterParameters(Parameters):
    """Assumptions of the filter in addition to the parameters of its instruments; sd: standard deviation."""

    initial_position_sd_m: Annotated[Positive, Field(description="initial sd of the position, m")] = 30.0
    initial_velocity_sd_m_s: Annotated[Positive, Field(description="initial sd of the velocity, m/s")] = 3.0
    initial_tilt_sd_deg: Annotated[Positive, Field(description="initial sd of pitch and roll, deg")] = 5.0
    initial_heading_sd_deg: Annotated[Positive, Field(description="initial sd of the heading, deg")] = 20.0
    disturbance: Annotated[Positive, Field(description="tilt error, rad, divided by acceleration / gravity")] = 3.0
    unmodelled_acceleration_m_s2: Annotated[Positive, Field(description="assumed unmodelled acceleration, m/s2")] = 0.3
    gate: Annotated[Positive, Field(description="maximum normalised innovation of an accepted reading")] = 5.0
    max_rejected_fixes: Annotated[
        int, Field(ge=1, description="consecutive rejected RTK solutions before a restart")
    ] = 10
    max_repeated_fixes: Annotated[int, Field(ge=2, description="maximum equal consecutive readings; more: stuck")] = 8


@dataclass(frozen=True)
class FilterState:
    """State, covariance and memory of the filter between two runs; `kernels` defines their components."""

    state: Float64[np.ndarray, "16"]
    covariance: Float64[np.ndarray, "24 24"]
    memory: Float64[np.ndarray, "5"]


@dataclass(frozen=True)
class NavigationSolution:
    """Estimates at each sample boundary of the inertial unit; times are the unit's time tags.

    - positions_m, velocities_m_s: world axes
    - attitudes: rotations from body to world axes
    - gyro_biases_rad_s, accelerometer_biases_m_s2: estimates, body axes
    - end: filter state at the last boundary
    """

    increments: ImuIncrements
    positions_m: Float64[np.ndarray, "m 3"]
    velocities_m_s: Float64[np.ndarray, "m 3"]
    attitudes: Rotation
    gyro_biases_rad_s: Float64[np.ndarray, "m 3"]
    accelerometer_biases_m_s2: Float64[np.ndarray, "m 3"]
    end: FilterState

    def pose(self, time_s: float) -> RigidTransform:
        """Extrapolate the pose from the previous boundary to a time tag. Raises ValueError outside the boundaries."""
        tags = self.increments.times_s
        if not tags[0] <= time_s <= tags[-1]:
            raise ValueError(f"time {time_s:.4f} s is outside the solution times, {tags[0]:.4f} s to {tags[-1]:.4f} s")
        k = min(int(np.searchsorted(tags, time_s, side="right")), tags.size - 1) - 1
        fraction = (time_s - tags[k]) / max(tags[k + 1] - tags[k], np.finfo(float).tiny)
        step = self.increments.period_s
        rotation_vector = self.increments.delta_angles_rad[k] - step * self.gyro_biases_rad_s[k]
        attitude = self.attitudes[k] * Rotation.from_rotvec(fraction * rotation_vector)
        return rigid(attitude, self.positions_m[k] + fraction * step * self.velocities_m_s[k])


@dataclass(frozen=True)
class NavigationFilter:
    """Navigation filter for an inertial unit, a receiver and a compass with these parameters, and for a gravity."""

    parameters: FilterParameters
    imu: ImuParameters
    rtk: RtkParameters
    compass: TiltCompassParameters
    gravity_m_s2: float

    def initialize(self, solutions: RtkSolutions, readings: TiltCompassReadings) -> FilterState:
        """Create the initial state from the first readings. Raises ValueError without solution or compass reading."""
        valid = np.flatnonzero(np.isfinite(solutions.positions_m[:, 0]))
        if valid.size == 0 or readings.times_s.size == 0:
            raise ValueError("the filter needs a receiver solution and a compass reading to start")
        parameters, imu, compass = self.parameters, self.imu, self.compass
        state = np.zeros(kernels.STATE)
        up = readings.up_body[0]
        pitch, roll = -np.arcsin(np.clip(up[0], -1.0, 1.0)), np.arctan2(up[1], up[2])
        attitude = Rotation.from_euler("ZYX", np.array([0.5 * np.pi - readings.headings_rad[0], pitch, roll]))
        state[: kernels.STATE_GYRO_BIAS] = np.concatenate(
            [solutions.positions_m[valid[0]], solutions.velocities_m_s[valid[0]], attitude.as_quat()]
        )
        gyro_bias = float(np.hypot(imu.gyro_bias_deg_h, imu.gyro_wander_deg_h) * DEG_H)
        # scale and misalignment errors act like a bias under gravity: 1 ppm is 1e-3 mg, 1 mrad is 1 mg
        scale_mg, misalignment_mg = 1e-3 * imu.accelerometer_scale_ppm, imu.accelerometer_misalignment_mrad
        biases_mg = [imu.accelerometer_bias_mg, imu.accelerometer_wander_mg, scale_mg, misalignment_mg]
        accelerometer_bias = float(np.linalg.norm(np.array(biases_mg))) * 1e-3 * STANDARD_GRAVITY_M_S2
        dip_error_deg = float(compass.tilt_bias_deg * np.tan(np.radians(compass.dip_deg)))
        heading_biases_deg = [compass.heading_bias_deg, compass.hard_iron_deg, compass.soft_iron_deg, dip_error_deg]
        tilt_deg, heading_deg = parameters.initial_tilt_sd_deg, parameters.initial_heading_sd_deg
        deviations = np.empty(kernels.ERRORS)
        for first_error, values in (
            (kernels.POSITION, np.full(3, parameters.initial_position_sd_m)),
            (kernels.VELOCITY, np.full(3, parameters.initial_velocity_sd_m_s)),
            (kernels.ATTITUDE_ERROR, np.radians([tilt_deg, tilt_deg, heading_deg])),
            (kernels.GYRO_BIAS, np.full(3, gyro_bias)),
            (kernels.ACCELEROMETER_BIAS, np.full(3, accelerometer_bias)),
            (kernels.POSITION_WANDER, np.ones(3)),
            (kernels.VELOCITY_WANDER, np.array(self.rtk.velocity_wander_m_s)),
            (kernels.HEADING_BIAS, np.radians([np.linalg.norm(np.array(heading_biases_deg))])),
            (kernels.TILT_BIAS, np.full(2, np.radians(compass.tilt_bias_deg))),
        ):
            deviations[first_error : first_error + len(values)] = values
        # no rejected solutions, and acceleration zero
        memory = np.zeros(kernels.MEMORY)
        memory[kernels.LAST_FIX] = kernels.NO_FIX
        return FilterState(state, np.diag(deviations**2), memory)

    def run(
        self, start: FilterState, increments: ImuIncrements, solutions: RtkSolutions, readings: TiltCompassReadings
    ) -> NavigationSolution:
        """Run the filter over the increments; solutions and readings outside of them are not used."""
        covariance, memory = start.covariance.copy(), start.memory.copy()
        inputs = kernels.Inputs(
            times=increments.times_s,
            step=increments.period_s,
            angles=increments.delta_angles_rad,
            velocities=increments.delta_velocities_m_s,
            gps=self._convert_solutions(solutions),
            compass=self._convert_readings(readings),
        )
        tuning = self._create_tuning(increments.period_s)
        states = kernels.run(inputs, start.state, covariance, memory, tuning)
        blocks = [kernels.VELOCITY, kernels.QUATERNION, kernels.STATE_GYRO_BIAS, kernels.STATE_ACCELEROMETER_BIAS]
        positions, velocities, quaternions, gyro_biases, accelerometer_biases = np.split(states, blocks, axis=1)
        return NavigationSolution(
            increments=increments,
            positions_m=positions,
            velocities_m_s=velocities,
            attitudes=Rotation.from_quat(quaternions),
            gyro_biases_rad_s=gyro_biases,
            accelerometer_biases_m_s2=accelerometer_biases,
            end=FilterState(states[-1].copy(), covariance, memory),
        )

    def _convert_solutions(self, solutions: RtkSolutions) -> Float64[np.ndarray, "n 15"]:
        """Convert solutions to rows for the kernels.

        The reported standard deviation is divided into wander and noise in the ratio of the receiver's parameters.
        """
        fixed, floating = self.rtk.fixed, self.rtk.floating
        wanders, noises = (
            np.where(solutions.fixed[:, None], _error_fraction(fixed, part), _error_fraction(floating, part))
            * solutions.reported_m
            for part in ("wander_m", "noise_m")
        )
        times, positions, velocities = solutions.times_s, solutions.positions_m, solutions.velocities_m_s
        rows = np.column_stack(
            [times, times + self.rtk.latency_s, positions, velocities, wanders, noises, solutions.fixed]
        )
        rows[_is_stuck(positions, self.parameters.max_repeated_fixes), kernels.GPS_POSITION] = np.nan
        return rows

    def _convert_readings(self, readings: TiltCompassReadings) -> Float64[np.ndarray, "n 5"]:
        """Convert readings to rows for the kernels; headings become yaw, counterclockwise from east."""
        rows = np.column_stack([readings.times_s, readings.up_body, 0.5 * np.pi - readings.headings_rad])
        for column, values in ((kernels.UP, readings.up_body), (kernels.YAW, readings.headings_rad[:, None])):
            rows[_is_stuck(values, self.parameters.max_repeated_fixes), column] = np.nan
        return rows

    def _create_tuning(self, step_s: float) -> kernels.Tuning:
        """Convert the parameters of filter and instruments to SI units and to factors per step."""
        imu, rtk, compass, parameters = self.imu, self.rtk, self.compass, self.parameters
        force_wander = imu.accelerometer_wander_mg * MILLI_G
        return kernels.Tuning(
            gravity_m_s2=self.gravity_m_s2,
            attitude_density=imu.angular_random_walk_deg_sqrt_h * DEG_SQRT_H,
            velocity_density=1e-3 * imu.velocity_random_walk_ug_sqrt_hz * MILLI_G,
            # over times much shorter than its correlation time a Gauss-Markov bias is a random walk of this density
            gyro_bias_density=imu.gyro_wander_deg_h * DEG_H * float(np.sqrt(2.0 / imu.gyro_wander_s)),
            accelerometer_bias_density=force_wander * float(np.sqrt(2.0 / imu.accelerometer_wander_s)),
            fixed_wander_decay=float(np.exp(-step_s / rtk.fixed.correlation_s)),
            floating_wander_decay=float(np.exp(-step_s / rtk.floating.correlation_s)),
            velocity_wander_m_s=rtk.velocity_wander_m_s,
            velocity_decay=float(np.exp(-step_s / rtk.velocity_correlation_s)),
            velocity_noise_m_s=rtk.velocity_noise_m_s,
            tilt_noise_rad=float(np.radians(compass.tilt_noise_deg)),
            # rounding to whole counts has the standard deviation count / sqrt(12)
            heading_noise_rad=float(np.radians(np.hypot(compass.heading_noise_deg, compass.count_deg / np.sqrt(12.0)))),
            tan_dip=float(np.tan(np.radians(compass.dip_deg))),
            lag_s=compass.lag_s,
            disturbance=parameters.disturbance,
            unmodelled_acceleration_m_s2=parameters.unmodelled_acceleration_m_s2,
            gate=parameters.gate,
            max_rejected_fixes=parameters.max_rejected_fixes,
            first_position_m=parameters.initial_position_sd_m,
            first_velocity_m_s=parameters.initial_velocity_sd_m_s,
            first_tilt_rad=float(np.radians(parameters.initial_tilt_sd_deg)),
        )


def _error_fraction(errors: SolutionErrors, part: str) -> Float64[np.ndarray, "3"]:
    """Compute the fraction of a solution's error that is `part`, "wander_m" or "noise_m"; 0 without errors."""
    return np.asarray(np.array(getattr(errors, part)) / np.maximum(errors.total_m, np.finfo(float).tiny))


def _is_stuck(values: Float64[np.ndarray, "n columns"], max_repeats: int) -> Bool[np.ndarray, "n"]:
    """Return whether each reading is the last of more than `max_repeats` equal consecutive readings."""
    equals_previous = np.concatenate([[False], np.all(values[1:] == values[:-1], axis=1)])[: len(values)]
    numbers = np.arange(len(values))
    run_starts = np.maximum.accumulate(np.where(equals_previous, 0, numbers))
    return np.asarray(numbers - run_starts >= max_repeats)
