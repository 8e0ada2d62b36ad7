"""True motion of a lander between heat shield and sky crane: parachute descent, then powered descent by guidance.

The parachute descent is that of `marsyard.sim.dynamics.swing`. At the altitude of backshell separation the body's
origin has the position p, the velocity v, the acceleration a and the jerk j, and the body has an attitude R (body to
world) and a rate w (body axes). Thrusters follow the acceleration command c with the lag of a critically damped second
order system of the natural frequency W, so that acceleration and jerk are continuous at separation:

    p' = v,   v' = a,   a' = j,   j' = W^2 (c - a) - 2 W j                                                      (1)
    c = (1 - s) g + s (k (v_target - v), limited horizontally and vertically)                                   (2)
    R' = R [w]x,   w' = K_w (limit(K_R log(R^T R_c)) - w)                                                       (3)

g is the gravity vector: the lander falls freely until the thrusters start, and s(t) rises smoothly from 0 to 1. The
limit is x tanh(|x| / m) / (|x| / m). R_c is the heading at separation, with body z tilted along the thrust of a lander
of constant speed, (a_x, a_y, |g|). A small oscillation of each body axis, the limit cycle of the attitude control, is
added to R.

The flight is a spline through dense poses (`RecordedMotion`). Velocity, body rate and specific force are therefore its
exact derivatives, also across the separation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from CyRK import pysolve_ivp
from jaxtyping import Float64
from pydantic import Field, model_validator
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from marsyard.sim.dynamics.pendulum import SwingParameters
from marsyard.sim.dynamics.recorded import RecordedMotion
from marsyard.sim.dynamics.swing import SwingDescent
from marsyard.sim.dynamics.trajectory import Motion, Trajectory
from marsyard.sim.parameters import Parameters, bounded_field

Vector = Float64[np.ndarray, "3"]
Quaternion = Float64[np.ndarray, "4"]  #: In the order x, y, z, w.

#: Time between the poses of the spline, s: the splined parachute descent deviates by less than 1e-8 m and 1e-5 m/s.
KNOT_STEP_S = 0.01
#: Duration of the flight before the start at time 0, s.
LEAD_S = 2.0
#: Altitude below the end to which the motion continues, m: about two seconds.
BELOW_END_M = 100.0
#: Relative and absolute tolerance of the integration of the powered descent.
TOLERANCE = 1e-9
#: Half of the time step of the difference quotient that determines the jerk at separation, s.
_JERK_STEP_S = 1e-3
#: Periods of the limit cycle about the body's x, y and z axis / `limit_cycle_s`: incommensurable (assumed).
_CYCLE_RATIOS = np.array([1.0, 1.13, 1.47])
#: Limit of the powered descent's duration: descent from separation at this fraction of the final speed.
_MIN_SPEED_FRACTION = 0.5
_UP = np.array([0.0, 0.0, 1.0])
#: Signs of the conjugate of a quaternion.
_CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])
#: Elements of the integrated state of the powered descent.
_POSITION, _VELOCITY, _ACCELERATION, _JERK = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
_ATTITUDE, _BODY_RATE = slice(12, 16), slice(16, 19)
#: Upper limit of `SwingParameters.thruster_firing_m`.
_MAX_FIRING_M = 1000.0
#: Mars 2020 under its parachute, a rigid vehicle with its backshell: coning with the parachute, and nodding about the
#: confluence of the bridles. Parachute: 50 m long with its lines, 82 kg (public summaries of NASA); all other values
#: are assumed.
PARACHUTE = SwingParameters(
    altitude_first_m=4200.0, descent_rate_m_s=90.0, wind_east_m_s=8.0, wind_north_m_s=3.0, gust_intensity_m_s=1.5,
    cone_angle_deg=5.0, nod_rate_deg_s=6.0, line_length_m=50.0, bridle_length_m=7.0, canopy_mass_kg=120.0,
    backshell_mass_kg=0.0, lander_mass_kg=3000.0, mass_centre_m=6.0, gyration_transverse_m=1.3, gyration_axial_m=1.3,
    arm_length_m=7.0, thruster_firing_m=_MAX_FIRING_M,
)  # fmt: skip


class ProfileParameters(Parameters):
    """Parameters of the flight from the start of localisation to its end. Altitudes are above `ground_height_m`.

    Altitudes and speeds: Mars 2020 (parachute from 4.2 km at about 90 m/s, separation at about 2.1 km, powered descent
    at about 50 m/s, end at 500 m). Limits, gains and limit cycle of the powered descent are assumed.
    """

    altitude_start_m: Annotated[float, bounded_field(1000.0, 8000.0, "altitude at time 0")] = 4200.0
    parachute: Annotated[SwingParameters, Field(description="parachute descent; its altitudes are not used")] = (
        PARACHUTE
    )
    altitude_separation_m: Annotated[float, bounded_field(800.0, 7000.0, "altitude of backshell separation")] = 2100.0
    altitude_end_m: Annotated[float, bounded_field(200.0, 5000.0, "altitude at the end of localisation")] = 500.0
    descent_speed_m_s: Annotated[float, bounded_field(10.0, 150.0, "final vertical speed")] = 50.0
    max_vertical_m_s2: Annotated[float, bounded_field(0.5, 20.0, "limit of the vertical acceleration (assumed)")] = 3.0
    max_horizontal_m_s2: Annotated[float, bounded_field(0.1, 5.0, "limit of the horizontal acceleration (assumed)")] = (
        1.0
    )
    velocity_gain_per_s: Annotated[float, bounded_field(0.05, 1.0, "gain k of the velocity (assumed)")] = 0.5
    thrust_lag_rad_s: Annotated[float, bounded_field(2.0, 20.0, "frequency W of the thrust's lag (assumed)")] = 6.0
    free_fall_s: Annotated[float, bounded_field(0.0, 3.0, "separation to start of the thrusters (assumed)")] = 1.0
    start_up_s: Annotated[float, bounded_field(0.1, 3.0, "rise time of the guidance's command (assumed)")] = 0.5
    max_rate_deg_s: Annotated[float, bounded_field(0.5, 60.0, "limit of the commanded body rate (assumed)")] = 6.0
    attitude_gain_per_s: Annotated[float, bounded_field(0.1, 5.0, "gain K_R of the attitude (assumed)")] = 1.0
    rate_gain_per_s: Annotated[float, bounded_field(0.5, 20.0, "gain K_w of the body rate (assumed)")] = 4.0
    limit_cycle_deg: Annotated[float, bounded_field(0.0, 5.0, "amplitude of the limit cycle (assumed)")] = 0.3
    limit_cycle_s: Annotated[float, bounded_field(0.5, 60.0, "period of the limit cycle (assumed)")] = 3.0

    @model_validator(mode="after")
    def _check_altitudes(self) -> ProfileParameters:
        start, separation, end = self.altitude_start_m, self.altitude_separation_m, self.altitude_end_m
        if not start > separation > end:
            raise ValueError(
                f"altitudes of start, separation and end are {start:.6g}, {separation:.6g} and {end:.6g} m; "
                f"allowed: decreasing"
            )
        return self


@dataclass(frozen=True, eq=False)
class LanderFlight(Trajectory):
    """Flight of a lander under its parachute and on its thrusters: a `Trajectory` of camera and inertial unit.

    Time 0 is the start of localisation. Body z points from the camera upwards; the camera looks along -z.

    - recorded: spline of the flight
    - parachute: simulated parachute descent, which the flight follows until `separation_s`
    - ground_height_m: world z of the ground, the reference of altitudes
    - separation_s, end_s: times of backshell separation and of the altitude of the end
    """

    parameters: ProfileParameters
    recorded: RecordedMotion
    parachute: SwingDescent
    ground_height_m: float
    separation_s: float
    end_s: float

    @classmethod
    def simulate(
        cls,
        parameters: ProfileParameters,
        start_m: Vector,
        rng: np.random.Generator,
        *,
        ground_height_m: float,
        gravity_m_s2: float,
    ) -> LanderFlight:
        """Simulate from `LEAD_S` before the start until `BELOW_END_M` below the altitude of the end.

        `start_m` is the position at time 0, world axes; `altitude_start_m` of the parameters is not used. `rng` draws
        the gusts and the phases of the limit cycle. Raises ValueError if the start is not above the separation, the
        parachute descent is not valid (`SwingDescent.simulate`), or the end is not reached.
        """
        p = parameters
        start_altitude = float(start_m[2]) - ground_height_m
        if start_altitude <= p.altitude_separation_m:
            raise ValueError(
                f"start_m is {start_altitude:.1f} m above the ground; allowed: above the separation, at "
                f"{p.altitude_separation_m:.6g} m"
            )
        # the parachute descent is simulated to below the separation: its end follows from the firing height
        firing_m = min(p.altitude_separation_m, _MAX_FIRING_M)
        swing = p.parachute.model_copy(update={"thruster_firing_m": firing_m})
        parachute = SwingDescent.simulate(
            swing, start_m, rng, ground_height_m=ground_height_m, gravity_m_s2=gravity_m_s2, lead_s=LEAD_S
        )
        separation_s = parachute.time_of_altitude(p.altitude_separation_m)
        above = parachute.motion(_knots(-LEAD_S, separation_s))
        below = _fly_powered(p, parachute, separation_s, rng, ground_height_m, gravity_m_s2)
        recorded = RecordedMotion(
            np.concatenate([above.times_s, below.times_s[1:]]),
            np.concatenate([above.positions_m, below.positions_m[1:]]),
            Rotation.concatenate([above.attitudes, below.attitudes[1:]]),
            gravity_m_s2,
        )
        end_s = _time_of_height(recorded, ground_height_m + p.altitude_end_m)
        return cls(p, recorded, parachute, ground_height_m, separation_s, end_s)

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last time of the flight."""
        return self.recorded.span_s

    def motion(self, times_s: Float64[np.ndarray, "n"]) -> Motion:
        """Compute the true states at many times. Raises ValueError for times outside the span."""
        return self.recorded.motion(times_s)

    def time_of_altitude(self, altitude_m: float) -> float:
        """Return the first time at an altitude above `ground_height_m`; ValueError if the flight does not pass it."""
        return _time_of_height(self.recorded, self.ground_height_m + altitude_m)


@dataclass(frozen=True)
class _Poses:
    """Poses of a body; attitudes rotate from body to world axes."""

    times_s: Float64[np.ndarray, "n"]
    positions_m: Float64[np.ndarray, "n 3"]
    attitudes: Rotation


def _knots(start_s: float, end_s: float) -> Float64[np.ndarray, "n"]:
    """Return times from start to end, both included, at most `KNOT_STEP_S` apart."""
    return np.linspace(start_s, end_s, int(np.ceil((end_s - start_s) / KNOT_STEP_S)) + 1)


def _fly_powered(
    p: ProfileParameters,
    parachute: SwingDescent,
    separation_s: float,
    rng: np.random.Generator,
    ground_height_m: float,
    gravity_m_s2: float,
) -> _Poses:
    """Integrate the powered descent from the separation until `BELOW_END_M` below the end, and sample its poses."""
    around = parachute.motion(separation_s + _JERK_STEP_S * np.array([-1.0, 0.0, 1.0]))
    accelerations = around.attitudes.apply(around.specific_forces_m_s2) - gravity_m_s2 * _UP
    jerk = (accelerations[2] - accelerations[0]) / (2.0 * _JERK_STEP_S)
    initial = around.state(1)
    attitude = initial.attitude
    heading = _multiply(_tilt_to(attitude.apply(_UP)) * _CONJUGATE, attitude.as_quat())
    max_rate = np.radians(p.max_rate_deg_s)
    last_height_m = ground_height_m + p.altitude_end_m - BELOW_END_M

    def derivative(time_s: float, y: Float64[np.ndarray, "19"]) -> Float64[np.ndarray, "19"]:
        velocity, acceleration, jerk = y[_VELOCITY], y[_ACCELERATION], y[_JERK]
        quaternion, rate = y[_ATTITUDE], y[_BODY_RATE]
        horizontal = _limit(-p.velocity_gain_per_s * velocity[:2], p.max_horizontal_m_s2)
        vertical = p.velocity_gain_per_s * (-p.descent_speed_m_s - velocity[2:])
        guidance = np.concatenate([horizontal, _limit(vertical, p.max_vertical_m_s2)])
        weight = _smooth_step((time_s - separation_s - p.free_fall_s) / p.start_up_s)
        command = weight * guidance - (1.0 - weight) * gravity_m_s2 * _UP
        snap = p.thrust_lag_rad_s**2 * (command - acceleration) - 2.0 * p.thrust_lag_rad_s * jerk
        commanded = _multiply(_tilt_to((acceleration[0], acceleration[1], gravity_m_s2)), heading)
        error = _rotation_vector(_multiply(quaternion * _CONJUGATE, commanded))
        rate_slope = p.rate_gain_per_s * (_limit(p.attitude_gain_per_s * error, max_rate) - rate)
        turn = 0.5 * _multiply(quaternion, (*rate, 0.0))
        return np.concatenate([velocity, acceleration, jerk, snap, turn, rate_slope])

    def height_left(_time_s: float, y: Float64[np.ndarray, "19"]) -> float:
        return float(y[_POSITION][2]) - last_height_m

    height_left.terminal = True  # type: ignore[attr-defined]
    max_s = (initial.position_m[2] - last_height_m) / (_MIN_SPEED_FRACTION * p.descent_speed_m_s)
    state = [initial.position_m, initial.velocity_m_s, accelerations[1], jerk, attitude.as_quat()]
    solution = pysolve_ivp(
        derivative,
        (separation_s, separation_s + max_s),
        np.concatenate([*state, initial.body_rate_rad_s]),
        method="DOP853",
        rtol=TOLERANCE,
        atol=TOLERANCE,
        # no step is so long that it passes over the start of the thrusters
        max_step=0.5,
        dense_output=True,
        events=(height_left,),
    )
    if not solution.event_terminated:
        height_m = solution.y[_POSITION][2, -1]
        raise ValueError(
            f"the powered descent is at z = {height_m:.1f} m after {max_s:.6g} s; allowed: parameters with "
            f"which it reaches {last_height_m:.1f} m"
        )
    times = _knots(separation_s, float(solution.t[-1]))
    states = np.ascontiguousarray(solution(times).T)
    phases = rng.uniform(0.0, 2.0 * np.pi, 3)
    elapsed = (times - separation_s)[:, None]
    angles = np.radians(p.limit_cycle_deg) * np.sin(2.0 * np.pi * elapsed / (p.limit_cycle_s * _CYCLE_RATIOS) + phases)
    cycle = Rotation.from_rotvec(_smooth_step(elapsed / p.limit_cycle_s) * angles)
    attitudes = Rotation.from_quat(states[:, _ATTITUDE])
    return _Poses(times, np.ascontiguousarray(states[:, _POSITION]), attitudes * cycle)


def _limit(values: Float64[np.ndarray, "k"], maximum: float) -> Float64[np.ndarray, "k"]:
    """Shorten a vector smoothly to less than a maximum length, without changing its direction."""
    ratio = math.sqrt(values @ values) / maximum
    return values * (math.tanh(ratio) / ratio if ratio > 0.0 else 1.0)


def _smooth_step(fraction: float | Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
    """Rise from 0 to 1 between 0 and 1, with continuous second derivative."""
    x = np.minimum(np.maximum(fraction, 0.0), 1.0)
    return np.asarray(x**3 * (10.0 + x * (6.0 * x - 15.0)))


def _multiply(left: Sequence[float] | Quaternion, right: Sequence[float] | Quaternion) -> Quaternion:
    """Multiply two quaternions; for single ones, plain numbers are faster than `Rotation`."""
    ax, ay, az, aw = left
    bx, by, bz, bw = right
    x = aw * bx + ax * bw + ay * bz - az * by
    y = aw * by + ay * bw + az * bx - ax * bz
    z = aw * bz + az * bw + ax * by - ay * bx
    return np.array([x, y, z, aw * bw - ax * bx - ay * by - az * bz])


def _rotation_vector(quaternion: Quaternion) -> Vector:
    """Compute the rotation vector of a quaternion of any length, with an angle of at most 180 deg."""
    x, y, z, w = quaternion
    sine = math.sqrt(x * x + y * y + z * z)
    if sine == 0.0:
        return np.zeros(3)
    return quaternion[:3] * (math.copysign(2.0, w) * math.atan2(sine, abs(w)) / sine)


def _tilt_to(direction: Sequence[float] | Vector) -> Quaternion:
    """Compute the smallest rotation from the vertical to an upward direction."""
    x, y, z = direction
    # the rotation axis is (0, 0, 1) x direction; the length of the quaternion is 1 after division by the norm
    w = math.sqrt(x * x + y * y + z * z) + z
    norm = math.sqrt(x * x + y * y + w * w)
    return np.array([-y / norm, x / norm, 0.0, w / norm])


def _time_of_height(motion: RecordedMotion, height_m: float) -> float:
    """Return the first time at which the body passes a world height; ValueError if it does not."""
    heights = motion.positions_m[:, 2]
    indices = np.flatnonzero((heights[:-1] > height_m) & (heights[1:] <= height_m))
    if not indices.size:
        raise ValueError(
            f"height {height_m:.6g} m is not passed; allowed: {heights.min():.6g} to {heights.max():.6g} m"
        )
    first, second = motion.times_s[indices[0]], motion.times_s[indices[0] + 1]
    return float(brentq(lambda time: motion.state(time).position_m[2] - height_m, first, second, xtol=1e-9))
