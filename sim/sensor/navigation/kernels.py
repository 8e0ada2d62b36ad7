"""Compiled error-state Kalman filter; `marsyard.sim.sensor.navigation.filter` tells what is estimated and from what.

A state is a row of 16: position, velocity, quaternion (x, y, z, w; world from body), gyro bias, accelerometer bias. An
error is true less believed, and for the attitude the small rotation about world axes that the believed one lacks. The
covariance has 15 errors that are estimated, then nine that are only considered: what wanders in the receiver's
positions (in units of its standard deviation) and velocities, the compass's bias and the two inclinometers'.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

PLACE, SPEED, TURN, GYRO, FORCE = 0, 3, 6, 9, 12
ESTIMATED = 15
WANDER, DRIFT, HEADING, TILT = 15, 18, 21, 22
ERRORS = 24
QUATERNION, GYRO_BIAS, FORCE_BIAS, STATE = 6, 10, 13, 16
#: Columns of a receiver's row.
TAG, ARRIVAL, AT, GOING, WANDERS, NOISE, FIXED, GPS_COLUMNS = 0, 1, 2, 5, 8, 11, 14, 15
#: Columns of a compass's row; azimuths are made yaw.
UP, YAW, TILT_COLUMNS = 1, 4, 5
#: What an innovation is of.
GPS_PLACE, GPS_SPEED, COMPASS, INCLINOMETER = range(4)
#: What goes on between runs: whether the receiver's last solution was fixed (-1: none yet), the lagging acceleration,
#: world axes, and how many solutions in a row were refused.
FIX, PUSHED, REFUSED, FLAGS = 0, 1, 4, 5
#: Columns of an innovation: time, what of, axis, normalised by its standard deviation, whether it was used.
INNOVATION = 5


class Tuning(NamedTuple):
    """What the filter takes for granted, SI units: see `FilterParameters`."""

    gravity_m_s2: float
    turn_density: float
    force_density: float
    gyro_density: float
    bias_density: float
    wander_kept_fixed: float
    wander_kept_floating: float
    drift_m_s: tuple[float, float, float]
    drift_kept: float
    speed_noise_m_s: tuple[float, float, float]
    tilt_noise_rad: float
    heading_noise_rad: float
    tan_dip: float
    lag_s: float
    disturbance: float
    unseen_m_s2: float
    gate: float
    most_refused: int
    first_place_m: float
    first_speed_m_s: float
    first_tilt_rad: float


@njit(cache=True)
def matrix_of(q: Array, matrix: Array) -> None:
    """Writes the rotation matrix of a quaternion."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    matrix[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    matrix[0, 1] = 2.0 * (x * y - z * w)
    matrix[0, 2] = 2.0 * (x * z + y * w)
    matrix[1, 0] = 2.0 * (x * y + z * w)
    matrix[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    matrix[1, 2] = 2.0 * (y * z - x * w)
    matrix[2, 0] = 2.0 * (x * z - y * w)
    matrix[2, 1] = 2.0 * (y * z + x * w)
    matrix[2, 2] = 1.0 - 2.0 * (x * x + y * y)


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
def _moved_on(
    state: Array, after: Array, matrix: Array, angle: Array, velocity: Array, gravity: float, step: float, gained: Array
) -> None:
    """Writes the state a step later, and the velocity gained without gravity, world axes."""
    turn = np.empty(3)
    for i in range(3):
        gained[i] = 0.0
        turn[i] = angle[i] - state[GYRO_BIAS + i] * step
        for j in range(3):
            gained[i] += matrix[i, j] * (velocity[j] - state[FORCE_BIAS + j] * step)
    for i in range(3):
        change = gained[i] - (gravity * step if i == 2 else 0.0)
        after[PLACE + i] = state[PLACE + i] + (state[SPEED + i] + 0.5 * change) * step
        after[SPEED + i] = state[SPEED + i] + change
        after[GYRO_BIAS + i] = state[GYRO_BIAS + i]
        after[FORCE_BIAS + i] = state[FORCE_BIAS + i]
    q = state[QUATERNION : QUATERNION + 4]
    _product((q[0], q[1], q[2], q[3]), _quaternion_of(turn), after[QUATERNION : QUATERNION + 4])


@njit(cache=True)
def _carried_on(m: Array, matrix: Array, force: Array, kept: float, drift_kept: float, step: float) -> None:
    """Multiplies a matrix of columns of errors by how errors go on within a step."""
    velocity, turn = np.empty(3), np.empty(3)
    for j in range(ERRORS):
        for i in range(3):
            velocity[i] = turn[i] = 0.0
            for k in range(3):
                velocity[i] += force[i, k] * m[TURN + k, j] - step * matrix[i, k] * m[FORCE + k, j]
                turn[i] += matrix[i, k] * m[GYRO + k, j]
        for i in range(3):
            m[PLACE + i, j] += step * (m[SPEED + i, j] + 0.5 * velocity[i])
            m[SPEED + i, j] += velocity[i]
            m[TURN + i, j] -= step * turn[i]
            m[WANDER + i, j] *= kept
            m[DRIFT + i, j] *= drift_kept


@njit(cache=True)
def _spread(p: Array, matrix: Array, gained: Array, kept: float, t: Tuning, step: float) -> None:
    """The covariance a step later: F P F' + Q, F applied to rows and then to columns."""
    force = np.zeros((3, 3))
    force[0, 1], force[0, 2], force[1, 2] = gained[2], -gained[1], gained[0]
    force[1, 0], force[2, 0], force[2, 1] = -gained[2], gained[1], -gained[0]
    _carried_on(p, matrix, force, kept, t.drift_kept, step)
    _carried_on(p.T, matrix, force, kept, t.drift_kept, step)
    for i in range(3):
        p[SPEED + i, SPEED + i] += t.force_density**2 * step
        p[TURN + i, TURN + i] += t.turn_density**2 * step
        p[GYRO + i, GYRO + i] += t.gyro_density**2 * step
        p[FORCE + i, FORCE + i] += t.bias_density**2 * step
        p[WANDER + i, WANDER + i] += 1.0 - kept * kept
        p[DRIFT + i, DRIFT + i] += t.drift_m_s[i] ** 2 * (1.0 - t.drift_kept**2)


@njit(cache=True)
def _update(state: Array, p: Array, h: Array, innovation: float, noise: float, gate: float) -> tuple[float, bool]:
    """Takes in a scalar; gains of what is considered are zero (Schmidt 1966). Normalised innovation; if it passed."""
    ph = np.zeros(ERRORS)
    for j in range(ERRORS):
        if h[j] != 0.0:
            for i in range(ERRORS):
                ph[i] += p[i, j] * h[j]
    variance = noise * noise
    for i in range(ERRORS):
        variance += h[i] * ph[i]
    normalised = innovation / math.sqrt(variance)
    if not abs(normalised) < gate:
        return normalised, False
    # P - K h'P - P h K' + K s K', with K zero for what is considered
    for i in range(ERRORS):
        gain_i = ph[i] / variance if i < ESTIMATED else 0.0
        for j in range(ERRORS):
            gain_j = ph[j] / variance if j < ESTIMATED else 0.0
            p[i, j] += -gain_i * ph[j] - ph[i] * gain_j + gain_i * variance * gain_j
    correction = ph[:ESTIMATED] * (innovation / variance)
    for i in range(3):
        state[PLACE + i] += correction[PLACE + i]
        state[SPEED + i] += correction[SPEED + i]
        state[GYRO_BIAS + i] += correction[GYRO + i]
        state[FORCE_BIAS + i] += correction[FORCE + i]
    q = state[QUATERNION : QUATERNION + 4]
    _product(_quaternion_of(correction[TURN : TURN + 3]), (q[0], q[1], q[2], q[3]), q)
    return normalised, True


@njit(cache=True)
def _take_in(
    state: Array,
    p: Array,
    h: Array,
    off: float,
    noise: float,
    gate: float,
    log: Array,
    time: float,
    kind: int,
    axis: int,
) -> None:
    """One scalar measurement, written into a row of the innovations."""
    normalised, used = _update(state, p, h, off, noise, gate)
    log[0], log[1], log[2], log[3] = time, kind, axis, normalised
    log[4] = 1.0 if used else 0.0


@njit(cache=True)
def _between(times: Array, values: Array, until: int, time: float, out: Array) -> None:
    """Writes values at a time among the rows up to `until`, on straight lines."""
    k = until
    while k > 0 and times[k] > time:
        k -= 1
    after = min(k + 1, until)
    span = times[after] - times[k]
    share = 0.0 if span <= 0.0 else min(max((time - times[k]) / span, 0.0), 1.0)
    for i in range(out.size):
        out[i] = values[k, i] + share * (values[after, i] - values[k, i])


@njit(cache=True)
def _reset_wander(p: Array) -> None:
    for i in range(3):
        p[WANDER + i, :] = 0.0
        p[:, WANDER + i] = 0.0
        p[WANDER + i, WANDER + i] = 1.0


@njit(cache=True)
def _start_anew(state: Array, p: Array, row: Array, t: Tuning) -> None:
    """Puts place and speed where a solution has them and trusts neither them nor the tilt any longer."""
    for i in range(3):
        state[PLACE + i], state[SPEED + i] = row[AT + i], row[GOING + i]
        for at, size in ((PLACE, t.first_place_m), (SPEED, t.first_speed_m_s), (TURN, t.first_tilt_rad)):
            kept = p[at + i, at + i] if at == TURN else 0.0
            p[at + i, :] = 0.0
            p[:, at + i] = 0.0
            p[at + i, at + i] = kept + size * size


@njit(cache=True)
def _take_solution(row: Array, state: Array, p: Array, since: Array, time: float, t: Tuning, log: Array) -> None:
    """A receiver's solution, carried to now by the way and the velocity since its time; six innovations."""
    h = np.empty(ERRORS)
    for i in range(3):
        h[:] = 0.0
        h[PLACE + i], h[SPEED + i], h[WANDER + i] = 1.0, row[TAG] - time, row[WANDERS + i]
        off = row[AT + i] + since[i] - state[PLACE + i]
        _take_in(state, p, h, off, row[NOISE + i], t.gate, log[i], time, GPS_PLACE, i)
    for i in range(3):
        h[:] = 0.0
        h[SPEED + i], h[DRIFT + i] = 1.0, 1.0
        off = row[GOING + i] + since[3 + i] - state[SPEED + i]
        _take_in(state, p, h, off, t.speed_noise_m_s[i], t.gate, log[3 + i], time, GPS_SPEED, i)


@njit(cache=True)
def _take_up(row: Array, state: Array, p: Array, lean: float, time: float, t: Tuning, log: Array) -> None:
    """What the inclinometers say of the x and y components of up; two innovations."""
    h, matrix = np.empty(ERRORS), np.empty((3, 3))
    for i in range(2):
        matrix_of(state[QUATERNION:], matrix)
        h[:] = 0.0
        h[TURN], h[TURN + 1], h[TILT + i] = matrix[1, i], -matrix[0, i], 1.0
        noise = math.hypot(t.tilt_noise_rad, lean)
        _take_in(state, p, h, row[UP + i] - matrix[2, i], noise, t.gate, log[i], time, INCLINOMETER, i)


@njit(cache=True)
def _take_yaw(row: Array, state: Array, p: Array, lean: float, time: float, t: Tuning, log: Array) -> None:
    """What the compass says; one innovation."""
    h, matrix = np.zeros(ERRORS), np.empty((3, 3))
    matrix_of(state[QUATERNION:], matrix)
    level = matrix[0, 0] ** 2 + matrix[1, 0] ** 2
    h[TURN] = -matrix[2, 0] * matrix[0, 0] / level
    h[TURN + 1] = -matrix[2, 0] * matrix[1, 0] / level
    h[TURN + 2], h[HEADING] = 1.0, 1.0
    off = row[YAW] - math.atan2(matrix[1, 0], matrix[0, 0])
    noise = math.hypot(t.heading_noise_rad, t.tan_dip * lean)
    _take_in(state, p, h, math.atan2(math.sin(off), math.cos(off)), noise, t.gate, log[0], time, COMPASS, 0)


@njit(cache=True)
def run(
    times: Array,
    step: float,
    angles: Array,
    velocities: Array,
    gps: Array,
    tilts: Array,
    start: Array,
    p: Array,
    flags: Array,
    kept_at: NDArray[np.int64],
    t: Tuning,
) -> tuple[Array, Array, Array, Array]:
    """States at all boundaries, covariances at some, the deviations of all, and innovations.

    `flags` and `p` are left as they end. Readings tagged before the first boundary are left out.
    """
    count = times.size
    states = np.empty((count, STATE))
    inertial = np.zeros((count, 6))
    covariances = np.empty((kept_at.size, ESTIMATED, ESTIMATED))
    deviations = np.empty((count, ESTIMATED))
    log = np.empty((6 * gps.shape[0] + 3 * tilts.shape[0], INNOVATION))
    matrix, gained, since = np.empty((3, 3)), np.empty(3), np.empty(6)
    said = fix = tilt = kept = 0
    states[0] = start
    for k in range(count):
        state = states[k]
        if k > 0:
            before = states[k - 1]
            matrix_of(before[QUATERNION:], matrix)
            _moved_on(before, state, matrix, angles[k - 1], velocities[k - 1], t.gravity_m_s2, step, gained)
            _spread(p, matrix, gained, t.wander_kept_fixed if flags[FIX] == 1.0 else t.wander_kept_floating, t, step)
            for i in range(3):
                change = state[SPEED + i] - before[SPEED + i]
                flags[PUSHED + i] += (change / step - flags[PUSHED + i]) * min(step / t.lag_s, 1.0)
                inertial[k, i] = inertial[k - 1, i] + (inertial[k - 1, 3 + i] + 0.5 * change) * step
                inertial[k, 3 + i] = inertial[k - 1, 3 + i] + change
        while fix < gps.shape[0] and gps[fix, ARRIVAL] <= times[k]:
            row = gps[fix]
            fix += 1
            if math.isnan(row[AT]) or row[TAG] < times[0]:
                continue
            if flags[FIX] != row[FIXED]:
                _reset_wander(p)
                flags[FIX] = row[FIXED]
            _between(times, inertial, k, row[TAG], since)
            for i in range(3):
                # the way since then, from the velocity as it is believed now, back through what was gained
                back = (state[SPEED + i] - inertial[k, 3 + i]) * (times[k] - row[TAG])
                since[i] = inertial[k, i] - since[i] + back
                since[3 + i] = inertial[k, 3 + i] - since[3 + i]
            if flags[REFUSED] >= t.most_refused:
                _start_anew(state, p, row, t)
            _take_solution(row, state, p, since, times[k], t, log[said : said + 6])
            flags[REFUSED] = 0.0 if log[said : said + 6, 4].all() else flags[REFUSED] + 1.0
            said += 6
        pushed = math.sqrt(flags[PUSHED] ** 2 + flags[PUSHED + 1] ** 2 + t.unseen_m_s2**2)
        lean = t.disturbance * pushed / t.gravity_m_s2
        while tilt < tilts.shape[0] and tilts[tilt, TAG] <= times[k]:
            row = tilts[tilt]
            tilt += 1
            if row[TAG] < times[0]:
                continue
            if not math.isnan(row[UP]):
                _take_up(row, state, p, lean, times[k], t, log[said : said + 2])
                said += 2
            if not math.isnan(row[YAW]):
                _take_yaw(row, state, p, lean, times[k], t, log[said : said + 1])
                said += 1
        for i in range(ESTIMATED):
            deviations[k, i] = math.sqrt(p[i, i])
        while kept < kept_at.size and kept_at[kept] == k:
            covariances[kept] = p[:ESTIMATED, :ESTIMATED]
            kept += 1
    return states, covariances, deviations, log[:said]
