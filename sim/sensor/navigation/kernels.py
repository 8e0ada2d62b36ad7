"""Compiled error-state Kalman filter of `marsyard.sim.sensor.navigation`.

A state is a row of 16: position, velocity, quaternion (x, y, z, w; world from body), gyro bias, accelerometer bias. An
error is true less estimated; the attitude error is a small rotation about world axes. The covariance has 15 estimated
errors, then nine considered ones: the wander of the receiver's positions (in units of its standard deviation) and
velocities, the bias of the compass and those of the two inclinometers.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Blocks of the error vector.
POSITION, VELOCITY, ATTITUDE_ERROR, GYRO_BIAS, ACCELEROMETER_BIAS = 0, 3, 6, 9, 12
ESTIMATED = 15
POSITION_WANDER, VELOCITY_WANDER, HEADING_BIAS, TILT_BIAS = 15, 18, 21, 22
ERRORS = 24
#: Blocks of the state, after position and velocity.
QUATERNION, STATE_GYRO_BIAS, STATE_ACCELEROMETER_BIAS, STATE = 6, 10, 13, 16
#: Columns of a receiver's row: time tag, time of delivery, solution, deviations of wander and noise, whether fixed.
TAG, ARRIVAL, GPS_POSITION, GPS_VELOCITY, GPS_WANDER, GPS_NOISE, FIXED = 0, 1, 2, 5, 8, 11, 14
#: Columns of a compass's row after its time tag; yaw is counterclockwise from east.
UP, YAW = 1, 4
#: Types of innovations.
POSITION_FIX, VELOCITY_FIX, COMPASS, INCLINOMETER = range(4)
#: Memory between runs: whether the receiver's last solution was fixed (-1: none yet), the filtered acceleration in
#: world axes, and how many solutions in a row were rejected.
LAST_FIX, FILTERED_ACCELERATION, REJECTED, MEMORY = 0, 1, 4, 5
INNOVATION = 5  #: Columns of an innovation: time, type, axis, normalised by its deviation, whether it was used.


class Tuning(NamedTuple):
    """Assumptions of the filter, SI units: see `FilterParameters`."""

    gravity_m_s2: float
    attitude_density: float
    velocity_density: float
    gyro_bias_density: float
    accelerometer_bias_density: float
    wander_kept_fixed: float
    wander_kept_floating: float
    velocity_wander_m_s: tuple[float, float, float]
    velocity_wander_kept: float
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
    """Inputs of a run: boundaries and increments of the inertial samples, rows of receiver and compass.

    `kept_at` are the boundaries with stored covariances, ascending.
    """

    times: Array
    step: float
    angles: Array
    velocities: Array
    gps: Array
    tilts: Array
    kept_at: NDArray[np.int64]


class Estimate(NamedTuple):
    """A state and the covariance of its errors; both are changed in place."""

    state: Array
    covariance: Array


@njit(cache=True)
def matrix_of(q: Array, matrix: Array) -> None:
    """Write the rotation matrix of a quaternion."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    matrix[0, 0], matrix[0, 1], matrix[0, 2] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)
    matrix[1, 0], matrix[1, 1], matrix[1, 2] = 2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)
    matrix[2, 0], matrix[2, 1], matrix[2, 2] = 2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)


@njit(cache=True)
def _quaternion_of(turn: Array) -> tuple[float, float, float, float]:
    angle = math.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    scale = 0.5 - angle * angle / 48.0 if angle < 1e-4 else math.sin(0.5 * angle) / angle
    return scale * turn[0], scale * turn[1], scale * turn[2], math.cos(0.5 * angle)


@njit(cache=True)
def _product(a: tuple[float, float, float, float], b: tuple[float, float, float, float], out: Array) -> None:
    out[0] = a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1]
    out[1] = a[3] * b[1] + a[1] * b[3] + a[2] * b[0] - a[0] * b[2]
    out[2] = a[3] * b[2] + a[2] * b[3] + a[0] * b[1] - a[1] * b[0]
    out[3] = a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2]
    size = math.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2 + out[3] ** 2)
    for i in range(4):
        out[i] /= size


@njit(cache=True)
def propagate_state(state: Array, after: Array, angle: Array, velocity: Array, gravity: float, step: float) -> Array:
    """Write the state a step later; return the velocity gained without gravity, world axes."""
    matrix, turn, gained = np.empty((3, 3)), np.empty(3), np.zeros(3)
    matrix_of(state[QUATERNION:], matrix)
    for i in range(3):
        turn[i] = angle[i] - state[STATE_GYRO_BIAS + i] * step
        for j in range(3):
            gained[i] += matrix[i, j] * (velocity[j] - state[STATE_ACCELEROMETER_BIAS + j] * step)
    for i in range(3):
        change = gained[i] - (gravity * step if i == 2 else 0.0)
        after[POSITION + i] = state[POSITION + i] + (state[VELOCITY + i] + 0.5 * change) * step
        after[VELOCITY + i] = state[VELOCITY + i] + change
        after[STATE_GYRO_BIAS + i] = state[STATE_GYRO_BIAS + i]
        after[STATE_ACCELEROMETER_BIAS + i] = state[STATE_ACCELEROMETER_BIAS + i]
    q = state[QUATERNION : QUATERNION + 4]
    _product((q[0], q[1], q[2], q[3]), _quaternion_of(turn), after[QUATERNION : QUATERNION + 4])
    return gained


@njit(cache=True)
def apply_transition(m: Array, matrix: Array, force: Array, kept: float, velocity_kept: float, step: float) -> None:
    """Multiply a matrix of columns of errors by the transition over a step."""
    velocity, turn = np.empty(3), np.empty(3)
    for j in range(ERRORS):
        for i in range(3):
            velocity[i] = turn[i] = 0.0
            for k in range(3):
                bias = step * matrix[i, k] * m[ACCELEROMETER_BIAS + k, j]
                velocity[i] += force[i, k] * m[ATTITUDE_ERROR + k, j] - bias
                turn[i] += matrix[i, k] * m[GYRO_BIAS + k, j]
        for i in range(3):
            m[POSITION + i, j] += step * (m[VELOCITY + i, j] + 0.5 * velocity[i])
            m[VELOCITY + i, j] += velocity[i]
            m[ATTITUDE_ERROR + i, j] -= step * turn[i]
            m[POSITION_WANDER + i, j] *= kept
            m[VELOCITY_WANDER + i, j] *= velocity_kept


@njit(cache=True)
def propagate_covariance(p: Array, matrix: Array, gained: Array, kept: float, t: Tuning, step: float) -> None:
    """Replace the covariance by that a step later: F P F' + Q, F applied to rows and then to columns."""
    force = np.zeros((3, 3))
    force[0, 1], force[0, 2], force[1, 2] = gained[2], -gained[1], gained[0]
    force[1, 0], force[2, 0], force[2, 1] = -gained[2], gained[1], -gained[0]
    apply_transition(p, matrix, force, kept, t.velocity_wander_kept, step)
    apply_transition(p.T, matrix, force, kept, t.velocity_wander_kept, step)
    for i in range(3):
        p[VELOCITY + i, VELOCITY + i] += t.velocity_density**2 * step
        p[ATTITUDE_ERROR + i, ATTITUDE_ERROR + i] += t.attitude_density**2 * step
        p[GYRO_BIAS + i, GYRO_BIAS + i] += t.gyro_bias_density**2 * step
        p[ACCELEROMETER_BIAS + i, ACCELEROMETER_BIAS + i] += t.accelerometer_bias_density**2 * step
        p[POSITION_WANDER + i, POSITION_WANDER + i] += 1.0 - kept * kept
        p[VELOCITY_WANDER + i, VELOCITY_WANDER + i] += t.velocity_wander_m_s[i] ** 2 * (1.0 - t.velocity_wander_kept**2)


@njit(cache=True)
def update_scalar(estimate: Estimate, h: Array, residual: float, noise: float, gate: float, log: Array) -> None:
    """Update with one scalar measurement; gains of considered errors are zero (Schmidt 1966).

    Write the normalised innovation and whether it passed the gate to the last columns of `log`.
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
    log[3] = residual / math.sqrt(variance)
    log[4] = 1.0 if abs(log[3]) < gate else 0.0
    if log[4] == 0.0:
        return
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
    turn = correction[ATTITUDE_ERROR : ATTITUDE_ERROR + 3]
    _product(_quaternion_of(turn), (q[0], q[1], q[2], q[3]), q)


@njit(cache=True)
def _interpolate(times: Array, values: Array, last: int, time: float) -> Array:
    """Interpolate linearly between the rows up to `last`."""
    k = last
    while k > 0 and times[k] > time:
        k -= 1
    after = min(k + 1, last)
    span = times[after] - times[k]
    fraction = 0.0 if span <= 0.0 else min(max((time - times[k]) / span, 0.0), 1.0)
    out: Array = values[k] + fraction * (values[after] - values[k])
    return out


@njit(cache=True)
def _reset_errors(p: Array, block: int, size: float, added: float) -> None:
    """Replace a block of three errors by uncorrelated ones of this deviation, plus `added` times their variance."""
    for i in range(block, block + 3):
        variance = added * p[i, i] + size * size
        p[i, :], p[:, i] = 0.0, 0.0
        p[i, i] = variance


@njit(cache=True)
def _restart(estimate: Estimate, row: Array, t: Tuning) -> None:
    """Set position and velocity to a solution; distrust both and the attitude."""
    state, p = estimate
    state[POSITION : POSITION + 3] = row[GPS_POSITION : GPS_POSITION + 3]
    state[VELOCITY : VELOCITY + 3] = row[GPS_VELOCITY : GPS_VELOCITY + 3]
    _reset_errors(p, POSITION, t.first_position_m, 0.0)
    _reset_errors(p, VELOCITY, t.first_velocity_m_s, 0.0)
    _reset_errors(p, ATTITUDE_ERROR, t.first_tilt_rad, 1.0)


@njit(cache=True)
def update_solution(row: Array, estimate: Estimate, since: Array, time: float, t: Tuning, log: Array) -> None:
    """Update with a receiver's solution, propagated by the path and velocity since its time; six innovations."""
    state, _ = estimate
    h = np.empty(ERRORS)
    for i in range(3):
        h[:] = 0.0
        h[POSITION + i], h[VELOCITY + i], h[POSITION_WANDER + i] = 1.0, row[TAG] - time, row[GPS_WANDER + i]
        log[i, 0], log[i, 1], log[i, 2] = time, POSITION_FIX, i
        residual = row[GPS_POSITION + i] + since[i] - state[POSITION + i]
        update_scalar(estimate, h, residual, row[GPS_NOISE + i], t.gate, log[i])
    for i in range(3):
        h[:] = 0.0
        h[VELOCITY + i], h[VELOCITY_WANDER + i] = 1.0, 1.0
        log[3 + i, 0], log[3 + i, 1], log[3 + i, 2] = time, VELOCITY_FIX, i
        residual = row[GPS_VELOCITY + i] + since[3 + i] - state[VELOCITY + i]
        update_scalar(estimate, h, residual, t.velocity_noise_m_s[i], t.gate, log[3 + i])


@njit(cache=True)
def update_tilt(row: Array, estimate: Estimate, disturbance_rad: float, time: float, t: Tuning, log: Array) -> None:
    """Update with the inclinometers' x and y components of up; two innovations."""
    h, matrix = np.empty(ERRORS), np.empty((3, 3))
    for i in range(2):
        matrix_of(estimate.state[QUATERNION:], matrix)
        h[:] = 0.0
        h[ATTITUDE_ERROR], h[ATTITUDE_ERROR + 1], h[TILT_BIAS + i] = matrix[1, i], -matrix[0, i], 1.0
        log[i, 0], log[i, 1], log[i, 2] = time, INCLINOMETER, i
        noise = math.hypot(t.tilt_noise_rad, disturbance_rad)
        update_scalar(estimate, h, row[UP + i] - matrix[2, i], noise, t.gate, log[i])


@njit(cache=True)
def update_heading(row: Array, estimate: Estimate, disturbance_rad: float, time: float, t: Tuning, log: Array) -> None:
    """Update with the compass; one innovation."""
    h, matrix = np.zeros(ERRORS), np.empty((3, 3))
    matrix_of(estimate.state[QUATERNION:], matrix)
    level = matrix[0, 0] ** 2 + matrix[1, 0] ** 2
    h[ATTITUDE_ERROR] = -matrix[2, 0] * matrix[0, 0] / level
    h[ATTITUDE_ERROR + 1] = -matrix[2, 0] * matrix[1, 0] / level
    h[ATTITUDE_ERROR + 2], h[HEADING_BIAS] = 1.0, 1.0
    log[0, 0], log[0, 1], log[0, 2] = time, COMPASS, 0
    off = row[YAW] - math.atan2(matrix[1, 0], matrix[0, 0])
    noise = math.hypot(t.heading_noise_rad, t.tan_dip * disturbance_rad)
    update_scalar(estimate, h, math.atan2(math.sin(off), math.cos(off)), noise, t.gate, log[0])


@njit(cache=True)
def _propagate(inputs: Inputs, k: int, states: Array, p: Array, memory: Array, t: Tuning) -> None:
    """Propagate state, covariance and filtered acceleration over the sample that ends at boundary k."""
    before, step, matrix = states[k - 1], inputs.step, np.empty((3, 3))
    matrix_of(before[QUATERNION:], matrix)
    gained = propagate_state(before, states[k], inputs.angles[k - 1], inputs.velocities[k - 1], t.gravity_m_s2, step)
    kept = t.wander_kept_fixed if memory[LAST_FIX] == 1.0 else t.wander_kept_floating
    propagate_covariance(p, matrix, gained, kept, t, step)
    for i in range(3):
        change = states[k, VELOCITY + i] - before[VELOCITY + i]
        filtered = memory[FILTERED_ACCELERATION + i]
        memory[FILTERED_ACCELERATION + i] += (change / step - filtered) * min(step / t.lag_s, 1.0)


@njit(cache=True)
def run(inputs: Inputs, start: Array, p: Array, memory: Array, t: Tuning) -> tuple[Array, Array, Array, Array]:
    """Run the filter; return states and deviations at all boundaries, stored covariances, and innovations.

    `memory` and `p` are updated in place. Readings tagged before the first boundary are ignored.
    """
    times, gps, tilts, kept_at = inputs.times, inputs.gps, inputs.tilts, inputs.kept_at
    states = np.empty((times.size, STATE))
    # position and velocity from the inertial unit alone, since the run's start
    inertial = np.zeros((times.size, 6))
    covariances, deviations = np.empty((kept_at.size, ESTIMATED, ESTIMATED)), np.empty((times.size, ESTIMATED))
    log = np.empty((6 * gps.shape[0] + 3 * tilts.shape[0], INNOVATION))
    logged = fix = tilt = kept = 0
    states[0] = start
    for k in range(times.size):
        state = states[k]
        estimate = Estimate(state, p)
        if k > 0:
            _propagate(inputs, k, states, p, memory, t)
            change = state[VELOCITY : VELOCITY + 3] - states[k - 1, VELOCITY : VELOCITY + 3]
            inertial[k, :3] = inertial[k - 1, :3] + (inertial[k - 1, 3:] + 0.5 * change) * inputs.step
            inertial[k, 3:] = inertial[k - 1, 3:] + change
        while fix < gps.shape[0] and gps[fix, ARRIVAL] <= times[k]:
            row = gps[fix]
            fix += 1
            if math.isnan(row[GPS_POSITION]) or row[TAG] < times[0]:
                continue
            if memory[LAST_FIX] != row[FIXED]:
                _reset_errors(p, POSITION_WANDER, 1.0, 0.0)
                memory[LAST_FIX] = row[FIXED]
            # the path since the solution's time, from the velocity as estimated now
            since = inertial[k] - _interpolate(times, inertial, k, row[TAG])
            since[:3] += (state[VELOCITY : VELOCITY + 3] - inertial[k, 3:]) * (times[k] - row[TAG])
            if memory[REJECTED] >= t.max_rejected_fixes:
                _restart(estimate, row, t)
            update_solution(row, estimate, since, times[k], t, log[logged : logged + 6])
            memory[REJECTED] = 0.0 if log[logged : logged + 6, 4].all() else memory[REJECTED] + 1.0
            logged += 6
        east, north = memory[FILTERED_ACCELERATION], memory[FILTERED_ACCELERATION + 1]
        level = math.sqrt(east**2 + north**2 + t.unmodelled_acceleration_m_s2**2)
        disturbance_rad = t.disturbance * level / t.gravity_m_s2
        while tilt < tilts.shape[0] and tilts[tilt, TAG] <= times[k]:
            row = tilts[tilt]
            tilt += 1
            if row[TAG] < times[0]:
                continue
            if not math.isnan(row[UP]):
                update_tilt(row, estimate, disturbance_rad, times[k], t, log[logged : logged + 2])
                logged += 2
            if not math.isnan(row[YAW]):
                update_heading(row, estimate, disturbance_rad, times[k], t, log[logged : logged + 1])
                logged += 1
        for i in range(ESTIMATED):
            deviations[k, i] = math.sqrt(p[i, i])
        while kept < kept_at.size and kept_at[kept] == k:
            covariances[kept] = p[:ESTIMATED, :ESTIMATED]
            kept += 1
    return states, covariances, deviations, log[:logged]
