"""Compiled error-state Kalman filter of `marsyard.sim.sensor.helicopter_navigation`.

A state has 16 values: position, velocity, quaternion (x, y, z, w; world from body), gyro bias, accelerometer bias.
Errors are true minus estimated; the attitude error is a rotation vector in world axes. The covariance is that of 15
estimated errors and nine considered errors: the wander of the receiver's position (in units of its standard deviation)
and velocity, the compass bias, and the biases of the two inclinometers. "Fix" means a receiver's solution.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: First index of each block of the error vector; number of estimated errors and of all errors.
POSITION, VELOCITY, ATTITUDE_ERROR, GYRO_BIAS, ACCELEROMETER_BIAS = 0, 3, 6, 9, 12
ESTIMATED = 15
POSITION_WANDER, VELOCITY_WANDER, HEADING_BIAS, TILT_BIAS = 15, 18, 21, 22
ERRORS = 24
#: First index of each block of the state after position and velocity; number of values.
QUATERNION, STATE_GYRO_BIAS, STATE_ACCELEROMETER_BIAS, STATE = 6, 10, 13, 16
#: First columns in a receiver row: time tag, delivery time, solution, deviations of wander and noise, whether fixed.
TAG, DELIVERY, GPS_POSITION, GPS_VELOCITY, GPS_WANDER, GPS_NOISE, FIXED = 0, 1, 2, 5, 8, 11, 14
#: First columns in a row of the tilt compass after the time tag: up direction (body axes), and yaw from the heading,
#: counterclockwise from east.
UP, YAW = 1, 4
#: First indices in the filter's memory between runs: whether the last receiver solution was fixed (or `NO_FIX`),
#: filtered acceleration in world axes, and number of consecutive rejected solutions; number of values.
LAST_FIX, FILTERED_ACCELERATION, REJECTED, MEMORY = 0, 1, 4, 5
NO_FIX = -1.0  #: Value of `LAST_FIX` before the first solution.


class Tuning(NamedTuple):
    """Parameters of the filter in SI units; `FilterParameters` and the parameters of the instruments define them.

    - ..._density: noise densities of the random walks of attitude, velocity and biases
    - ..._decay: factor of a time-correlated error (wander) over one step
    - velocity_wander_m_s, velocity_noise_m_s, tilt_noise_rad, heading_noise_rad: standard deviations of the instruments
    - tan_dip: tangent of the dip of the magnetic field
    - lag_s: time constant of the inclinometers
    - disturbance: tilt error of the inclinometers in an acceleration, divided by acceleration / gravity
    - gate: maximum absolute normalised innovation of an accepted measurement
    - max_rejected_fixes: number of consecutive rejected solutions before a restart
    - first_position_m, first_velocity_m_s, first_tilt_rad: standard deviations at the start and after a restart
    """

    gravity_m_s2: float
    attitude_density: float
    velocity_density: float
    gyro_bias_density: float
    accelerometer_bias_density: float
    fixed_wander_decay: float
    floating_wander_decay: float
    velocity_wander_m_s: tuple[float, float, float]
    velocity_decay: float
    velocity_noise_m_s: tuple[float, float, float]
    tilt_noise_rad: float
    heading_noise_rad: float
    tan_dip: float
    lag_s: float
    disturbance: float
    unmodelled_acceleration_m_s2: float
    gate: float
    max_rejected_fixes: int
    first_position_m: float
    first_velocity_m_s: float
    first_tilt_rad: float


class Inputs(NamedTuple):
    """Inputs of a run.

    - times, step, angles, velocities: boundaries, nominal period and increments of the inertial samples
    - gps, compass: rows of the receiver and of the tilt compass
    """

    times: Array
    step: float
    angles: Array
    velocities: Array
    gps: Array
    compass: Array


class Estimate(NamedTuple):
    """A state and the covariance of its errors; both are updated in place."""

    state: Array
    covariance: Array


@njit(cache=True)
def write_rotation_matrix(q: Array, matrix: Array) -> None:
    """Write the rotation matrix of a quaternion into `matrix`."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    matrix[0, 0], matrix[0, 1], matrix[0, 2] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)
    matrix[1, 0], matrix[1, 1], matrix[1, 2] = 2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)
    matrix[2, 0], matrix[2, 1], matrix[2, 2] = 2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)


@njit(cache=True)
def _quaternion_from_vector(v: Array) -> tuple[float, float, float, float]:
    """Convert a rotation vector to a quaternion (x, y, z, w)."""
    angle = math.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
    scale = 0.5 - angle * angle / 48.0 if angle < 1e-4 else math.sin(0.5 * angle) / angle
    return scale * v[0], scale * v[1], scale * v[2], math.cos(0.5 * angle)


@njit(cache=True)
def _multiply(a: tuple[float, float, float, float], b: tuple[float, float, float, float], out: Array) -> None:
    """Write the normalised product of two quaternions (x, y, z, w)."""
    out[0] = a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1]
    out[1] = a[3] * b[1] + a[1] * b[3] + a[2] * b[0] - a[0] * b[2]
    out[2] = a[3] * b[2] + a[2] * b[3] + a[0] * b[1] - a[1] * b[0]
    out[3] = a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2]
    norm = math.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2 + out[3] ** 2)
    for i in range(4):
        out[i] /= norm


@njit(cache=True)
def propagate_state(state: Array, after: Array, angle: Array, velocity: Array, gravity: float, step: float) -> Array:
    """Propagate the state by a step into `after`; return the velocity change without gravity, world axes."""
    matrix, rotation, delta_v = np.empty((3, 3)), np.empty(3), np.zeros(3)
    write_rotation_matrix(state[QUATERNION:], matrix)
    for i in range(3):
        rotation[i] = angle[i] - state[STATE_GYRO_BIAS + i] * step
        for j in range(3):
            delta_v[i] += matrix[i, j] * (velocity[j] - state[STATE_ACCELEROMETER_BIAS + j] * step)
    for i in range(3):
        change = delta_v[i] - (gravity * step if i == 2 else 0.0)
        after[POSITION + i] = state[POSITION + i] + (state[VELOCITY + i] + 0.5 * change) * step
        after[VELOCITY + i] = state[VELOCITY + i] + change
        after[STATE_GYRO_BIAS + i] = state[STATE_GYRO_BIAS + i]
        after[STATE_ACCELEROMETER_BIAS + i] = state[STATE_ACCELEROMETER_BIAS + i]
    q = state[QUATERNION : QUATERNION + 4]
    _multiply((q[0], q[1], q[2], q[3]), _quaternion_from_vector(rotation), after[QUATERNION : QUATERNION + 4])
    return delta_v


@njit(cache=True)
def apply_transition(
    errors: Array, matrix: Array, cross: Array, decay: float, velocity_decay: float, step: float
) -> None:
    """Multiply error vectors (the columns of `errors`) by the transition matrix of a step, in place.

    `matrix` rotates from body to world; `cross` is minus the cross-product matrix of the velocity change. `decay` and
    `velocity_decay` are the factors of the receiver's position and velocity wander over the step.
    """
    velocity, rotation = np.empty(3), np.empty(3)
    for j in range(ERRORS):
        for i in range(3):
            velocity[i] = rotation[i] = 0.0
            for k in range(3):
                bias = step * matrix[i, k] * errors[ACCELEROMETER_BIAS + k, j]
                velocity[i] += cross[i, k] * errors[ATTITUDE_ERROR + k, j] - bias
                rotation[i] += matrix[i, k] * errors[GYRO_BIAS + k, j]
        for i in range(3):
            errors[POSITION + i, j] += step * (errors[VELOCITY + i, j] + 0.5 * velocity[i])
            errors[VELOCITY + i, j] += velocity[i]
            errors[ATTITUDE_ERROR + i, j] -= step * rotation[i]
            errors[POSITION_WANDER + i, j] *= decay
            errors[VELOCITY_WANDER + i, j] *= velocity_decay


@njit(cache=True)
def propagate_covariance(p: Array, matrix: Array, delta_v: Array, decay: float, tuning: Tuning, step: float) -> None:
    """Propagate the covariance P by a step, in place: P = F P F' + Q, with the transition matrix F and the noise Q."""
    cross = np.zeros((3, 3))
    cross[0, 1], cross[0, 2], cross[1, 2] = delta_v[2], -delta_v[1], delta_v[0]
    cross[1, 0], cross[2, 0], cross[2, 1] = -delta_v[2], delta_v[1], -delta_v[0]
    apply_transition(p, matrix, cross, decay, tuning.velocity_decay, step)
    apply_transition(p.T, matrix, cross, decay, tuning.velocity_decay, step)
    for i in range(3):
        p[VELOCITY + i, VELOCITY + i] += tuning.velocity_density**2 * step
        p[ATTITUDE_ERROR + i, ATTITUDE_ERROR + i] += tuning.attitude_density**2 * step
        p[GYRO_BIAS + i, GYRO_BIAS + i] += tuning.gyro_bias_density**2 * step
        p[ACCELEROMETER_BIAS + i, ACCELEROMETER_BIAS + i] += tuning.accelerometer_bias_density**2 * step
        p[POSITION_WANDER + i, POSITION_WANDER + i] += 1.0 - decay * decay
        p[VELOCITY_WANDER + i, VELOCITY_WANDER + i] += tuning.velocity_wander_m_s[i] ** 2 * (
            1.0 - tuning.velocity_decay**2
        )


@njit(cache=True)
def update_scalar(estimate: Estimate, h: Array, residual: float, noise: float, gate: float) -> bool:
    """Update with one scalar measurement unless it is rejected; return whether it was accepted.

    Gains of considered errors are zero (Schmidt 1966).

    - h: derivatives of the measurement with respect to all errors
    - residual, noise: measured minus expected value, and standard deviation of the measurement noise
    - gate: maximum absolute normalised innovation of an accepted measurement
    """
    state, p = estimate
    ph = np.zeros(ERRORS)
    for j in range(ERRORS):
        if h[j] != 0.0:
            for i in range(ERRORS):
                ph[i] += p[i, j] * h[j]
    variance = noise * noise
    for i in range(ERRORS):
        variance += h[i] * ph[i]
    if not abs(residual / math.sqrt(variance)) < gate:
        return False
    # P - K h'P - P h K' + K s K', with K zero for considered errors
    for i in range(ERRORS):
        gain_i = ph[i] / variance if i < ESTIMATED else 0.0
        for j in range(ERRORS):
            gain_j = ph[j] / variance if j < ESTIMATED else 0.0
            p[i, j] += -gain_i * ph[j] - ph[i] * gain_j + gain_i * variance * gain_j
    correction = ph[:ESTIMATED] * (residual / variance)
    for i in range(3):
        state[POSITION + i] += correction[POSITION + i]
        state[VELOCITY + i] += correction[VELOCITY + i]
        state[STATE_GYRO_BIAS + i] += correction[GYRO_BIAS + i]
        state[STATE_ACCELEROMETER_BIAS + i] += correction[ACCELEROMETER_BIAS + i]
    q = state[QUATERNION : QUATERNION + 4]
    rotation = correction[ATTITUDE_ERROR : ATTITUDE_ERROR + 3]
    _multiply(_quaternion_from_vector(rotation), (q[0], q[1], q[2], q[3]), q)
    return True


@njit(cache=True)
def _interpolate(times: Array, values: Array, last: int, time: float) -> Array:
    """Interpolate the rows of `values` at a time; only rows up to index `last` are used."""
    k = last
    while k > 0 and times[k] > time:
        k -= 1
    after = min(k + 1, last)
    span = times[after] - times[k]
    fraction = 0.0 if span <= 0.0 else min(max((time - times[k]) / span, 0.0), 1.0)
    out: Array = values[k] + fraction * (values[after] - values[k])
    return out


@njit(cache=True)
def _reset_errors(p: Array, block: int, deviation: float, old_factor: float) -> None:
    """Reset three errors to uncorrelated: variance deviation^2 plus `old_factor` times the previous variance."""
    for i in range(block, block + 3):
        variance = old_factor * p[i, i] + deviation * deviation
        p[i, :], p[:, i] = 0.0, 0.0
        p[i, i] = variance


@njit(cache=True)
def _restart(estimate: Estimate, row: Array, tuning: Tuning) -> None:
    """Set position and velocity to a solution; increase the covariance of both and of the attitude."""
    state, p = estimate
    state[POSITION : POSITION + 3] = row[GPS_POSITION : GPS_POSITION + 3]
    state[VELOCITY : VELOCITY + 3] = row[GPS_VELOCITY : GPS_VELOCITY + 3]
    _reset_errors(p, POSITION, tuning.first_position_m, 0.0)
    _reset_errors(p, VELOCITY, tuning.first_velocity_m_s, 0.0)
    _reset_errors(p, ATTITUDE_ERROR, tuning.first_tilt_rad, 1.0)


@njit(cache=True)
def update_fix(row: Array, estimate: Estimate, change: Array, time: float, tuning: Tuning) -> bool:
    """Update with a solution and the displacement and velocity `change` since its time tag.

    Return whether all six components were accepted.
    """
    state, _ = estimate
    h, all_accepted = np.empty(ERRORS), True
    for i in range(3):
        h[:] = 0.0
        h[POSITION + i], h[VELOCITY + i], h[POSITION_WANDER + i] = 1.0, row[TAG] - time, row[GPS_WANDER + i]
        residual = row[GPS_POSITION + i] + change[POSITION + i] - state[POSITION + i]
        all_accepted &= update_scalar(estimate, h, residual, row[GPS_NOISE + i], tuning.gate)
    for i in range(3):
        h[:] = 0.0
        h[VELOCITY + i], h[VELOCITY_WANDER + i] = 1.0, 1.0
        residual = row[GPS_VELOCITY + i] + change[VELOCITY + i] - state[VELOCITY + i]
        all_accepted &= update_scalar(estimate, h, residual, tuning.velocity_noise_m_s[i], tuning.gate)
    return all_accepted


@njit(cache=True)
def update_tilt(row: Array, estimate: Estimate, disturbance_rad: float, tuning: Tuning) -> None:
    """Update with the x and y components of the inclinometers' up direction.

    `disturbance_rad` is the standard deviation of the tilt error that accelerations cause.
    """
    h, matrix = np.empty(ERRORS), np.empty((3, 3))
    for i in range(2):
        write_rotation_matrix(estimate.state[QUATERNION:], matrix)
        h[:] = 0.0
        h[ATTITUDE_ERROR], h[ATTITUDE_ERROR + 1], h[TILT_BIAS + i] = matrix[1, i], -matrix[0, i], 1.0
        noise = math.hypot(tuning.tilt_noise_rad, disturbance_rad)
        update_scalar(estimate, h, row[UP + i] - matrix[2, i], noise, tuning.gate)


@njit(cache=True)
def update_heading(row: Array, estimate: Estimate, disturbance_rad: float, tuning: Tuning) -> None:
    """Update with the yaw of the compass; `disturbance_rad`: see `update_tilt`."""
    h, matrix = np.zeros(ERRORS), np.empty((3, 3))
    write_rotation_matrix(estimate.state[QUATERNION:], matrix)
    horizontal = matrix[0, 0] ** 2 + matrix[1, 0] ** 2
    h[ATTITUDE_ERROR] = -matrix[2, 0] * matrix[0, 0] / horizontal
    h[ATTITUDE_ERROR + 1] = -matrix[2, 0] * matrix[1, 0] / horizontal
    h[ATTITUDE_ERROR + 2], h[HEADING_BIAS] = 1.0, 1.0
    residual = row[YAW] - math.atan2(matrix[1, 0], matrix[0, 0])
    noise = math.hypot(tuning.heading_noise_rad, tuning.tan_dip * disturbance_rad)
    update_scalar(estimate, h, math.atan2(math.sin(residual), math.cos(residual)), noise, tuning.gate)


@njit(cache=True)
def _propagate(inputs: Inputs, k: int, states: Array, p: Array, memory: Array, tuning: Tuning) -> None:
    """Propagate state, covariance and filtered acceleration over the sample that ends at boundary k."""
    before, step, matrix = states[k - 1], inputs.step, np.empty((3, 3))
    write_rotation_matrix(before[QUATERNION:], matrix)
    delta_v = propagate_state(
        before, states[k], inputs.angles[k - 1], inputs.velocities[k - 1], tuning.gravity_m_s2, step
    )
    decay = tuning.fixed_wander_decay if memory[LAST_FIX] == 1.0 else tuning.floating_wander_decay
    propagate_covariance(p, matrix, delta_v, decay, tuning, step)
    for i in range(3):
        change = states[k, VELOCITY + i] - before[VELOCITY + i]
        filtered = memory[FILTERED_ACCELERATION + i]
        memory[FILTERED_ACCELERATION + i] += (change / step - filtered) * min(step / tuning.lag_s, 1.0)


@njit(cache=True)
def run(inputs: Inputs, start: Array, p: Array, memory: Array, tuning: Tuning) -> Array:
    """Run the filter; return the state at each boundary.

    `memory` and the covariance `p` are updated in place. Readings with tags before the first boundary are ignored.
    """
    times, gps, compass = inputs.times, inputs.gps, inputs.compass
    states = np.empty((times.size, STATE))
    # position and velocity change since the start of the run, from the inertial unit only, in the columns of a state
    inertial = np.zeros((times.size, QUATERNION))
    next_fix = next_reading = 0
    states[0] = start
    for k in range(times.size):
        state = states[k]
        estimate = Estimate(state, p)
        if k > 0:
            _propagate(inputs, k, states, p, memory, tuning)
            change = state[VELOCITY : VELOCITY + 3] - states[k - 1, VELOCITY : VELOCITY + 3]
            before = inertial[k - 1]
            inertial[k, :VELOCITY] = before[:VELOCITY] + (before[VELOCITY:] + 0.5 * change) * inputs.step
            inertial[k, VELOCITY:] = before[VELOCITY:] + change
        while next_fix < gps.shape[0] and gps[next_fix, DELIVERY] <= times[k]:
            row = gps[next_fix]
            next_fix += 1
            if math.isnan(row[GPS_POSITION]) or row[TAG] < times[0]:
                continue
            if memory[LAST_FIX] != row[FIXED]:
                _reset_errors(p, POSITION_WANDER, 1.0, 0.0)
                memory[LAST_FIX] = row[FIXED]
            # displacement since the time of the solution, from the current velocity estimate
            fix_change = inertial[k] - _interpolate(times, inertial, k, row[TAG])
            fix_change[:VELOCITY] += (state[VELOCITY:QUATERNION] - inertial[k, VELOCITY:]) * (times[k] - row[TAG])
            if memory[REJECTED] >= tuning.max_rejected_fixes:
                _restart(estimate, row, tuning)
            is_accepted = update_fix(row, estimate, fix_change, times[k], tuning)
            memory[REJECTED] = 0.0 if is_accepted else memory[REJECTED] + 1.0
        east, north = memory[FILTERED_ACCELERATION], memory[FILTERED_ACCELERATION + 1]
        acceleration = math.sqrt(east**2 + north**2 + tuning.unmodelled_acceleration_m_s2**2)
        disturbance_rad = tuning.disturbance * acceleration / tuning.gravity_m_s2
        while next_reading < compass.shape[0] and compass[next_reading, TAG] <= times[k]:
            row = compass[next_reading]
            next_reading += 1
            if row[TAG] < times[0]:
                continue
            if not math.isnan(row[UP]):
                update_tilt(row, estimate, disturbance_rad, tuning)
            if not math.isnan(row[YAW]):
                update_heading(row, estimate, disturbance_rad, tuning)
    return states
