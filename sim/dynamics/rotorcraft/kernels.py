"""Compiled flight of a small helicopter; `marsyard.sim.dynamics.rotorcraft.flight` states what is modelled.

A row is the state at a knot: position, velocity and acceleration, then angles (yaw, pitch, roll), their rates and
accelerations. Between knots accelerations are straight lines, so that rows are exact at every time: the motion is
defined by them, not approximated.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

PLACE, SPEED, PUSH, ANGLE, RATE, TWIST, SIZE = 0, 3, 6, 9, 12, 15, 18
#: What flies on beside a row: thrust per mass, then the trim against steady wind (east, north, up).
THRUST, TRIM, CARRIED = 0, 1, 4
#: Phases of a flight.
FOLLOW, WAIT, APPROACH, DESCEND, FLARE, REST = range(6)


class Craft(NamedTuple):
    """The helicopter and its autopilot: see `RotorcraftParameters`, in SI units."""

    gravity_m_s2: float
    drag_s: float
    attitude_rad_s: float
    attitude_damping: float
    heading_rad_s: float
    thrust_lag_s: float
    most_tilt_rad: float
    gust_tilt_s_m: float
    gust_yaw_s_m: float
    place_gain: float
    speed_gain: float
    trim_gain: float
    delay_steps: int
    gear_m: float
    contact_s: float


class Landing(NamedTuple):
    """What is commanded after the pictures: see `LandingGuidance`, in SI units."""

    site_east_m: float
    site_north_m: float
    hover_m: float
    wait_until: int
    approach_m_s: float
    near_m: float
    descent_m_s: float
    flare_range_m: float
    flare_m_s: float
    laser_scale: float
    laser_stuck_m: float


class Flight(NamedTuple):
    """A flight in progress: its rows, what is carried along, the yaw that is held, and the air at the knots.

    `rows` and `carried` are written; `gusts` has a row for each of `rows`.
    """

    rows: Array
    carried: Array
    heading: float
    wind: Array
    gusts: Array
    step: float


class Ground(NamedTuple):
    """Heights on a grid: bilinear within it, held beyond. Row i lies at north_m + i * spacing_m."""

    east_m: float
    north_m: float
    spacing_m: float
    heights: Array


@njit(cache=True)
def ground_height(ground: Ground, east: float, north: float) -> float:
    """Height of the ground at a place."""
    rows, columns = ground.heights.shape
    y = min(max((north - ground.north_m) / ground.spacing_m, 0.0), rows - 1.0)
    x = min(max((east - ground.east_m) / ground.spacing_m, 0.0), columns - 1.0)
    i = min(int(y), rows - 2)
    j = min(int(x), columns - 2)
    fy = y - i
    fx = x - j
    low = (1.0 - fx) * ground.heights[i, j] + fx * ground.heights[i, j + 1]
    high = (1.0 - fx) * ground.heights[i + 1, j] + fx * ground.heights[i + 1, j + 1]
    return float((1.0 - fy) * low + fy * high)


@njit(cache=True)
def laser_range(ground: Ground, row: Array) -> float:
    """Range along body -z to the ground, found in four steps: as exact as a beam near the vertical needs."""
    yaw, pitch, roll = row[ANGLE], row[ANGLE + 1], row[ANGLE + 2]
    cp, sp, cr, sr = math.cos(pitch), math.sin(pitch), math.cos(roll), math.sin(roll)
    forward = cr * sp
    left = -sr
    down = cr * cp
    east = -(math.cos(yaw) * forward - math.sin(yaw) * left)
    north = -(math.sin(yaw) * forward + math.cos(yaw) * left)
    distance = 0.0
    for _ in range(4):
        above = row[2] - ground_height(ground, row[0] + distance * east, row[1] + distance * north)
        distance = above / down
    return distance


@njit(cache=True)
def _limited(east: float, north: float, most: float) -> tuple[float, float]:
    size = math.hypot(east, north)
    if size <= most:
        return east, north
    return most * east / size, most * north / size


@njit(cache=True)
def _wanted(
    believed: Array, carried: Array, wanted_place: Array, wanted_speed: Array, wanted_push: Array, step: float, c: Craft
) -> tuple[float, float, float]:
    """Acceleration that the autopilot asks for (east, north, up); winds its trim on."""
    ask = np.empty(3)
    for i in range(3):
        off = wanted_speed[i] + c.place_gain * (wanted_place[i] - believed[i]) - believed[SPEED + i]
        carried[TRIM + i] += c.trim_gain * off * step
        ask[i] = wanted_push[i] + c.speed_gain * off + carried[TRIM + i]
    most = c.gravity_m_s2 * math.tan(c.most_tilt_rad)
    east, north = _limited(ask[0], ask[1], most)
    return east, north, min(max(ask[2], -0.4 * c.gravity_m_s2), 0.4 * c.gravity_m_s2)


@njit(cache=True)
def _advance(row: Array, after: Array, step: float) -> None:
    """Places and speeds at the next knot from accelerations at both."""
    for place, speed, push in ((PLACE, SPEED, PUSH), (ANGLE, RATE, TWIST)):
        for i in range(3):
            first, second = row[push + i], after[push + i]
            after[place + i] = row[place + i] + step * row[speed + i] + step * step * (2.0 * first + second) / 6.0
            after[speed + i] = row[speed + i] + 0.5 * step * (first + second)


@njit(cache=True)
def _fly(flight: Flight, k: int, tilt_error: Array, ask: tuple[float, float, float], c: Craft) -> None:
    """Write the row after row k: angles under the autopilot's command, then thrust along body z, drag and gravity."""
    row, after, gust = flight.rows[k], flight.rows[k + 1], flight.gusts[k + 1]
    carried, step, g = flight.carried, flight.step, c.gravity_m_s2
    believed = row[ANGLE] + tilt_error[0]
    cy, sy = math.cos(believed), math.sin(believed)
    pitch_ask = math.atan2(cy * ask[0] + sy * ask[1], g)
    roll_ask = -math.atan2((cy * ask[1] - sy * ask[0]) * math.cos(pitch_ask), g)
    thrust_ask = (g + ask[2]) / (math.cos(row[ANGLE + 1]) * math.cos(row[ANGLE + 2]))
    carried[THRUST] += (thrust_ask - carried[THRUST]) * min(step / c.thrust_lag_s, 1.0)

    cy, sy = math.cos(row[ANGLE]), math.sin(row[ANGLE])
    along = cy * gust[0] + sy * gust[1]
    across = cy * gust[1] - sy * gust[0]
    # the autopilot regulates what it believes; the gust tilts the rotor along itself and turns the nose into it
    aims = (
        flight.heading - tilt_error[0] - c.gust_yaw_s_m * across,
        pitch_ask - tilt_error[1] + c.gust_tilt_s_m * along,
        roll_ask - tilt_error[2] - c.gust_tilt_s_m * across,
    )
    for i in range(3):
        natural = c.heading_rad_s if i == 0 else c.attitude_rad_s
        angle = row[ANGLE + i] + step * row[RATE + i] + 0.5 * step * step * row[TWIST + i]
        rate = row[RATE + i] + step * row[TWIST + i]
        off = aims[i] - angle
        if i == 0:
            off = math.atan2(math.sin(off), math.cos(off))
        after[TWIST + i] = natural * natural * off - 2.0 * c.attitude_damping * natural * rate
        after[ANGLE + i] = angle
    yaw, pitch, roll = after[ANGLE], after[ANGLE + 1], after[ANGLE + 2]
    forward = math.cos(roll) * math.sin(pitch)
    left = -math.sin(roll)
    thrust = carried[THRUST]
    after[PUSH] = thrust * (math.cos(yaw) * forward - math.sin(yaw) * left)
    after[PUSH + 1] = thrust * (math.sin(yaw) * forward + math.cos(yaw) * left)
    after[PUSH + 2] = thrust * math.cos(roll) * math.cos(pitch) - g
    for i in range(3):
        speed = row[SPEED + i] + step * row[PUSH + i]
        after[PUSH + i] += (flight.wind[i] + gust[i] - speed) / c.drag_s
    _advance(row, after, step)


@njit(cache=True)
def _resting(row: Array, after: Array, step: float, c: Craft) -> None:
    """Writes the next row on the ground: what is left of motion and tilt dies away."""
    for i in range(3):
        after[PUSH + i] = -(row[SPEED + i] + step * row[PUSH + i]) / c.contact_s
        natural = 0.5 / c.contact_s
        angle = 0.0 if i == 0 else row[ANGLE + i] + step * row[RATE + i]
        after[TWIST + i] = -natural * natural * angle - 2.0 * natural * (row[RATE + i] + step * row[TWIST + i])
    _advance(row, after, step)


@njit(cache=True)
def follow(flight: Flight, path: Array, c: Craft) -> None:
    """Fill rows from the first along a path of rows (position, velocity, acceleration), on true states."""
    exact = np.zeros(3)
    for k in range(flight.rows.shape[0] - 1):
        seen = flight.rows[max(k - c.delay_steps, 0)]
        ask = _wanted(seen, flight.carried, path[k, 0:3], path[k, 3:6], path[k, 6:9], flight.step, c)
        _fly(flight, k, exact, ask, c)


@njit(cache=True)
def land(
    flight: Flight,
    phases: NDArray[np.int64],
    start: int,
    errors: Array,
    laser_noise: Array,
    ground: Ground,
    landing: Landing,
    c: Craft,
) -> None:
    """Fill rows and phases after `start`, guided by the believed state.

    Rows of `errors` are believed less true position, velocity and angles (yaw, pitch, roll).
    """
    rows = flight.rows
    goal = np.empty(3)
    speed = np.zeros(3)
    none = np.zeros(3)
    believed = np.empty(PUSH)
    phase = WAIT
    for k in range(start, rows.shape[0] - 1):
        seen = max(k - c.delay_steps, 0)
        for i in range(PUSH):
            believed[i] = rows[seen, i] + errors[seen, i]
        if phase == REST:
            phases[k + 1] = REST
            _resting(rows[k], rows[k + 1], flight.step, c)
            continue
        if phase == WAIT and k >= landing.wait_until:
            phase = APPROACH
        off_east, off_north = landing.site_east_m - believed[0], landing.site_north_m - believed[1]
        if phase == APPROACH and math.hypot(off_east, off_north) < landing.near_m:
            phase = DESCEND
        if phase == DESCEND:
            reading = landing.laser_scale * laser_range(ground, rows[seen]) + laser_noise[seen]
            if not math.isnan(landing.laser_stuck_m):
                reading = landing.laser_stuck_m
            if reading < landing.flare_range_m:
                phase = FLARE
        # waiting, and when it lands, it comes to rest where it is; else a place to go to, no faster than commanded
        goal[2] = landing.hover_m
        speed[2] = 0.0
        if phase in (WAIT, FLARE):
            goal[0], goal[1] = believed[0], believed[1]
        else:
            east, north = _limited(off_east, off_north, landing.approach_m_s / c.place_gain)
            goal[0], goal[1] = believed[0] + east, believed[1] + north
        if phase >= DESCEND:
            speed[2] = -landing.descent_m_s if phase == DESCEND else -landing.flare_m_s
            goal[2] = believed[2]
        ask = _wanted(believed, flight.carried, goal, speed, none, flight.step, c)
        _fly(flight, k, errors[k, PUSH:], ask, c)
        after = rows[k + 1]
        if phase != WAIT and after[2] - c.gear_m <= ground_height(ground, after[0], after[1]):
            phase = REST
        phases[k + 1] = phase
