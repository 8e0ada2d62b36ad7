"""Compiled flight dynamics of a small helicopter; `marsyard.sim.dynamics.rotorcraft` describes the model.

A row is the state at a knot, a time step of the simulation: position, velocity and acceleration, then angles (yaw,
pitch, roll), their rates and accelerations. Accelerations are linear between knots, which defines the motion exactly.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: First column of each vector in a row, and the number of columns.
POSITION, VELOCITY, ACCELERATION, ANGLE, RATE, ANGULAR_ACCELERATION, SIZE = 0, 3, 6, 9, 12, 15, 18
#: State of the autopilot: thrust per mass, then the trim against steady wind (east, north, up).
THRUST, TRIM, AUTOPILOT_SIZE = 0, 1, 4
#: Maximum commanded vertical acceleration, in units of gravity.
MAX_VERTICAL_G = 0.4
#: Phases of a flight: along the path with images, hovering until the site is known, approach to the site at constant
#: height, descent, slow descent near the ground, and on the ground.
FOLLOW, WAIT, APPROACH, DESCEND, FLARE, REST = range(6)


class Craft(NamedTuple):
    """Constants of the helicopter and its autopilot: `RotorcraftParameters` in SI units.

    - drag_s: time constant of the decay of airspeed by drag
    - attitude_rad_s, heading_rad_s: natural frequencies of pitch and roll, and of yaw
    - attitude_damping: damping ratio of the angles
    - thrust_lag_s: time constant of the thrust
    - gust_tilt_s_m, gust_yaw_s_m: tilt along a gust and yaw into it, radians per m/s
    - position_gain: commanded speed per distance
    - speed_gain, trim_gain: commanded acceleration, and rate of change of the trim, per speed error
    - delay_steps: delay of the autopilot's command, time steps
    - gear_m: height of the camera above the skids
    - contact_s: time constant of the motion on the ground
    """

    gravity_m_s2: float
    drag_s: float
    attitude_rad_s: float
    attitude_damping: float
    heading_rad_s: float
    thrust_lag_s: float
    max_tilt_rad: float
    gust_tilt_s_m: float
    gust_yaw_s_m: float
    position_gain: float
    speed_gain: float
    trim_gain: float
    delay_steps: int
    gear_m: float
    contact_s: float


class Landing(NamedTuple):
    """Constants of the landing: `LandingGuidance`, the site in navigation's coordinates, and the laser altimeter.

    - hover_m: height of the hover and of the approach
    - wait_until: row at which the approach begins
    - approach_m_s: maximum commanded horizontal speed
    - near_m: horizontal distance from the site at which the descent begins
    - descent_m_s, flare_m_s: commanded sink rates of descent and flare
    - flare_range_m: laser range at which the flare begins
    - laser_scale, laser_stuck_m: factor of the laser's range; constant reading of a stuck laser, NaN if it works
    - laser_count_m: resolution of a reading, 0 without rounding
    - laser_min_m, laser_max_m: limits of the true range; there is no return beyond them
    - laser_x, laser_y, laser_z: direction of the laser in body axes
    """

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
    laser_count_m: float
    laser_min_m: float
    laser_max_m: float
    laser_x: float
    laser_y: float
    laser_z: float


class Flight(NamedTuple):
    """A simulated flight.

    - rows, autopilot: states at the knots, and state of the autopilot; the functions update both
    - heading: commanded yaw, radians
    - wind, gusts: mean wind (east, north, up), and its deviation at each row, m/s
    - step: time between knots, s
    """

    rows: Array
    autopilot: Array
    heading: float
    wind: Array
    gusts: Array
    step: float


class GroundPatch(NamedTuple):
    """Heights of the ground around a site on a grid, bilinear within it and constant beyond its edges, metres.

    Row i is at north_m + i * spacing_m, column j at east_m + j * spacing_m.
    """

    east_m: float
    north_m: float
    spacing_m: float
    heights_m: Array


@njit(cache=True)
def compute_ground_height(ground: GroundPatch, east: float, north: float) -> float:
    """Interpolate the height of the ground at a position."""
    rows, columns = ground.heights_m.shape
    y = min(max((north - ground.north_m) / ground.spacing_m, 0.0), rows - 1.0)
    x = min(max((east - ground.east_m) / ground.spacing_m, 0.0), columns - 1.0)
    i = min(int(y), rows - 2)
    j = min(int(x), columns - 2)
    fy = y - i
    fx = x - j
    south_edge = (1.0 - fx) * ground.heights_m[i, j] + fx * ground.heights_m[i, j + 1]
    north_edge = (1.0 - fx) * ground.heights_m[i + 1, j] + fx * ground.heights_m[i + 1, j + 1]
    return float((1.0 - fy) * south_edge + fy * north_edge)


@njit(cache=True)
def compute_laser_range(ground: GroundPatch, row: Array, axis_x: float, axis_y: float, axis_z: float) -> float:
    """Compute the range to the ground along an axis of the body.

    The beam is nearly vertical: four fixed-point steps converge.
    """
    yaw, pitch, roll = row[ANGLE], row[ANGLE + 1], row[ANGLE + 2]
    cp, sp, cr, sr = math.cos(pitch), math.sin(pitch), math.cos(roll), math.sin(roll)
    left = cr * axis_y - sr * axis_z
    up = sr * axis_y + cr * axis_z
    forward = cp * axis_x + sp * up
    down = sp * axis_x - cp * up
    east = math.cos(yaw) * forward - math.sin(yaw) * left
    north = math.sin(yaw) * forward + math.cos(yaw) * left
    distance = 0.0
    for _ in range(4):
        x, y = row[POSITION] + distance * east, row[POSITION + 1] + distance * north
        height = row[POSITION + 2] - compute_ground_height(ground, x, y)
        distance = height / down
    return distance


@njit(cache=True)
def _read_laser(ground: GroundPatch, row: Array, noise: float, landing: Landing) -> float:
    """Simulate a reading of the laser, metres; infinite without a return."""
    if not math.isnan(landing.laser_stuck_m):
        return landing.laser_stuck_m
    distance: float = compute_laser_range(ground, row, landing.laser_x, landing.laser_y, landing.laser_z)
    if distance < landing.laser_min_m or distance > landing.laser_max_m:
        return math.inf
    reading = landing.laser_scale * distance + noise
    if landing.laser_count_m > 0.0:
        reading = landing.laser_count_m * round(reading / landing.laser_count_m)
    return reading


@njit(cache=True)
def _limit_length(east: float, north: float, limit: float) -> tuple[float, float]:
    """Shorten a horizontal vector to at most `limit`."""
    length = math.hypot(east, north)
    return (east, north) if length <= limit else (limit * east / length, limit * north / length)


@njit(cache=True)
def _command_acceleration(
    state: Array, autopilot: Array, goal: Array, velocity: Array, acceleration: Array, step: float, craft: Craft
) -> tuple[float, float, float]:
    """Compute the acceleration that the autopilot commands (east, north, up), and update the autopilot's trim.

    `goal`, `velocity` and `acceleration` are the desired position, velocity and acceleration.
    """
    error = velocity + craft.position_gain * (goal - state[:VELOCITY]) - state[VELOCITY:ACCELERATION]
    autopilot[TRIM:] += craft.trim_gain * error * step
    command = acceleration + craft.speed_gain * error + autopilot[TRIM:]
    limit = craft.gravity_m_s2 * math.tan(craft.max_tilt_rad)
    east, north = _limit_length(command[0], command[1], limit)
    return east, north, min(max(command[2], -MAX_VERTICAL_G * craft.gravity_m_s2), MAX_VERTICAL_G * craft.gravity_m_s2)


@njit(cache=True)
def _integrate(row: Array, after: Array, step: float) -> None:
    """Compute positions, angles and their rates at the next knot from the accelerations at both knots."""
    for value, rate, acceleration in ((POSITION, VELOCITY, ACCELERATION), (ANGLE, RATE, ANGULAR_ACCELERATION)):
        for i in range(3):
            first, second = row[acceleration + i], after[acceleration + i]
            after[value + i] = row[value + i] + step * row[rate + i] + step * step * (2.0 * first + second) / 6.0
            after[rate + i] = row[rate + i] + 0.5 * step * (first + second)


@njit(cache=True)
def _step_flight(
    flight: Flight, k: int, angle_errors: Array, command: tuple[float, float, float], craft: Craft
) -> None:
    """Compute the row after row k: angles from the commands; accelerations from thrust (body z), drag and gravity.

    - angle_errors: estimated minus true yaw, pitch and roll
    - command: acceleration to the east, north and up
    """
    row, after, gust = flight.rows[k], flight.rows[k + 1], flight.gusts[k + 1]
    autopilot, step, g = flight.autopilot, flight.step, craft.gravity_m_s2
    yaw_estimate = row[ANGLE] + angle_errors[0]
    cy, sy = math.cos(yaw_estimate), math.sin(yaw_estimate)
    pitch_command = math.atan2(cy * command[0] + sy * command[1], g)
    roll_command = -math.atan2((cy * command[1] - sy * command[0]) * math.cos(pitch_command), g)
    thrust_command = (g + command[2]) / (math.cos(row[ANGLE + 1]) * math.cos(row[ANGLE + 2]))
    autopilot[THRUST] += (thrust_command - autopilot[THRUST]) * min(step / craft.thrust_lag_s, 1.0)

    cy, sy = math.cos(row[ANGLE]), math.sin(row[ANGLE])
    gust_forward = cy * gust[0] + sy * gust[1]
    gust_left = cy * gust[1] - sy * gust[0]
    # the autopilot controls the estimated angles; a gust tilts the rotor along its direction and turns the nose into it
    targets = (
        flight.heading - angle_errors[0] - craft.gust_yaw_s_m * gust_left,
        pitch_command - angle_errors[1] + craft.gust_tilt_s_m * gust_forward,
        roll_command - angle_errors[2] - craft.gust_tilt_s_m * gust_left,
    )
    for i in range(3):
        natural_frequency = craft.heading_rad_s if i == 0 else craft.attitude_rad_s
        angle = row[ANGLE + i] + step * row[RATE + i] + 0.5 * step * step * row[ANGULAR_ACCELERATION + i]
        rate = row[RATE + i] + step * row[ANGULAR_ACCELERATION + i]
        error = targets[i] - angle
        if i == 0:
            error = math.atan2(math.sin(error), math.cos(error))
        after[ANGULAR_ACCELERATION + i] = (
            natural_frequency * natural_frequency * error - 2.0 * craft.attitude_damping * natural_frequency * rate
        )
        after[ANGLE + i] = angle
    yaw, pitch, roll = after[ANGLE], after[ANGLE + 1], after[ANGLE + 2]
    forward = math.cos(roll) * math.sin(pitch)
    left = -math.sin(roll)
    thrust = autopilot[THRUST]
    after[ACCELERATION] = thrust * (math.cos(yaw) * forward - math.sin(yaw) * left)
    after[ACCELERATION + 1] = thrust * (math.sin(yaw) * forward + math.cos(yaw) * left)
    after[ACCELERATION + 2] = thrust * math.cos(roll) * math.cos(pitch) - g
    velocity = row[VELOCITY:ACCELERATION] + step * row[ACCELERATION:ANGLE]
    after[ACCELERATION:ANGLE] += (flight.wind + gust - velocity) / craft.drag_s
    _integrate(row, after, step)


@njit(cache=True)
def _step_on_ground(row: Array, after: Array, step: float, craft: Craft) -> None:
    """Compute the next row on the ground: velocity and yaw rate decay with the time constant `contact_s`.

    Pitch and roll decay to zero, critically damped with the natural frequency 0.5 / `contact_s`.
    """
    for i in range(3):
        after[ACCELERATION + i] = -(row[VELOCITY + i] + step * row[ACCELERATION + i]) / craft.contact_s
        natural_frequency = 0.5 / craft.contact_s
        angle = 0.0 if i == 0 else row[ANGLE + i] + step * row[RATE + i]
        rate = row[RATE + i] + step * row[ANGULAR_ACCELERATION + i]
        after[ANGULAR_ACCELERATION + i] = (
            -natural_frequency * natural_frequency * angle - 2.0 * natural_frequency * rate
        )
    _integrate(row, after, step)


@njit(cache=True)
def follow_path(flight: Flight, path: Array, craft: Craft) -> None:
    """Simulate a flight along a path, controlled by true states.

    A row of `path` is the commanded position, velocity and acceleration at a knot, as in a row of the flight.
    """
    no_error = np.zeros(3)
    for k in range(flight.rows.shape[0] - 1):
        delayed = flight.rows[max(k - craft.delay_steps, 0)]
        position, velocity, acceleration = path[k, :VELOCITY], path[k, VELOCITY:ACCELERATION], path[k, ACCELERATION:]
        command = _command_acceleration(delayed, flight.autopilot, position, velocity, acceleration, flight.step, craft)
        _step_flight(flight, k, no_error, command, craft)


@njit(cache=True)
def land(
    flight: Flight,
    phases: NDArray[np.int64],
    start: int,
    errors: Array,
    laser_noise: Array,
    ground: GroundPatch,
    landing: Landing,
    craft: Craft,
) -> None:
    """Simulate a landing from row `start` on, controlled by estimated states; updates rows and phases.

    - errors: estimated minus true position, velocity and angles (yaw, pitch, roll) of each knot
    - laser_noise: noise of the laser's range of each knot, metres
    """
    rows = flight.rows
    goal = np.empty(3)
    velocity = np.zeros(3)
    zero = np.zeros(3)
    phase = WAIT
    for k in range(start, rows.shape[0] - 1):
        delayed = max(k - craft.delay_steps, 0)
        estimate = rows[delayed, :ACCELERATION] + errors[delayed, :ACCELERATION]
        if phase == REST:
            phases[k + 1] = REST
            _step_on_ground(rows[k], rows[k + 1], flight.step, craft)
            continue
        if phase == WAIT and k >= landing.wait_until:
            phase = APPROACH
        to_site_east, to_site_north = landing.site_east_m - estimate[0], landing.site_north_m - estimate[1]
        if phase == APPROACH and math.hypot(to_site_east, to_site_north) < landing.near_m:
            phase = DESCEND
        if phase == DESCEND:
            reading = _read_laser(ground, rows[delayed], laser_noise[delayed], landing)
            if reading < landing.flare_range_m:
                phase = FLARE
        # goal: the current position in WAIT and FLARE, otherwise a point towards the site, limited by the speed
        goal[2] = landing.hover_m
        velocity[2] = 0.0
        if phase in (WAIT, FLARE):
            goal[0], goal[1] = estimate[0], estimate[1]
        else:
            east, north = _limit_length(to_site_east, to_site_north, landing.approach_m_s / craft.position_gain)
            goal[0], goal[1] = estimate[0] + east, estimate[1] + north
        if phase >= DESCEND:
            velocity[2] = -landing.descent_m_s if phase == DESCEND else -landing.flare_m_s
            goal[2] = estimate[2]
        command = _command_acceleration(estimate, flight.autopilot, goal, velocity, zero, flight.step, craft)
        _step_flight(flight, k, errors[k, ACCELERATION:], command, craft)
        east, north, up = rows[k + 1, :VELOCITY]
        if phase != WAIT and up - craft.gear_m <= compute_ground_height(ground, east, north):
            phase = REST
        phases[k + 1] = phase
