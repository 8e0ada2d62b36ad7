"""Small autonomous helicopter: level flight for image acquisition, and landing on a site (landing paper, V).

Thrust acts along the body's z axis, and drag is proportional to the airspeed: the helicopter pitches forward to fly and
tilts into the wind. Pitch, roll and yaw follow the autopilot's commands as second-order systems, disturbed by gusts;
thrust follows with a lag. The autopilot uses a delayed state. It computes the speed from the distance to the goal, the
acceleration from the speed error, and the tilt from the acceleration, with a trim against steady wind.

The imaging flight is controlled with true states, because its deviation from the path has no influence on results. The
landing is controlled with the estimated navigation states, so that navigation errors become touchdown errors. Below the
flare height the autopilot controls the velocity to zero, but not the position, so that gusts displace the helicopter.

Not modelled: inflow near the ground, wind that depends on position, and sliding or tipping after the touchdown. The
skids stay at the point of first contact, and the tilt decays to zero.

The landing paper is Johnson, Montgomery & Matthies, "Vision Guided Landing".
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
from marsyard.sim.error_sources import VIBRATION, WIND
from marsyard.sim.parameters import NonNegative, Parameters, Positive, bounded_field

Gain = Annotated[float, Field(gt=0.0, le=10.0)]

#: Duration of the flight after the last image; it is needed because the camera's clock can be late.
TAIL_S = 0.1


class VibrationParameters(Parameters):
    """Vibration by the main rotor: a sine along and about each axis with random phase. All values are assumed.

    A rotor of 1.8 m diameter at 22 revolutions per second has a tip speed of 125 m/s, common for this size.
    """

    rate_hz: Annotated[Positive, Field(le=45.0, description="frequency of the rotor, 1/s")] = 22.0
    acceleration_m_s2: Annotated[
        NonNegative, VIBRATION, Field(le=20.0, description="amplitude along each world axis")
    ] = 1.5
    angle_deg: Annotated[NonNegative, VIBRATION, Field(le=1.0, description="amplitude of yaw, pitch and roll")] = 0.03


class AirParameters(Parameters):
    """Wind at the helicopter: mean wind, and gusts as first-order Markov processes (Dryden's longitudinal spectrum)."""

    east_m_s: Annotated[float, WIND, bounded_field(-15.0, 15.0, "mean wind to the east")] = 1.0
    north_m_s: Annotated[float, WIND, bounded_field(-15.0, 15.0, "mean wind to the north")] = 1.0
    gust_m_s: Annotated[NonNegative, WIND, Field(le=5.0, description="RMS of the gusts per horizontal axis")] = 0.7
    vertical_gust_m_s: Annotated[NonNegative, WIND, Field(le=5.0, description="RMS of the vertical gusts")] = 0.2
    correlation_s: Annotated[Positive, Field(le=60.0, description="correlation time of the gusts")] = 2.0


class RotorcraftParameters(Parameters):
    """Parameters of a helicopter similar to JPL's (2 m long, gas powered) and of its autopilot.

    The paper contains no values. All are assumed: an attitude loop of about 1 Hz, position loops several times slower.
    """

    drag_s: Annotated[Positive, Field(description="time constant of the decay of airspeed by drag, s")] = 5.0
    attitude_hz: Annotated[Positive, Field(le=5.0, description="natural frequency of pitch and roll, 1/s")] = 0.9
    heading_hz: Annotated[Positive, Field(le=5.0, description="natural frequency of yaw, 1/s")] = 0.5
    damping: Annotated[Positive, Field(le=2.0, description="damping ratio of the angles")] = 0.8
    thrust_lag_s: Annotated[Positive, Field(le=1.0, description="time constant of the thrust, s")] = 0.15
    max_tilt_deg: Annotated[Positive, Field(le=30.0, description="maximum commanded pitch or roll, deg")] = 12.0
    gust_tilt_deg_s_m: Annotated[NonNegative, Field(le=10.0, description="tilt by a gust, deg per m/s")] = 0.8
    gust_yaw_deg_s_m: Annotated[NonNegative, Field(le=10.0, description="yaw into a gust, deg per m/s")] = 0.8
    position_gain: Annotated[Gain, Field(description="commanded speed / distance, 1/s")] = 0.5
    speed_gain: Annotated[Gain, Field(description="commanded acceleration / speed error, 1/s")] = 1.2
    trim_gain: Annotated[NonNegative, Field(le=5.0, description="rate of trim / speed error, 1/s2")] = 0.3
    delay_s: Annotated[NonNegative, Field(le=0.5, description="delay of the autopilot's command, s")] = 0.1
    gear_m: Annotated[NonNegative, Field(le=5.0, description="height of the camera above the skids, m")] = 0.4
    contact_s: Annotated[Positive, Field(le=1.0, description="time constant of the motion on the ground, s")] = 0.1
    step_s: Annotated[Positive, Field(le=0.05, description="step of the simulation")] = 0.02
    vibration: VibrationParameters = VibrationParameters()

    def to_kernel(self, gravity_m_s2: float) -> kernels.Craft:
        """Convert the parameters to SI units for the kernels."""
        rad_per_deg, rad_per_cycle = math.radians(1.0), 2.0 * math.pi
        return kernels.Craft(
            **self.model_dump(include=set(kernels.Craft._fields)),
            gravity_m_s2=gravity_m_s2,
            attitude_rad_s=rad_per_cycle * self.attitude_hz,
            attitude_damping=self.damping,
            heading_rad_s=rad_per_cycle * self.heading_hz,
            max_tilt_rad=rad_per_deg * self.max_tilt_deg,
            gust_tilt_s_m=rad_per_deg * self.gust_tilt_deg_s_m,
            gust_yaw_s_m=rad_per_deg * self.gust_yaw_deg_s_m,
            delay_steps=round(self.delay_s / self.step_s),
        )


class TransitParameters(Parameters):
    """Parameters of the flight at constant height during which images are taken (paper, V).

    Height and number of images are assumed. The paper's "several seconds" are 5 s. Time 0 is the time of the first
    image.
    """

    height_m: Annotated[Positive, Field(le=200.0, description="height above ground at the first image")] = 10.0
    speed_m_s: Annotated[Positive, Field(le=15.0, description="commanded speed, m/s (assumed)")] = 1.0
    acceleration_m_s2: Annotated[Positive, Field(le=3.0, description="acceleration to that speed (assumed)")] = 1.0
    hover_s: Annotated[NonNegative, Field(le=600.0, description="duration of the initial hover, s (assumed)")] = 15.0
    settle_s: Annotated[
        NonNegative, Field(le=60.0, description="duration at constant speed before the first image, s (assumed)")
    ] = 1.5
    images: Annotated[int, bounded_field(2, 1000, "number of images")] = 40
    imaging_duration_s: Annotated[
        Positive, Field(le=120.0, description="duration from the first to the last image, s")
    ] = 5.0

    @property
    def lead_s(self) -> float:
        """Time from the flight's start to the first image."""
        return self.hover_s + self.speed_m_s / self.acceleration_m_s2 + self.settle_s


class LandingGuidance(Parameters):
    """Parameters of the guidance from the last image to the ground (paper, V).

    The distances of 2 m and 1.5 m are from the paper, and `wait_s` is the run time of its algorithm; the other values
    are assumed. In the paper the helicopter approaches the site during the descent, and below 1.5 m only the collective
    pitch is reduced slowly. In this model the autopilot controls the velocity below that height, not the position.
    """

    wait_s: Annotated[NonNegative, Field(le=60.0, description="from the last image to the answer, s")] = 1.8
    approach_m_s: Annotated[Positive, Field(le=15.0, description="maximum commanded speed to the site")] = 2.0
    near_m: Annotated[Positive, Field(le=50.0, description="distance from the site at which the descent begins")] = 2.0
    descent_m_s: Annotated[Positive, Field(le=5.0, description="commanded speed of the descent, m/s")] = 0.7
    flare_range_m: Annotated[Positive, Field(le=20.0, description="laser range at which the flare begins, m")] = 1.5
    flare_m_s: Annotated[Positive, Field(le=5.0, description="commanded sink rate of the flare, m/s")] = 0.3
    max_duration_s: Annotated[Positive, Field(le=600.0, description="limit of the landing's duration, s")] = 60.0
    rest_s: Annotated[NonNegative, Field(le=60.0, description="simulated time after the touchdown, s")] = 7.0


@dataclass(frozen=True)
class Vibration:
    """Sines that are added to positions along the world's axes (m) and to yaw, pitch and roll (rad)."""

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
        """Compute the time derivative of the given order; order 0 is the displacement."""
        phases = self.rate_rad_s * times_s[:, None] + self.phases_rad + 0.5 * np.pi * order
        return np.asarray(self.amplitudes * self.rate_rad_s**order * np.sin(phases))


@dataclass(frozen=True)
class SimulatedPath(Trajectory):
    """Simulated motion: states at equidistant times (columns: see `kernels`), interpolated exactly, plus vibration.

    Position and angles are twice continuously differentiable. The body frame has its origin at the camera; laser
    and inertial unit are assumed to be at the same point. Its axes are x forward, y to the left, z up along the rotor's
    axis.
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
        """Compute the true states at many times. Raises ValueError for times outside the span."""
        check_times(times_s, self.span_s, 1e-6 * self.step_s)  # sums of steps have rounding errors
        interval = np.clip(((times_s - self.start_s) / self.step_s).astype(int), 0, len(self.rows) - 2)
        elapsed_s = (times_s - self.start_s - self.step_s * interval)[:, None]
        angles, angle_rates, _ = self._interpolate(interval, elapsed_s, kernels.ANGLE)
        vibration = [self.vibration.derivative(times_s, order) for order in range(3)]
        attitudes, rates = attitudes_and_body_rates(angles + vibration[0][:, 3:], angle_rates + vibration[1][:, 3:])
        path = self._interpolate(interval, elapsed_s, kernels.POSITION)
        derivatives = [vector + sine[:, :3] for vector, sine in zip(path, vibration, strict=True)]
        return Motion.from_accelerations(times_s, derivatives, attitudes, rates, self.gravity_m_s2)

    def _interpolate(
        self, interval: np.ndarray, elapsed_s: Float64[np.ndarray, "n 1"], column: int
    ) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
        """Interpolate a vector and its first two derivatives (consecutive columns); the second derivative is linear."""
        value, first, second = np.split(self.rows[interval, column : column + 9], 3, axis=1)
        third = (self.rows[interval + 1, column + 6 : column + 9] - second) / self.step_s
        return (
            value + elapsed_s * (first + elapsed_s * (second / 2.0 + elapsed_s * third / 6.0)),
            first + elapsed_s * (second + elapsed_s * third / 2.0),
            second + elapsed_s * third,
        )


@dataclass(frozen=True)
class Air:
    """Wind at the helicopter: mean wind, and gusts at the knots of the simulation from the flight's start on."""

    mean_m_s: Float64[np.ndarray, "3"]
    gusts_m_s: Float64[np.ndarray, "knots 3"]

    @classmethod
    def draw(cls, parameters: AirParameters, step_s: float, duration_s: float, rng: np.random.Generator) -> Air:
        """Draw stationary gusts for a flight of `duration_s`."""
        p = parameters
        correlation = np.exp(-step_s / p.correlation_s)
        white_noise = rng.standard_normal((int(np.ceil(duration_s / step_s)) + 2, 3))
        white_noise[1:] *= np.sqrt(1.0 - correlation**2)
        deviations = np.array([p.gust_m_s, p.gust_m_s, p.vertical_gust_m_s])
        gusts = deviations * scipy.signal.lfilter([1.0], [1.0, -correlation], white_noise, axis=0)
        return cls(np.array([p.east_m_s, p.north_m_s, 0.0]), gusts)

    def check_duration(self, knots: int) -> None:
        """Raise ValueError if there are gusts for fewer than `knots` knots."""
        if len(self.gusts_m_s) < knots:
            raise ValueError(f"there are gusts for {len(self.gusts_m_s)} knots; the flight can have {knots}")


@dataclass(frozen=True)
class GroundPatch:
    """Heights of the ground around a site on a grid, bilinear within it and constant beyond its edges.

    - corner_m: east and north of the first height; row i is at north + i * spacing, column j at east + j * spacing
    """

    corner_m: Float64[np.ndarray, "2"]
    spacing_m: float
    heights_m: Float64[np.ndarray, "rows columns"]

    def height_m(self, position_m: Float64[np.ndarray, "2"]) -> float:
        """Interpolate the height at a position (east, north)."""
        return float(kernels.compute_ground_height(self.as_kernel(), float(position_m[0]), float(position_m[1])))

    def as_kernel(self) -> kernels.Ground:
        """Convert the patch to the type of the kernels."""
        east, north = self.corner_m.tolist()
        return kernels.Ground(east, north, self.spacing_m, self.heights_m)


@dataclass(frozen=True)
class AltimeterErrors:
    """Errors of the laser altimeter during the landing.

    - scale: reading / true range
    - noise_m: noise of the reading at each knot from the flight's start on
    - stuck_m: the constant reading of a failed altimeter
    """

    scale: float
    noise_m: Float64[np.ndarray, "knots"]
    stuck_m: float | None = None


class Phase(Enum):
    """Phases of a flight, with the numbers of the kernels as values."""

    TRANSIT = kernels.FOLLOW
    WAIT = kernels.WAIT
    APPROACH = kernels.APPROACH
    DESCENT = kernels.DESCEND
    FLARE = kernels.FLARE
    ON_GROUND = kernels.REST


@dataclass(frozen=True)
class RotorcraftFlight:
    """A simulated flight, and the autopilot's state, from which the simulation can be continued.

    - phases: value of `Phase` at each knot
    - autopilot: thrust divided by mass, and trim (east, north, up) at the last knot, m/s2
    - heading_rad: commanded yaw, counterclockwise from east
    """

    path: SimulatedPath
    phases: Int64[np.ndarray, "knots"]
    autopilot: Float64[np.ndarray, "4"]
    heading_rad: float
    craft: RotorcraftParameters

    def phase_start_s(self, phase: Phase) -> float | None:
        """Return the time at which a phase began; None if it did not occur."""
        knots = np.flatnonzero(self.phases == phase.value)
        return float(self.path.knots_s[knots[0]]) if knots.size else None


def simulate_transit(
    craft: RotorcraftParameters,
    transit: TransitParameters,
    first_image_position_m: Float64[np.ndarray, "3"],
    course_rad: float,
    heading_rad: float,
    gravity_m_s2: float,
    air: Air,
    rng: np.random.Generator,
) -> RotorcraftFlight:
    """Simulate the flight at constant height until `TAIL_S` after the last image.

    `first_image_position_m` is the commanded position at the first image; course and heading are the directions of
    flight and nose, counterclockwise from east. `rng` draws the phases of the vibration. Raises ValueError if the gusts
    end before the flight.
    """
    p, step = transit, craft.step_s
    count = int(np.ceil((p.lead_s + p.imaging_duration_s + TAIL_S) / step - 1e-9)) + 1
    air.check_duration(count)
    times = -p.lead_s + step * np.arange(count)
    # commanded distance from the position of the first image, speed and acceleration along the course
    ramp_s = p.speed_m_s / p.acceleration_m_s2
    since_start = times + p.settle_s + ramp_s
    elapsed_ramp = np.clip(since_start, 0.0, ramp_s)
    distance = 0.5 * p.acceleration_m_s2 * elapsed_ramp**2 + p.speed_m_s * (np.maximum(since_start, ramp_s) - ramp_s)
    distance -= 0.5 * p.speed_m_s * ramp_s + p.speed_m_s * p.settle_s
    acceleration = np.where((since_start > 0.0) & (since_start < ramp_s), p.acceleration_m_s2, 0.0)
    course = np.array([np.cos(course_rad), np.sin(course_rad), 0.0])
    profile = (distance, p.acceleration_m_s2 * elapsed_ramp, acceleration)
    reference = np.concatenate([np.multiply.outer(values, course) for values in profile], axis=1)
    reference[:, :3] += first_image_position_m
    # start: hover, with the trim that balances the mean wind
    constants = craft.to_kernel(gravity_m_s2)
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
    kernels.follow_path(flight, reference, constants)
    path = SimulatedPath(-p.lead_s, step, rows, Vibration.draw(craft.vibration, rng), gravity_m_s2)
    return RotorcraftFlight(path, np.full(count, Phase.TRANSIT.value), autopilot, heading_rad, craft)


def simulate_landing(
    transit: RotorcraftFlight,
    guidance: LandingGuidance,
    site_m: Float64[np.ndarray, "2"],
    errors: Float64[np.ndarray, "m 9"],
    air: Air,
    ground: GroundPatch,
    laser: AltimeterErrors,
    end_s: float | None = None,
) -> RotorcraftFlight:
    """Continue the flight `transit` to a site and land.

    The simulation ends at `end_s`; by default `rest_s` after the touchdown, or at the time limit without a touchdown.
    `site_m` is the site's east and north in the coordinates of the navigation. `errors` are the estimated position,
    velocity and angles (yaw, pitch, roll) minus the true ones at the knots from the flight's start on; the last row
    also applies to all later knots. Raises ValueError if the gusts or the laser's noise end before the longest possible
    flight.
    """
    step, transit_knots = transit.craft.step_s, len(transit.path.rows)
    count = transit_knots + int(np.ceil((guidance.wait_s + guidance.max_duration_s) / step))
    air.check_duration(count)
    if len(laser.noise_m) < count:
        raise ValueError(f"there is laser noise for {len(laser.noise_m)} knots; the flight can have {count}")
    rows = np.concatenate([transit.path.rows, np.zeros((count - transit_knots, kernels.SIZE))])
    phases = np.concatenate([transit.phases, np.full(count - transit_knots, Phase.WAIT.value)])
    padded_errors = np.concatenate([errors, np.repeat(errors[-1:], max(count - len(errors), 0), axis=0)])
    landing = kernels.Landing(
        **guidance.model_dump(include=set(kernels.Landing._fields)),
        site_east_m=float(site_m[0]),
        site_north_m=float(site_m[1]),
        hover_m=float(rows[transit_knots - 1, 2] + padded_errors[transit_knots - 1, 2]),
        wait_until=transit_knots - 1 + round((guidance.wait_s - TAIL_S) / step),
        laser_scale=laser.scale,
        laser_stuck_m=np.nan if laser.stuck_m is None else laser.stuck_m,
    )
    flight = kernels.Flight(rows, transit.autopilot.copy(), transit.heading_rad, air.mean_m_s, air.gusts_m_s, step)
    craft = transit.craft.to_kernel(transit.path.gravity_m_s2)
    kernels.land(flight, phases, transit_knots - 1, padded_errors, laser.noise_m, ground.as_kernel(), landing, craft)
    ground_knots = np.flatnonzero(phases == Phase.ON_GROUND.value)
    if end_s is not None:
        count = min(count, round((end_s - transit.path.start_s) / step) + 1)
    elif ground_knots.size:
        count = min(count, int(ground_knots[0]) + int(np.ceil(guidance.rest_s / step)))
    path = replace(transit.path, rows=rows[:count])
    return replace(transit, path=path, phases=phases[:count], autopilot=flight.autopilot)
