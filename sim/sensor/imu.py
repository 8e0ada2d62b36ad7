"""Inertial measurement unit: angle and velocity increments of a trajectory, with typical sensor errors.

The world frame is treated as inertial: the rotation of the planet, which flight software compensates, is neglected in
motion and measurement. The unit is at the origin of the body frame, with parallel axes.

The increments are ideal integrals, as if the sensors were sampled much faster than the increments are delivered. An
angle increment is the exact rotation vector between two sample boundaries (coning included). A velocity increment is
the integral of specific force in the body axes at the start of the interval (sculling included).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from marsyard.sim.dynamics import Trajectory
from marsyard.sim.error_sources import ACCELERATION, ATTITUDE
from marsyard.sim.frames import multiply_quaternions
from marsyard.sim.measurements import ImuIncrements
from marsyard.sim.parameters import NonNegative, Parameters, Positive
from marsyard.sim.sensor.instrument import Clock, ClockParameters, GaussMarkov, Times, Vector, Vectors

STANDARD_GRAVITY_M_S2 = 9.80665  #: Standard gravity, the unit of accelerometer specifications.
MILLI_G = 1e-3 * STANDARD_GRAVITY_M_S2  #: 1 mg in m/s2.
DEG_H = np.radians(1.0) / 3600.0  #: 1 deg/h in rad/s.
DEG_SQRT_H = np.radians(1.0) / 60.0  #: 1 deg/sqrt(h) in rad/sqrt(s).
Boundaries = Float64[np.ndarray, "m"]


class WarmUp(Parameters):
    """Temperature of the unit minus that of its calibration: zero until `start_s`, then approaches `change_k`.

    Times are those from the start of the unit's use, at which its calibration ends: for a descent from the star
    reference.
    """

    start_s: Annotated[float, Field(description="time from the start of use at which the change begins, s")] = 0.0
    change_k: Annotated[float, Field(ge=-100.0, le=100.0, description="temperature change of the IMU, K")] = 0.0
    time_constant_s: Annotated[Positive, Field(description="time constant of the approach, s")] = 600.0

    def temperature_k(self, times_s: Times) -> Times:
        """Compute the temperature minus the calibration temperature, K, at times from the start of use."""
        return np.asarray(-self.change_k * np.expm1(-np.maximum(times_s - self.start_s, 0.0) / self.time_constant_s))


class ImuParameters(Parameters):
    """Parameters of an inertial measurement unit like Litton's LN-200; errors are standard deviations per axis.

    Bias repeatability (1 deg/h to 3 deg/h, 0.2 mg to 1 mg), bias instability in operation (0.35 deg/h over 100 s,
    0.05 mg over 60 s), random walk, scale factors (100 ppm, 300 ppm) and misalignment: LN-200 data sheet, Northrop
    Grumman. Resolution: NovAtel's table of raw inertial data. Temperature sensitivity and time tags: assumed.
    """

    rate_hz: Annotated[Positive, Field(le=10000.0, description="samples per second")] = 400.0
    gyro_bias_deg_h: Annotated[NonNegative, ATTITUDE, Field(description="constant gyro bias, deg/h")] = 1.0
    gyro_wander_deg_h: Annotated[NonNegative, ATTITUDE, Field(description="time-correlated gyro bias, deg/h")] = 0.35
    gyro_wander_s: Annotated[Positive, Field(description="correlation time of the bias, s")] = 100.0
    gyro_bias_deg_h_k: Annotated[NonNegative, ATTITUDE, Field(description="bias change with temperature, deg/h/K")] = (
        0.1
    )
    angular_random_walk_deg_sqrt_h: Annotated[
        NonNegative, ATTITUDE, Field(description="angular random walk, deg/sqrt(h)")
    ] = 0.07
    gyro_scale_ppm: Annotated[NonNegative, ATTITUDE, Field(description="gyro scale factor error, ppm")] = 100.0
    gyro_misalignment_mrad: Annotated[
        NonNegative, ATTITUDE, Field(description="cross-axis sensitivity of each gyro, mrad")
    ] = 0.1
    gyro_count_rad: Annotated[NonNegative, Field(description="resolution, rad; 0: no rounding")] = 2.0**-19
    accelerometer_bias_mg: Annotated[
        NonNegative, ACCELERATION, Field(description="constant accelerometer bias, mg")
    ] = 0.3
    accelerometer_wander_mg: Annotated[
        NonNegative, ACCELERATION, Field(description="time-correlated accelerometer bias, mg")
    ] = 0.05
    accelerometer_wander_s: Annotated[Positive, Field(description="correlation time of the bias, s")] = 60.0
    accelerometer_bias_mg_k: Annotated[
        NonNegative, ACCELERATION, Field(description="bias change with temperature, mg/K")
    ] = 0.02
    velocity_random_walk_ug_sqrt_hz: Annotated[
        NonNegative, ACCELERATION, Field(description="velocity noise, ug/sqrt(Hz)")
    ] = 50.0
    accelerometer_scale_ppm: Annotated[
        NonNegative, ACCELERATION, Field(description="accelerometer scale factor error, ppm")
    ] = 300.0
    accelerometer_misalignment_mrad: Annotated[
        NonNegative, ACCELERATION, Field(description="cross-axis sensitivity, mrad")
    ] = 0.1
    accelerometer_count_m_s: Annotated[NonNegative, Field(description="resolution, m/s; 0: no rounding")] = 2.0**-14
    warm_up: WarmUp = WarmUp()
    clock: ClockParameters = ClockParameters(offset_sd_s=0.0002, jitter_sd_s=0.00002)


#: A small quartz or silicon unit for a 2 m helicopter. All values are assumed: the landing paper uses Inertial
#: Science's ISIS and contains no error values. The gyro bias is the residual after zeroing on the ground.
SMALL_UNIT = ImuParameters(
    rate_hz=100.0, gyro_bias_deg_h=60.0, gyro_wander_deg_h=20.0, gyro_bias_deg_h_k=0.0,
    angular_random_walk_deg_sqrt_h=2.0, gyro_scale_ppm=1000.0, gyro_misalignment_mrad=1.0, gyro_count_rad=2.0**-19,
    accelerometer_bias_mg=3.0, accelerometer_wander_mg=0.3, accelerometer_bias_mg_k=0.0,
    velocity_random_walk_ug_sqrt_hz=200.0, accelerometer_scale_ppm=1000.0, accelerometer_misalignment_mrad=1.0,
    clock=ClockParameters(),
)  # fmt: skip

#: Northrop Grumman's LN-200, the unit of Mars 2020; sources of the values: `ImuParameters`.
LN200 = ImuParameters()

#: Safran Sensonor's STIM300, a small silicon unit. Data sheet TS1524: random walks (0.15 deg/sqrt(h),
#: 0.07 m/s/sqrt(h)), bias instability (0.5 deg/h, 0.05 mg), scale factors (500 ppm, 300 ppm), misalignment (1 mrad),
#: accelerometer bias over temperature (2 mg). Gyro bias 4 deg/h: repeatability in a paper of ION Navigation. Assumed:
#: rate, correlation times, and negligible rounding.
MEMS = ImuParameters(
    rate_hz=400.0, gyro_bias_deg_h=4.0, gyro_wander_deg_h=0.5, gyro_bias_deg_h_k=0.0,
    angular_random_walk_deg_sqrt_h=0.15, gyro_scale_ppm=500.0, gyro_misalignment_mrad=1.0, gyro_count_rad=0.0,
    accelerometer_bias_mg=2.0, accelerometer_wander_mg=0.05, accelerometer_bias_mg_k=0.0,
    velocity_random_walk_ug_sqrt_hz=119.0, accelerometer_scale_ppm=300.0, accelerometer_misalignment_mrad=1.0,
    accelerometer_count_m_s=0.0,
)  # fmt: skip

#: Classes of inertial units, and their parameters by class.
ImuClass = Literal["ln-200", "mems"]
IMUS: Mapping[ImuClass, ImuParameters] = {"ln-200": LN200, "mems": MEMS}


@dataclass(frozen=True)
class Triad:
    """Errors of three gyros (unit: rad) or accelerometers (unit: m/s).

    - bias, bias_per_k: constant bias, unit/s, and its change with temperature, unit/s/K
    - wander: time-correlated bias, unit/s
    - warm_up, start_s: temperature over time, and start of use
    - scale: relative errors of the scale factors
    - misalignment: cross-axis sensitivity of each sensor (row) to the axes (columns), radians; zero diagonal
    - random_walk: random walk coefficient, unit/sqrt(s)
    - count: resolution, unit; 0: no rounding
    """

    bias: Vector
    bias_per_k: Vector
    wander: GaussMarkov
    warm_up: WarmUp
    start_s: float
    scale: Vector
    misalignment: Float64[np.ndarray, "3 3"]
    random_walk: float
    count: float

    @property
    def sensitivity_error(self) -> Float64[np.ndarray, "3 3"]:
        """Matrix of scale and misalignment errors: measured minus true input is this matrix times the input."""
        return np.asarray(np.diag(self.scale) + self.misalignment)

    def bias_at(self, times_s: Times) -> Vectors:
        """Compute the total bias: constant, thermal and time-correlated; unit/s."""
        thermal = self.warm_up.temperature_k(times_s - self.start_s)[:, None] * self.bias_per_k
        return np.asarray(self.bias + thermal + self.wander.at(times_s))

    def measure(self, increments: Vectors, boundaries_s: Boundaries, rng: np.random.Generator) -> Vectors:
        """Measure n true increments between n + 1 boundaries; rounding residuals are added to the next increment."""
        steps = np.diff(boundaries_s)[:, None]
        noise = self.random_walk * np.sqrt(steps) * rng.standard_normal(increments.shape)
        bias = self.bias_at(0.5 * (boundaries_s[1:] + boundaries_s[:-1])) * steps
        measured: Vectors = increments + increments @ self.sensitivity_error.T + bias + noise
        if self.count == 0.0:
            return measured
        counts = np.rint(np.cumsum(measured, axis=0) / self.count)
        return self.count * np.diff(counts, axis=0, prepend=0.0)


@dataclass(frozen=True)
class Imu:
    """An inertial unit with sampled errors, which are valid in a time span; noise is drawn with the increments."""

    parameters: ImuParameters
    gyro: Triad
    accelerometer: Triad
    clock: Clock

    @classmethod
    def draw(cls, parameters: ImuParameters, span_s: tuple[float, float], rng: np.random.Generator) -> Imu:
        """Draw the errors for use within a time span, whose start is that of the warm-up."""
        p = parameters
        # in each triad the errors are drawn in the order of its fields
        gyro = Triad(
            bias=p.gyro_bias_deg_h * DEG_H * rng.standard_normal(3),
            bias_per_k=p.gyro_bias_deg_h_k * DEG_H * rng.standard_normal(3),
            wander=GaussMarkov.draw(np.full(3, p.gyro_wander_deg_h * DEG_H), p.gyro_wander_s, span_s, rng),
            warm_up=p.warm_up,
            start_s=span_s[0],
            scale=1e-6 * p.gyro_scale_ppm * rng.standard_normal(3),
            misalignment=1e-3 * p.gyro_misalignment_mrad * _draw_off_diagonal(rng),
            random_walk=p.angular_random_walk_deg_sqrt_h * DEG_SQRT_H,
            count=p.gyro_count_rad,
        )
        force_wander = np.full(3, p.accelerometer_wander_mg * MILLI_G)
        accelerometer = Triad(
            bias=p.accelerometer_bias_mg * MILLI_G * rng.standard_normal(3),
            bias_per_k=p.accelerometer_bias_mg_k * MILLI_G * rng.standard_normal(3),
            wander=GaussMarkov.draw(force_wander, p.accelerometer_wander_s, span_s, rng),
            warm_up=p.warm_up,
            start_s=span_s[0],
            scale=1e-6 * p.accelerometer_scale_ppm * rng.standard_normal(3),
            misalignment=1e-3 * p.accelerometer_misalignment_mrad * _draw_off_diagonal(rng),
            random_walk=1e-3 * p.velocity_random_walk_ug_sqrt_hz * MILLI_G,
            count=p.accelerometer_count_m_s,
        )
        return cls(parameters, gyro, accelerometer, Clock.draw(p.clock, rng))

    def boundaries(self, start_s: float, end_s: float) -> Boundaries:
        """Compute the true times of the sample boundaries from start to end."""
        rounding_tolerance = 1e-9
        count = int(np.floor((end_s - start_s) * self.parameters.rate_hz + rounding_tolerance))
        if count < 1:
            raise ValueError(f"no sample lies between {start_s} s and {end_s} s at {self.parameters.rate_hz} Hz")
        return np.asarray(start_s + np.arange(count + 1) / self.parameters.rate_hz)

    def increments(
        self, trajectory: Trajectory, start_s: float, end_s: float, rng: np.random.Generator
    ) -> ImuIncrements:
        """Measure a trajectory from start to end; both are true times within the time span of the sampled errors."""
        boundaries = self.boundaries(start_s, end_s)
        angles, velocities = true_increments(trajectory, boundaries)
        return ImuIncrements(
            times_s=np.maximum.accumulate(self.clock.tags(boundaries, rng)),
            period_s=1.0 / self.parameters.rate_hz,
            delta_angles_rad=self.gyro.measure(angles, boundaries, rng),
            delta_velocities_m_s=self.accelerometer.measure(velocities, boundaries, rng),
        )

    def exact_increments(self, trajectory: Trajectory, start_s: float, end_s: float) -> ImuIncrements:
        """Compute the increments between the same boundaries without errors; the time tags are true times."""
        boundaries = self.boundaries(start_s, end_s)
        return ImuIncrements(boundaries, 1.0 / self.parameters.rate_hz, *true_increments(trajectory, boundaries))


def _draw_off_diagonal(rng: np.random.Generator) -> Float64[np.ndarray, "3 3"]:
    """Draw a matrix of standard normal numbers with a zero diagonal."""
    return np.asarray(rng.standard_normal((3, 3)) * (1.0 - np.eye(3)))


def true_increments(trajectory: Trajectory, boundaries_s: Boundaries) -> tuple[Vectors, Vectors]:
    """Compute the true rotation vector and velocity increment of each interval, body axes at the interval's start.

    Specific force is integrated in world axes as a cubic spline through the boundaries. For a frequency f the relative
    error is of the order of (2 pi f step)^4 / 720: 1e-9 for a pitch oscillation of 1 Hz at 400 samples per second.
    """
    motion = trajectory.motion(boundaries_s)
    forces = motion.attitudes.apply(motion.specific_forces_m_s2)
    velocity_increments = np.diff(CubicSpline(boundaries_s, forces).antiderivative()(boundaries_s), axis=0)
    start_inverse = motion.attitudes[:-1].inv()
    rotations = Rotation.from_quat(multiply_quaternions(start_inverse.as_quat(), motion.attitudes[1:].as_quat()))
    return rotations.as_rotvec(), start_inverse.apply(velocity_increments)
