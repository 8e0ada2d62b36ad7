"""Small autonomous helicopter: flight at constant height for pictures, and landing on a site (landing paper, V).

Thrust acts along the body's z axis, drag is proportional to the airspeed, so that the helicopter pitches forward to fly
and leans into the wind. Pitch, roll and yaw follow the autopilot's commands as second-order systems, disturbed by
gusts; thrust follows with a lag. The autopilot commands speed by distance, acceleration by speed, and tilt by
acceleration, with a trim against steady wind, from a delayed state.

The flight over the ground is controlled with true states, as its deviation from the path does not matter. The landing
is controlled with navigation's states, so that navigation errors become touchdown errors. Below the height of the flare
the helicopter only stops its drift, and gusts displace it.

Not modelled: inflow near the ground, sliding or tipping after the touchdown (the skids stay at the first contact and
level out), and wind that depends on position.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum
from typing import Annotated

import numpy as np
import scipy  # scipy.signal is slow to import: it is loaded at its first use
from jaxtyping import Float64, Int64
from pydantic import Field

from marsyard.sim.dynamics.rotorcraft import kernels
from marsyard.sim.dynamics.trajectory import Motion, Trajectory, attitudes_and_body_rates, check_times
from marsyard.sim.parameters import NonNegative, Parameters, Positive, bounded_field

Gain = Annotated[float, Field(gt=0.0, le=10.0)]

#: Duration of the flight after the last picture, s: clocks may be late.
TAIL_S = 0.1


class VibrationParameters(Parameters):
    """Vibration by the main rotor: a sine along and about each axis, its phase drawn. All assumed.

    A rotor of 1.8 m at 22 turns per second has a tip speed of 125 m/s, usual for its size.
    """

    rate_hz: Annotated[Positive, Field(le=45.0, description="frequency of the rotor, 1/s")] = 22.0
    acceleration_m_s2: Annotated[NonNegative, Field(le=20.0, description="amplitude along each world axis")] = 1.5
    angle_deg: Annotated[NonNegative, Field(le=1.0, description="amplitude of yaw, pitch and roll")] = 0.03


class AirParameters(Parameters):
    """Wind at the helicopter: a mean, and gusts correlated in time (first-order, as Dryden's along the flow)."""

    east_m_s: Annotated[float, bounded_field(-15.0, 15.0, "mean wind to the east")] = 1.0
    north_m_s: Annotated[float, bounded_field(-15.0, 15.0, "mean wind to the north")] = 1.0
    gust_m_s: Annotated[NonNegative, Field(le=5.0, description="RMS of the gusts per horizontal axis")] = 0.7
    vertical_gust_m_s: Annotated[NonNegative, Field(le=5.0, description="RMS of the vertical gusts")] = 0.2
    correlation_s: Annotated[Positive, Field(le=60.0, description="correlation time of the gusts")] = 2.0


class RotorcraftParameters(Parameters):
    """A helicopter similar to JPL's (2 m long, gas powered) with its autopilot.

    The paper gives no values. All are assumed: an attitude loop of about 1 Hz, position loops several times slower.
    """

    drag_s: Annotated[Positive, Field(description="time constant of the speed under drag alone, s")] = 5.0
    attitude_hz: Annotated[Positive, Field(le=5.0, description="natural frequency of pitch and roll, 1/s")] = 0.9
    heading_hz: Annotated[Positive, Field(le=5.0, description="natural frequency of yaw, 1/s")] = 0.5
    damping: Annotated[Positive, Field(le=2.0, description="damping ratio of the angles")] = 0.8
    thrust_lag_s: Annotated[Positive, Field(le=1.0, description="time constant of the thrust, s")] = 0.15
    max_tilt_deg: Annotated[Positive, Field(le=30.0, description="maximum commanded pitch or roll, deg")] = 12.0
    gust_tilt_deg_s_m: Annotated[NonNegative, Field(le=10.0, description="tilt by a gust, deg per m/s")] = 0.8
    gust_yaw_deg_s_m: Annotated[NonNegative, Field(le=10.0, description="turn into a gust, deg per m/s")] = 0.8
    position_gain: Annotated[Gain, Field(description="commanded speed per distance, 1/s")] = 0.5
    speed_gain: Annotated[Gain, Field(description="commanded acceleration per error of speed, 1/s")] = 1.2
    trim_gain: Annotated[NonNegative, Field(le=5.0, description="growth of trim per error of speed, 1/s2")] = 0.3
    delay_s: Annotated[NonNegative, Field(le=0.5, description="delay of the autopilot's command, s")] = 0.1
    gear_m: Annotated[NonNegative, Field(le=5.0, description="height of the camera above the skids, m")] = 0.4
    contact_s: Annotated[Positive, Field(le=1.0, description="time constant of the motion on the ground, s")] = 0.1
    step_s: Annotated[Positive, Field(le=0.05, description="step of the simulation")] = 0.02
    vibration: VibrationParameters = VibrationParameters()

    def craft(self, gravity_m_s2: float) -> kernels.Craft:
        """Convert to SI units for the kernels."""
        rad, turn = math.radians(1.0), 2.0 * math.pi
        return kernels.Craft(
            **self.model_dump(include=set(kernels.Craft._fields)),
            gravity_m_s2=gravity_m_s2,
            attitude_rad_s=turn * self.attitude_hz,
            attitude_damping=self.damping,
            heading_rad_s=turn * self.heading_hz,
            max_tilt_rad=rad * self.max_tilt_deg,
            gust_tilt_s_m=rad * self.gust_tilt_deg_s_m,
            gust_yaw_s_m=rad * self.gust_yaw_deg_s_m,
            delay_steps=round(self.delay_s / self.step_s),
        )


class TransitParameters(Parameters):
    """The flight at constant height while pictures are taken (paper, V). Height and number of pictures are assumed.

    The paper's "several seconds" are five here. Time 0 is the first picture's.
    """

    height_m: Annotated[Positive, Field(le=200.0, description="height above ground at the first picture")] = 10.0
    speed_m_s: Annotated[Positive, Field(le=15.0, description="commanded speed, m/s (assumed)")] = 1.0
    acceleration_m_s2: Annotated[Positive, Field(le=3.0, description="to that speed (assumed)")] = 1.0
    hover_s: Annotated[NonNegative, Field(le=600.0, description="duration of the hover before, s (assumed)")] = 15.0
    settle_s: Annotated[NonNegative, Field(le=60.0, description="at speed before the first picture (assumed)")] = 1.5
    pictures: Annotated[int, bounded_field(2, 1000, "pictures taken")] = 40
    pictures_s: Annotated[Positive, Field(le=120.0, description="from the first to the last picture, s")] = 5.0

    @property
    def lead_s(self) -> float:
        """Time from the flight's start to the first picture."""
        return self.hover_s + self.speed_m_s / self.acceleration_m_s2 + self.settle_s


class LandingGuidance(Parameters):
    """Guidance from the last picture to the ground (paper, V).

    The distances of 2 m and 1.5 m are the paper's, the wait is its run time; the rest is assumed. In the paper the
    descent continues to reduce the distance from the site; below 1.5 m only the blades' pitch changes slowly. Here the
    helicopter stops its drift below that height, and no longer steers to the site.
    """

    wait_s: Annotated[NonNegative, Field(le=60.0, description="from the last picture to the answer, s")] = 1.8
    approach_m_s: Annotated[Positive, Field(le=15.0, description="maximum commanded speed to the site")] = 2.0
    near_m: Annotated[Positive, Field(le=50.0, description="distance from the site at which the descent begins")] = 2.0
    descent_m_s: Annotated[Positive, Field(le=5.0, description="commanded speed of the descent, m/s")] = 0.7
    flare_range_m: Annotated[Positive, Field(le=20.0, description="laser range at which the flare begins, m")] = 1.5
    flare_m_s: Annotated[Positive, Field(le=5.0, description="commanded sink rate of the flare, m/s")] = 0.3
    max_duration_s: Annotated[Positive, Field(le=600.0, description="limit of the landing's duration, s")] = 60.0
    rest_s: Annotated[NonNegative, Field(le=60.0, description="simulated time after the touchdown, s")] = 7.0


@dataclass(frozen=True)
class Vibration:
    """Sines along the world's axes and in yaw, pitch and roll, added to positions (m) and angles (rad)."""

    rate_rad_s: float
    amplitudes: Float64[np.ndarray, "6"]
    phases_rad: Float64[np.ndarray, "6"]

    @classmethod
    def draw(cls, parameters: VibrationParameters, rng: np.random.Generator) -> Vibration:
        """Draw the phases."""
        rate = 2.0 * np.pi * parameters.rate_hz
        amplitudes = np.repeat([parameters.acceleration_m_s2 / rate**2, np.radians(parameters.angle_deg)], 3)
        return cls(rate, amplitudes, 2.0 * np.pi * rng.random(6))

    def derivative(self, times_s: Float64[np.ndarray, "n"], order: int) -> Float64[np.ndarray, "n 6"]:
        """Displacement (order 0) or a derivative of it."""
        phases = self.rate_rad_s * times_s[:, None] + self.phases_rad + 0.5 * np.pi * order
        return np.asarray(self.amplitudes * self.rate_rad_s**order * np.sin(phases))


@dataclass(frozen=True)
class FlownPath(Trajectory):
    """Motion through states at equidistant times (rows: see `kernels`), exact between them, with vibration added.

    Position and angles are twice continuously differentiable. The body frame has its origin in camera, laser and
    instruments, x forward, y to the left, z up along the rotor.
    """

    start_s: float
    step_s: float
    rows: Float64[np.ndarray, "knots 18"]
    vibration: Vibration
    gravity_m_s2: float

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last time of the simulation."""
        return self.start_s, self.start_s + self.step_s * (len(self.rows) - 1)

    @property
    def knots_s(self) -> Float64[np.ndarray, "knots"]:
        """Times of the rows."""
        return np.asarray(self.start_s + self.step_s * np.arange(len(self.rows)))

    def motion(self, times_s: Float64[np.ndarray, "n"]) -> Motion:
        """True states at many times. Raises ValueError outside of the span."""
        check_times(times_s, self.span_s, 1e-6 * self.step_s)  # sums of steps have rounding errors
        interval = np.clip(((times_s - self.start_s) / self.step_s).astype(int), 0, len(self.rows) - 2)
        elapsed = (times_s - self.start_s - self.step_s * interval)[:, None]
        angles, angle_rates, _ = self._interpolate(interval, elapsed, kernels.ANGLE)
        vibration = [self.vibration.derivative(times_s, order) for order in range(3)]
        attitudes, rates = attitudes_and_body_rates(angles + vibration[0][:, 3:], angle_rates + vibration[1][:, 3:])
        path = self._interpolate(interval, elapsed, kernels.POSITION)
        derivatives = [smooth + added[:, :3] for smooth, added in zip(path, vibration, strict=True)]
        return Motion.from_accelerations(times_s, derivatives, attitudes, rates, self.gravity_m_s2)

    def _interpolate(
        self, interval: np.ndarray, t: Float64[np.ndarray, "n 1"], column: int
    ) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
        """A vector and its first two derivatives, in consecutive columns; the second is linear between knots."""
        value, first, second = np.split(self.rows[interval, column : column + 9], 3, axis=1)
        third = (self.rows[interval + 1, column + 6 : column + 9] - second) / self.step_s
        return (
            value + t * (first + t * (second / 2.0 + t * third / 6.0)),
            first + t * (second + t * third / 2.0),
            second + t * third,
        )


@dataclass(frozen=True)
class Air:
    """Wind at the helicopter: its mean, and gusts at the knots of the simulation from the flight's start on."""

    mean_m_s: Float64[np.ndarray, "3"]
    gusts_m_s: Float64[np.ndarray, "knots 3"]

    @classmethod
    def draw(cls, parameters: AirParameters, step_s: float, duration_s: float, rng: np.random.Generator) -> Air:
        """Draw stationary gusts for a duration."""
        p = parameters
        correlation = np.exp(-step_s / p.correlation_s)
        shocks = rng.standard_normal((int(np.ceil(duration_s / step_s)) + 2, 3))
        shocks[1:] *= np.sqrt(1.0 - correlation**2)
        deviations = np.array([p.gust_m_s, p.gust_m_s, p.vertical_gust_m_s])
        gusts = deviations * scipy.signal.lfilter([1.0], [1.0, -correlation], shocks, axis=0)
        return cls(np.array([p.east_m_s, p.north_m_s, 0.0]), gusts)

    def check_lasts(self, knots: int) -> None:
        """Raises ValueError where there are gusts for fewer knots than a flight may take."""
        if len(self.gusts_m_s) < knots:
            raise ValueError(f"there are gusts for {len(self.gusts_m_s)} knots; the flight may take {knots}")


@dataclass(frozen=True)
class GroundPatch:
    """Heights of the ground around a site on a grid, bilinear within it and constant beyond its edges.

    - corner_m: east and north of the first height; row i lies at north + i * spacing, column j at east + j * spacing
    """

    corner_m: Float64[np.ndarray, "2"]
    spacing_m: float
    heights_m: Float64[np.ndarray, "rows columns"]

    def height_m(self, position_m: Float64[np.ndarray, "2"]) -> float:
        """Height at a position (east, north)."""
        return float(kernels.ground_height(self.as_kernel(), float(position_m[0]), float(position_m[1])))

    def as_kernel(self) -> kernels.Ground:
        """The same as a struct of the kernels."""
        east, north = self.corner_m.tolist()
        return kernels.Ground(east, north, self.spacing_m, self.heights_m)


@dataclass(frozen=True)
class LandingLaser:
    """Laser altimeter of the landing.

    - scale: readings over true ranges
    - noise_m: noise of the reading at each knot from the flight's start on
    - stuck_m: the constant reading of a failed altimeter
    """

    scale: float
    noise_m: Float64[np.ndarray, "knots"]
    stuck_m: float | None = None


class Phase(Enum):
    """Phases of a flight; the values are those of the kernels."""

    TRANSIT = kernels.FOLLOW
    WAIT = kernels.WAIT
    APPROACH = kernels.APPROACH
    DESCENT = kernels.DESCEND
    LANDING = kernels.FLARE
    ON_GROUND = kernels.REST


@dataclass(frozen=True)
class RotorcraftFlight:
    """A simulated flight, and the autopilot's state, from which the simulation can be continued.

    - phases: value of `Phase` at each knot
    - autopilot: thrust and trim at the last knot
    - heading_rad: commanded yaw
    """

    path: FlownPath
    phases: Int64[np.ndarray, "knots"]
    autopilot: Float64[np.ndarray, "4"]
    heading_rad: float
    craft: RotorcraftParameters

    def first(self, phase: Phase) -> float | None:
        """Time at which a phase began; None if it did not occur."""
        knots = np.flatnonzero(self.phases == phase.value)
        return float(self.path.knots_s[knots[0]]) if knots.size else None


def transit_flight(
    craft: RotorcraftParameters,
    transit: TransitParameters,
    over_m: Float64[np.ndarray, "3"],
    course_rad: float,
    heading_rad: float,
    gravity_m_s2: float,
    air: Air,
    rng: np.random.Generator,
) -> RotorcraftFlight:
    """Simulate the flight until `TAIL_S` after the last picture.

    `over_m` is the commanded position at the first picture; course and heading are the directions of flight and nose,
    counterclockwise from east. `rng` draws the vibration. Raises ValueError where the gusts end before the flight.
    """
    p, step = transit, craft.step_s
    count = int(np.ceil((p.lead_s + p.pictures_s + TAIL_S) / step - 1e-9)) + 1
    air.check_lasts(count)
    times = -p.lead_s + step * np.arange(count)
    # commanded distance from the first picture's position, speed and acceleration along the course
    ramp_s = p.speed_m_s / p.acceleration_m_s2
    since_start = times + p.settle_s + ramp_s
    elapsed_ramp = np.clip(since_start, 0.0, ramp_s)
    distance = 0.5 * p.acceleration_m_s2 * elapsed_ramp**2 + p.speed_m_s * (np.maximum(since_start, ramp_s) - ramp_s)
    distance -= 0.5 * p.speed_m_s * ramp_s + p.speed_m_s * p.settle_s
    acceleration = np.where((since_start > 0.0) & (since_start < ramp_s), p.acceleration_m_s2, 0.0)
    along = np.array([np.cos(course_rad), np.sin(course_rad), 0.0])
    profile = (distance, p.acceleration_m_s2 * elapsed_ramp, acceleration)
    reference = np.concatenate([np.multiply.outer(values, along) for values in profile], axis=1)
    reference[:, :3] += over_m
    # hover trimmed against the mean wind
    constants = craft.craft(gravity_m_s2)
    trim = -air.mean_m_s / constants.drag_s
    east, north, _ = trim.tolist()
    forward = np.cos(heading_rad) * east + np.sin(heading_rad) * north
    left = np.cos(heading_rad) * north - np.sin(heading_rad) * east
    pitch = np.arctan2(forward, gravity_m_s2)
    roll = -np.arctan2(left * np.cos(pitch), gravity_m_s2)
    autopilot = np.zeros(kernels.AUTOPILOT_SIZE)
    autopilot[kernels.THRUST] = np.sqrt(gravity_m_s2**2 + trim @ trim)
    autopilot[kernels.TRIM :] = trim
    rows = np.zeros((count, kernels.SIZE))
    rows[0, kernels.POSITION :][:3] = reference[0, :3]
    rows[0, kernels.ANGLE :][:3] = [heading_rad, pitch, roll]
    flight = kernels.Flight(rows, autopilot, heading_rad, air.mean_m_s, air.gusts_m_s, step)
    kernels.follow(flight, reference, constants)
    path = FlownPath(-p.lead_s, step, rows, Vibration.draw(craft.vibration, rng), gravity_m_s2)
    return RotorcraftFlight(path, np.full(count, Phase.TRANSIT.value), autopilot, heading_rad, craft)


def landing_flight(
    flown: RotorcraftFlight,
    guidance: LandingGuidance,
    site_m: Float64[np.ndarray, "2"],
    errors: Float64[np.ndarray, "m 9"],
    air: Air,
    ground: GroundPatch,
    laser: LandingLaser,
    end_s: float | None = None,
) -> RotorcraftFlight:
    """Continue a flight to a site and down, until `end_s`, or else `rest_s` after the touchdown or at the time limit.

    `site_m` is the site's east and north in navigation's coordinates. `errors` are navigation's minus true position,
    velocity and angles (yaw, pitch, roll) at the knots from the flight's start on; the last row remains afterwards.
    Raises ValueError where the gusts or the laser's noise end before the longest possible flight.
    """
    step, before = flown.craft.step_s, len(flown.path.rows)
    count = before + int(np.ceil((guidance.wait_s + guidance.max_duration_s) / step))
    air.check_lasts(count)
    if len(laser.noise_m) < count:
        raise ValueError(f"the laser's noise is known for {len(laser.noise_m)} knots; the flight may take {count}")
    rows = np.concatenate([flown.path.rows, np.zeros((count - before, kernels.SIZE))])
    phases = np.concatenate([flown.phases, np.full(count - before, Phase.WAIT.value)])
    padded_errors = np.concatenate([errors, np.repeat(errors[-1:], max(count - len(errors), 0), axis=0)])
    commands = kernels.Landing(
        **guidance.model_dump(include=set(kernels.Landing._fields)),
        site_east_m=float(site_m[0]),
        site_north_m=float(site_m[1]),
        hover_m=float(rows[before - 1, 2] + padded_errors[before - 1, 2]),
        wait_until=before - 1 + round((guidance.wait_s - TAIL_S) / step),
        laser_scale=laser.scale,
        laser_stuck_m=np.nan if laser.stuck_m is None else laser.stuck_m,
    )
    flight = kernels.Flight(rows, flown.autopilot.copy(), flown.heading_rad, air.mean_m_s, air.gusts_m_s, step)
    craft = flown.craft.craft(flown.path.gravity_m_s2)
    kernels.land(flight, phases, before - 1, padded_errors, laser.noise_m, ground.as_kernel(), commands, craft)
    landed = np.flatnonzero(phases == Phase.ON_GROUND.value)
    if end_s is not None:
        count = min(count, round((end_s - flown.path.start_s) / step) + 1)
    elif landed.size:
        count = min(count, int(landed[0]) + int(np.ceil(guidance.rest_s / step)))
    path = replace(flown.path, rows=rows[:count])
    return replace(flown, path=path, phases=phases[:count], autopilot=flight.autopilot)
