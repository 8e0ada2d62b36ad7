"""The helicopter's on-board filter: an error-state Kalman filter over inertial unit, receiver, compass, inclinometers.

It belongs to the instruments, as `marsyard.sim.sensor.inertial` does: what it delivers, poses with errors correlated in
time, is all that an algorithm under test is given of it.

Fifteen errors are estimated (landing paper, section IV, and its reference [12]): position, velocity, attitude, gyro and
accelerometer biases; the attitude's is multiplicative. What is correlated in time in the readings themselves, the
receiver's wander and the constant errors of compass and inclinometers, is *considered* (Schmidt 1966): it is part of
the covariance, but never estimated. Without that the covariance would claim that averaging removes what it does not.

The filter knows the instruments' classes, not the units: it takes the standard deviations of their parameters. A
receiver's position counts with the deviation that the receiver itself reports. A solution is carried from its time to
that of its delivery by what inertial navigation has moved since. Inclinometers and compass count the less the more the
helicopter accelerates. A reading further off than the gate is left out, and so are instruments that repeat themselves;
where the receiver was left out for a while, the filter starts anew at its next solution.
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
from marsyard.sim.sensor.imu import DEG_H, DEG_SQRT_H, STANDARD_GRAVITY_M_S2, ImuIncrements, ImuParameters
from marsyard.sim.sensor.navigation import kernels
from marsyard.sim.sensor.rtk import RtkParameters, RtkSolutions, SolutionErrors
from marsyard.sim.sensor.tilt_compass import TiltCompassParameters, TiltCompassReadings


class FilterParameters(Parameters):
    """What the filter takes for granted beyond the classes of its instruments."""

    first_place_m: Annotated[Positive, Field(description="deviation of position before the first solution, m")] = 30.0
    first_speed_m_s: Annotated[Positive, Field(description="deviation of velocity before that, m/s")] = 3.0
    first_tilt_deg: Annotated[Positive, Field(description="deviation of pitch and roll before any reading, deg")] = 5.0
    first_heading_deg: Annotated[Positive, Field(description="deviation of heading before any reading, deg")] = 20.0
    disturbance: Annotated[
        Positive, Field(description="tilt that inclinometers are taken to be off by, over acceleration over gravity")
    ] = 3.0
    unseen_m_s2: Annotated[
        Positive, Field(description="acceleration that inclinometers are taken to feel beyond what is known, m/s2")
    ] = 0.3
    gate: Annotated[Positive, Field(description="most deviations that a reading may be off and still count")] = 5.0
    most_refused: Annotated[
        int, Field(ge=1, description="solutions refused in a row after which the filter starts anew at the next")
    ] = 10
    most_repeats: Annotated[
        int, Field(ge=2, description="equal readings in a row after which an instrument counts as stuck")
    ] = 8


@dataclass(frozen=True)
class FilterState:
    """The filter between two runs: state, covariance and memory (see `kernels`)."""

    state: Float64[np.ndarray, "16"]
    covariance: Float64[np.ndarray, "24 24"]
    memory: Float64[np.ndarray, "5"]


@dataclass(frozen=True)
class Innovations:
    """Measured less expected readings.

    Attributes
    ----------
    times_s
        Times of the updates.
    kinds
        What of: `kernels.POSITION_FIX`, `VELOCITY_FIX`, `COMPASS` or `INCLINOMETER`.
    axes
        Which component.
    normalised
        Over their expected standard deviation.
    used
        Whether they passed the gate.
    """

    times_s: Float64[np.ndarray, "n"]
    kinds: Int64[np.ndarray, "n"]
    axes: Int64[np.ndarray, "n"]
    normalised: Float64[np.ndarray, "n"]
    used: Bool[np.ndarray, "n"]


@dataclass(frozen=True)
class NavigationSolution:
    """What the filter had at each boundary of the inertial unit's samples; times are its tags.

    Attributes
    ----------
    increments
        What it was propagated by.
    positions_m, velocities_m_s
        World axes.
    attitudes
        From body to world axes.
    gyro_biases_rad_s, accelerometer_biases_m_s2
        As estimated, body axes.
    deviations
        Of its fifteen errors, as the filter has them; SI units, in the order of its states.
    kept_at, covariances
        Boundaries at which whole covariances of the errors were kept, and those.
    innovations
        Of all readings.
    end
        What it goes on from.
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
        """World from body at a time tag, from the last boundary on as the unit's increments go on.

        Raises
        ------
        ValueError
            If the time is tagged before the first boundary or after the last.
        """
        tags = self.increments.times_s
        if not tags[0] <= time_s <= tags[-1]:
            raise ValueError(f"navigation is known from {tags[0]:.4f} s to {tags[-1]:.4f} s, not at {time_s:.4f} s")
        k = min(int(np.searchsorted(tags, time_s, side="right")), tags.size - 1) - 1
        share = (time_s - tags[k]) / max(tags[k + 1] - tags[k], np.finfo(float).tiny)
        step = self.increments.period_s
        turn = self.increments.delta_angles_rad[k] - step * self.gyro_biases_rad_s[k]
        attitude = self.attitudes[k] * Rotation.from_rotvec(share * turn)
        return rigid(attitude, self.positions_m[k] + share * step * self.velocities_m_s[k])


@dataclass(frozen=True)
class NavigationFilter:
    """The filter for instruments of these classes over a planet of this gravity."""

    parameters: FilterParameters
    imu: ImuParameters
    rtk: RtkParameters
    compass: TiltCompassParameters
    gravity_m_s2: float

    def started(self, solutions: RtkSolutions, readings: TiltCompassReadings) -> FilterState:
        """The state before any reading counts: at the first readings, with deviations far larger than theirs.

        Raises
        ------
        ValueError
            If there is no solution or no reading to start at.
        """
        known = np.flatnonzero(np.isfinite(solutions.positions_m[:, 0]))
        if known.size == 0 or readings.times_s.size == 0:
            raise ValueError("the filter needs a solution of the receiver and a reading of the compass to start at")
        p = self.parameters
        state = np.zeros(kernels.STATE)
        attitude = _attitude(readings.up_body[0], readings.headings_rad[0])
        state[: kernels.STATE_GYRO_BIAS] = np.concatenate(
            [solutions.positions_m[known[0]], solutions.velocities_m_s[known[0]], attitude.as_quat()]
        )
        # in the order of the error vector
        deviations = np.concatenate(
            [
                np.full(3, p.first_place_m),
                np.full(3, p.first_speed_m_s),
                np.radians([p.first_tilt_deg, p.first_tilt_deg, p.first_heading_deg]),
                np.full(3, self._gyro_bias_rad_s()),
                np.full(3, self._accelerometer_bias_m_s2()),
                np.ones(3),
                self.rtk.velocity_wander_m_s,
                [self._heading_bias_rad()],
                np.full(2, np.radians(self.compass.tilt_bias_deg)),
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
        """The solution over the increments; whole covariances are kept at the boundaries last before some times."""
        tags = increments.times_s
        asked = np.zeros(0) if keep_s is None else keep_s
        kept_at = np.sort(np.clip(np.searchsorted(tags, asked, side="right") - 1, 0, tags.size - 1)).astype(np.int64)
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
        quaternions = states[:, kernels.QUATERNION : kernels.QUATERNION + 4]
        return NavigationSolution(
            increments=increments,
            positions_m=states[:, kernels.POSITION : kernels.POSITION + 3],
            velocities_m_s=states[:, kernels.VELOCITY : kernels.VELOCITY + 3],
            attitudes=Rotation.from_quat(quaternions),
            gyro_biases_rad_s=states[:, kernels.STATE_GYRO_BIAS : kernels.STATE_ACCELEROMETER_BIAS],
            accelerometer_biases_m_s2=states[:, kernels.STATE_ACCELEROMETER_BIAS : kernels.STATE],
            deviations=deviations,
            kept_at=kept_at,
            covariances=covariances,
            innovations=Innovations(
                log[:, 0], log[:, 1].astype(np.int64), log[:, 2].astype(np.int64), log[:, 3], log[:, 4] == 1.0
            ),
            end=FilterState(states[-1].copy(), covariance, memory),
        )

    def _gps_rows(self, s: RtkSolutions) -> Float64[np.ndarray, "n 15"]:
        """Solutions as the kernels take them; reported deviations are divided as in the receiver's class."""
        rows = np.empty((s.times_s.size, kernels.GPS_COLUMNS))
        rows[:, kernels.TAG] = s.times_s
        rows[:, kernels.ARRIVAL] = s.times_s + self.rtk.latency_s
        rows[:, kernels.GPS_POSITION : kernels.GPS_POSITION + 3] = s.positions_m
        rows[:, kernels.GPS_VELOCITY : kernels.GPS_VELOCITY + 3] = s.velocities_m_s
        wanders, noises = (
            np.where(s.fixed[:, None], _share(self.rtk.fixed, part), _share(self.rtk.floating, part)) * s.reported_m
            for part in ("wander_m", "noise_m")
        )
        rows[:, kernels.GPS_WANDER : kernels.GPS_WANDER + 3] = wanders
        rows[:, kernels.GPS_NOISE : kernels.GPS_NOISE + 3] = noises
        rows[:, kernels.FIXED] = s.fixed
        rows[_stuck(s.positions_m, self.parameters.most_repeats), kernels.GPS_POSITION] = np.nan
        return rows

    def _tilt_rows(self, r: TiltCompassReadings) -> Float64[np.ndarray, "n 5"]:
        rows = np.empty((r.times_s.size, kernels.TILT_COLUMNS))
        rows[:, kernels.TAG] = r.times_s
        rows[:, kernels.UP : kernels.UP + 3] = r.up_body
        rows[:, kernels.YAW] = 0.5 * np.pi - r.headings_rad
        most = self.parameters.most_repeats
        rows[_stuck(r.up_body, most), kernels.UP] = np.nan
        rows[_stuck(r.headings_rad[:, None], most), kernels.YAW] = np.nan
        return rows

    def _gyro_bias_rad_s(self) -> float:
        return float(np.hypot(self.imu.gyro_bias_deg_h, self.imu.gyro_wander_deg_h) * DEG_H)

    def _accelerometer_bias_m_s2(self) -> float:
        """With what gravity makes of scale and misalignment: 1 ppm is 1e-3 mg, 1 mrad is 1 mg."""
        p = self.imu
        parts = [
            p.accelerometer_bias_mg,
            p.accelerometer_wander_mg,
            1e-3 * p.accelerometer_scale_ppm,
            p.accelerometer_misalignment_mrad,
        ]
        return float(np.linalg.norm(np.array(parts))) * 1e-3 * STANDARD_GRAVITY_M_S2

    def _heading_bias_rad(self) -> float:
        p = self.compass
        tilted = p.tilt_bias_deg * np.tan(np.radians(p.dip_deg))
        parts = [p.heading_bias_deg, p.hard_iron_deg, p.soft_iron_deg, float(tilted)]
        return float(np.radians(np.linalg.norm(np.array(parts))))

    def _tuning(self, step_s: float) -> kernels.Tuning:
        i, r, c = self.imu, self.rtk, self.compass
        milli_g = 1e-3 * STANDARD_GRAVITY_M_S2
        east, north, up = r.velocity_wander_m_s
        noise_east, noise_north, noise_up = r.velocity_noise_m_s
        return kernels.Tuning(
            gravity_m_s2=self.gravity_m_s2,
            attitude_density=i.angular_random_walk_deg_sqrt_h * DEG_SQRT_H,
            velocity_density=1e-3 * i.velocity_random_walk_ug_sqrt_hz * milli_g,
            # a Gauss-Markov bias seen over much less than its correlation time is a random walk of this density
            gyro_bias_density=i.gyro_wander_deg_h * DEG_H * float(np.sqrt(2.0 / i.gyro_wander_s)),
            accelerometer_bias_density=i.accelerometer_wander_mg
            * milli_g
            * float(np.sqrt(2.0 / i.accelerometer_wander_s)),
            wander_kept_fixed=float(np.exp(-step_s / r.fixed.correlation_s)),
            wander_kept_floating=float(np.exp(-step_s / r.floating.correlation_s)),
            velocity_wander_m_s=(east, north, up),
            velocity_wander_kept=float(np.exp(-step_s / r.velocity_correlation_s)),
            velocity_noise_m_s=(noise_east, noise_north, noise_up),
            tilt_noise_rad=float(np.radians(c.tilt_noise_deg)),
            heading_noise_rad=float(np.radians(np.hypot(c.heading_noise_deg, c.count_deg / np.sqrt(12.0)))),
            tan_dip=float(np.tan(np.radians(c.dip_deg))),
            lag_s=c.lag_s,
            disturbance=self.parameters.disturbance,
            unmodelled_acceleration_m_s2=self.parameters.unseen_m_s2,
            gate=self.parameters.gate,
            max_rejected_fixes=self.parameters.most_refused,
            first_position_m=self.parameters.first_place_m,
            first_velocity_m_s=self.parameters.first_speed_m_s,
            first_tilt_rad=float(np.radians(self.parameters.first_tilt_deg)),
        )


def _share(errors: SolutionErrors, part: str) -> Float64[np.ndarray, "3"]:
    """What part of a solution's standard deviation is wander or noise; none of one that has none."""
    total = np.maximum(errors.total_m, np.finfo(float).tiny)
    return np.asarray(np.array(getattr(errors, part)) / total)


def _attitude(up_body: Float64[np.ndarray, "3"], heading_rad: float) -> Rotation:
    """The attitude with this direction upwards and this azimuth of the body's x axis."""
    pitch = -np.arcsin(np.clip(up_body[0], -1.0, 1.0))
    roll = np.arctan2(up_body[1], up_body[2])
    return Rotation.from_euler("ZYX", np.array([0.5 * np.pi - heading_rad, pitch, roll]))


def _stuck(values: Float64[np.ndarray, "n columns"], most: int) -> Bool[np.ndarray, "n"]:
    """Which readings end a run of more than this many equal ones."""
    same = np.concatenate([[False], np.all(values[1:] == values[:-1], axis=1)])[: len(values)]
    numbers = np.arange(len(values))
    begins = np.maximum.accumulate(np.where(same, 0, numbers))
    return np.asarray(numbers - begins >= most)
