"""State of inertial navigation with the covariance of its errors, and its propagation by inertial increments.

The state is position, velocity, attitude R (world from body), gyro bias and accelerometer bias. The 15 errors are true
minus estimated values; the attitude error e is a rotation vector in world axes: true R = exp(e) R. To first order

    d(position error)/dt = velocity error
    d(velocity error)/dt = e x f - R (accelerometer bias error) + noise        f: specific force, world axes
    de/dt                = -R (gyro bias error) + noise

with constant gravity (Titterton and Weston, Strapdown Inertial Navigation Technology, ch. 12). The biases are random
walks. Errors of scale factors and misalignments are not estimated; their effect is part of the process noise.

The increments are those of `ImuIncrements`: coning and sculling are contained in them. A time between two sample
boundaries divides an interval: the rate is constant in it, and the specific force is constant in the body axes at the
interval's start. Results do not depend on such divisions, apart from rounding.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from marsyard.algorithms.arrays import Vector3
from marsyard.algorithms.localisation.matrices import cross_matrix, left_jacobian, symmetrise

#: One degree per hour, rad/s; one degree per square root of an hour, rad/sqrt(s); unit of accelerations in data sheets.
_DEG_H = np.radians(1.0) / 3600.0
_DEG_SQRT_H = np.radians(1.0) / 60.0
_STANDARD_GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True)
class ImuErrorModel:
    """Errors of an inertial unit as assumed by the filter; standard deviations per axis.

    The defaults are those of an LN-200 (Northrop Grumman's data sheet: bias repeatability from 1 deg/h and from 0.3 mg,
    bias instability, random walks, scale factors, misalignment).

    - gyro_wander_deg_h, gyro_wander_s: standard deviation and correlation time of a Gauss-Markov bias that is added to
      the constant bias; the same for accelerometer_wander_mg and accelerometer_wander_s
    - sensitivity_correlation_s: time over which rate and force are nearly constant, assumed. An error of scale or
      misalignment s acts like white noise of the density s * force * sqrt(2 * sensitivity_correlation_s).
    """

    angular_random_walk_deg_sqrt_h: float = 0.07
    gyro_bias_deg_h: float = 1.0
    gyro_wander_deg_h: float = 0.35
    gyro_wander_s: float = 100.0
    gyro_scale_ppm: float = 100.0
    gyro_misalignment_mrad: float = 0.1
    velocity_random_walk_ug_sqrt_hz: float = 50.0
    accelerometer_bias_mg: float = 0.3
    accelerometer_wander_mg: float = 0.05
    accelerometer_wander_s: float = 60.0
    accelerometer_scale_ppm: float = 300.0
    accelerometer_misalignment_mrad: float = 0.1
    sensitivity_correlation_s: float = 10.0

    @property
    def initial_bias_variances(self) -> Float[np.ndarray, "6"]:
        """Variances of gyro biases, (rad/s)^2, and accelerometer biases, (m/s2)^2: constant part and wander."""
        gyro = (self.gyro_bias_deg_h**2 + self.gyro_wander_deg_h**2) * _DEG_H**2
        milli_g = 1e-3 * _STANDARD_GRAVITY_M_S2
        accelerometer = (self.accelerometer_bias_mg**2 + self.accelerometer_wander_mg**2) * milli_g**2
        return np.repeat([gyro, accelerometer], 3)

    @property
    def white_densities(self) -> Float[np.ndarray, "15"]:
        """Spectral densities of white noise that does not depend on the motion, squared units of the errors per s."""
        angle = self.angular_random_walk_deg_sqrt_h * _DEG_SQRT_H
        velocity = 1e-6 * self.velocity_random_walk_ug_sqrt_hz * _STANDARD_GRAVITY_M_S2
        # over times much shorter than its correlation time a Gauss-Markov bias is a random walk of this density
        gyro = (self.gyro_wander_deg_h * _DEG_H) ** 2 * 2.0 / self.gyro_wander_s
        wander = 1e-3 * self.accelerometer_wander_mg * _STANDARD_GRAVITY_M_S2
        accelerometer = wander**2 * 2.0 / self.accelerometer_wander_s
        return np.repeat([0.0, velocity**2, angle**2, gyro, accelerometer], 3)

    def sensitivity_densities(self, body_rate_rad_s: Vector3, force_m_s2: Vector3) -> tuple[Vector3, Vector3]:
        """Compute densities of the noise by scale and misalignment per body axis: angle, rad^2/s; velocity, m^2/s^3."""
        rate_squares, force_squares = body_rate_rad_s**2, force_m_s2**2
        gyro_scale, gyro_cross = 1e-6 * self.gyro_scale_ppm, 1e-3 * self.gyro_misalignment_mrad
        scale, cross = 1e-6 * self.accelerometer_scale_ppm, 1e-3 * self.accelerometer_misalignment_mrad
        angle = gyro_scale**2 * rate_squares + gyro_cross**2 * (rate_squares.sum() - rate_squares)
        velocity = scale**2 * force_squares + cross**2 * (force_squares.sum() - force_squares)
        factor = 2.0 * self.sensitivity_correlation_s
        return factor * angle, factor * velocity


#: Blocks of the error vector: position (m), velocity (m/s), attitude (rad), gyro bias (rad/s), accelerometer bias
#: (m/s2).
POSITION, VELOCITY, ATTITUDE = slice(0, 3), slice(3, 6), slice(6, 9)
GYRO_BIAS, ACCELEROMETER_BIAS = slice(9, 12), slice(12, 15)
#: Blocks of the motion: position, velocity and attitude.
MOTION = slice(POSITION.start, ATTITUDE.stop)
ERRORS = 15  #: Number of errors.
ErrorVector = Float[np.ndarray, "15"]
ErrorMatrix = Float[np.ndarray, "15 15"]


@dataclass(frozen=True)
class NavigationState:
    """Estimated state at a time, with the covariance of its 15 errors; position and velocity in world axes."""

    time_s: float
    position_m: Vector3
    velocity_m_s: Vector3
    world_from_body: Rotation
    gyro_bias_rad_s: Vector3
    accelerometer_bias_m_s2: Vector3
    covariance: ErrorMatrix

    def correct(self, errors: ErrorVector, covariance: ErrorMatrix) -> NavigationState:
        """Add estimated errors to the state; `covariance` is that of the errors about this estimate.

        The attitude error is from then on relative to the corrected attitude: with e = d + r, exp(e) = exp(J r) exp(d),
        so that the remaining error is J r with the left Jacobian J of the rotation d.
        """
        reset = np.eye(ERRORS)
        reset[ATTITUDE, ATTITUDE] = left_jacobian(errors[ATTITUDE])
        return replace(
            self,
            position_m=self.position_m + errors[POSITION],
            velocity_m_s=self.velocity_m_s + errors[VELOCITY],
            world_from_body=Rotation.from_rotvec(errors[ATTITUDE]) * self.world_from_body,
            gyro_bias_rad_s=self.gyro_bias_rad_s + errors[GYRO_BIAS],
            accelerometer_bias_m_s2=self.accelerometer_bias_m_s2 + errors[ACCELEROMETER_BIAS],
            covariance=symmetrise(reset @ covariance @ reset.T),
        )


@dataclass(frozen=True)
class IncrementHistory:
    """Consecutive increments between strictly increasing time tags; the fields are those of `ImuIncrements`."""

    times_s: Float[np.ndarray, "m"]
    period_s: float
    delta_angles_rad: Float[np.ndarray, "n 3"]
    delta_velocities_m_s: Float[np.ndarray, "n 3"]


def propagate_states(
    state: NavigationState,
    history: IncrementHistory,
    times_s: Float[np.ndarray, "k"],
    gravity_m_s2: float,
    errors: ImuErrorModel,
) -> list[NavigationState]:
    """Propagate a state to increasing later times; the covariance is propagated from each time to the next.

    Times shortly outside the history are extrapolated with the rate and force of its first or last interval. Positions
    are integrals of velocities that are linear within an interval.
    """
    tags, period = history.times_s, history.period_s
    inner = tags[(tags > state.time_s) & (tags < times_s[-1])]
    edges = np.unique(np.concatenate([[state.time_s], inner, times_s]))
    interval = np.clip(np.searchsorted(tags, edges[:-1], side="right") - 1, 0, len(tags) - 2)
    length = tags[interval + 1] - tags[interval]
    start, fraction = (edges[:-1] - tags[interval]) / length, np.diff(edges) / length
    elapsed = fraction * period
    angles = history.delta_angles_rad[interval] - state.gyro_bias_rad_s * period
    rotations = _accumulate_rotations(state.world_from_body, fraction[:, None] * angles)
    increments = fraction[:, None] * (history.delta_velocities_m_s[interval] - state.accelerometer_bias_m_s2 * period)
    # velocity increments are in the axes at the start of the whole interval
    increments = Rotation.from_rotvec(-start[:, None] * angles).apply(increments)
    gravity = np.array([0.0, 0.0, -gravity_m_s2])
    delta_velocities = (rotations[:-1] @ increments[..., None])[..., 0] + elapsed[:, None] * gravity
    velocities = _accumulate(state.velocity_m_s, delta_velocities)
    positions = _accumulate(state.position_m, 0.5 * elapsed[:, None] * (velocities[1:] + velocities[:-1]))
    rotation_integrals = 0.5 * elapsed[:, None, None] * (rotations[1:] + rotations[:-1])

    states: list[NavigationState] = []
    first, covariance, ends = 0, state.covariance, np.searchsorted(edges, times_s)
    attitudes = Rotation.from_matrix(rotations[ends])
    for number, last in enumerate(ends.tolist()):
        step_s = float(elapsed[first:last].sum())
        delta_velocity = velocities[last] - velocities[first] - gravity * step_s
        delta_position = positions[last] - positions[first] - (velocities[first] + 0.5 * gravity * step_s) * step_s
        rotation_integral = rotation_integrals[first:last].sum(axis=0)
        transition = compute_transition(delta_velocity, delta_position, rotation_integral, step_s)
        body_rate = (fraction[first:last, None] * angles[first:last]).sum(axis=0) / step_s
        noise = _compute_noise(errors, body_rate, delta_velocity, rotation_integral, step_s)
        # white noise during the step, to second order: the mean of noise at its start and at its end
        covariance = symmetrise(transition @ (covariance + 0.5 * noise) @ transition.T + 0.5 * noise)
        states.append(
            replace(
                state,
                time_s=float(edges[last]),
                position_m=positions[last],
                velocity_m_s=velocities[last],
                world_from_body=attitudes[number],
                covariance=covariance,
            )
        )
        first = last
    return states


def compute_transition(
    delta_velocity: Vector3, delta_position: Vector3, rotation_integral: Float[np.ndarray, "3 3"], step_s: float
) -> ErrorMatrix:
    """Compute the transition matrix of the errors over a step, to first order in the errors.

    - delta_velocity, delta_position: single and double integral of specific force, world axes
    - rotation_integral: integral of the rotation matrix (world from body)

    The effects of attitude errors and of biases on velocity and attitude are exact integrals. Position by the biases,
    and velocity by the gyro bias, are computed as if force and attitude were constant in the step.
    """
    transition = np.eye(ERRORS)
    transition[POSITION, VELOCITY] = step_s * np.eye(3)
    transition[POSITION, ATTITUDE] = -cross_matrix(delta_position)
    transition[VELOCITY, ATTITUDE] = -cross_matrix(delta_velocity)
    transition[ATTITUDE, GYRO_BIAS] = transition[VELOCITY, ACCELEROMETER_BIAS] = -rotation_integral
    transition[POSITION, ACCELEROMETER_BIAS] = -0.5 * step_s * rotation_integral
    transition[VELOCITY, GYRO_BIAS] = 0.5 * cross_matrix(delta_velocity) @ rotation_integral
    transition[POSITION, GYRO_BIAS] = cross_matrix(delta_position) @ rotation_integral / 3.0
    return transition


def _compute_noise(
    errors: ImuErrorModel,
    body_rate: Vector3,
    delta_velocity: Vector3,
    rotation_integral: Float[np.ndarray, "3 3"],
    step_s: float,
) -> ErrorMatrix:
    """Compute the covariance of the noise that accumulates in a step."""
    rotation = rotation_integral / step_s
    angle, velocity = errors.sensitivity_densities(body_rate, rotation.T @ delta_velocity / step_s)
    noise = np.diag(errors.white_densities * step_s)
    noise[ATTITUDE, ATTITUDE] += (rotation * angle * step_s) @ rotation.T
    noise[VELOCITY, VELOCITY] += (rotation * velocity * step_s) @ rotation.T
    return noise


def _accumulate(start: Vector3, steps: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Compute the values after 0, 1, 2, ... n steps."""
    return np.cumsum(np.concatenate([start[None], steps]), axis=0)


def _accumulate_rotations(start: Rotation, rotation_vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3 3"]:
    """Compute the rotation matrices after 0, 1, 2, ... n rotations about body axes.

    Scan by doubling (Hillis and Steele 1986): after the pass with distance d each matrix is the product of 2 d
    rotations. Matrices, because products of SciPy's rotations take ten times longer.
    """
    matrices = np.concatenate([start.as_matrix()[None], Rotation.from_rotvec(rotation_vectors).as_matrix()])
    distance = 1
    while distance < len(matrices):
        matrices[distance:] = matrices[:-distance] @ matrices[distance:]
        distance *= 2
    return matrices
