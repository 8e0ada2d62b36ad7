"""Simulated flight of a helicopter under an autopilot in wind: for image acquisition, and to a site with landing."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
import scipy  # scipy.signal is slow to import: it is loaded at its first use
from jaxtyping import Float64, Int64

from marsyard.sim.dynamics.rotorcraft import kernels
from marsyard.sim.dynamics.rotorcraft.parameters import (
    AirParameters,
    LandingGuidance,
    RotorcraftParameters,
    TransitParameters,
    VibrationParameters,
)
from marsyard.sim.dynamics.trajectory import Motion, Trajectory, attitudes_and_body_rates, check_times


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

    def derivatives(
        self, times_s: Float64[np.ndarray, "n"]
    ) -> tuple[Float64[np.ndarray, "3 n 3"], Float64[np.ndarray, "3 n 3"]]:
        """Compute displacement, rate and acceleration (first axis) of the positions, and of the angles."""
        phases = self.rate_rad_s * times_s[:, None] + self.phases_rad
        orders = [self.amplitudes * self.rate_rad_s**k * np.sin(phases + 0.5 * np.pi * k) for k in range(3)]
        positions, angles = np.split(np.stack(orders), 2, axis=-1)
        return positions, angles


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
        shakes, (twist, twist_rate, _) = self.vibration.derivatives(times_s)
        attitudes, rates = attitudes_and_body_rates(angles + twist, angle_rates + twist_rate)
        path = self._interpolate(interval, elapsed_s, kernels.POSITION)
        derivatives = [vector + shake for vector, shake in zip(path, shakes, strict=True)]
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


#: Duration of the flight after the last image; it is needed because the camera's clock can be late.
TAIL_S = 0.1


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
class AltimeterErrors:
    """Errors of the laser altimeter during the landing.

    - scale: reading / true range
    - noise_m: noise of the reading at each knot from the flight's start on
    - stuck_m: the constant reading of a failed altimeter
    - count_m: resolution of the readings, 0 without rounding
    - limits_m: minimum and maximum true range; there is no return beyond them
    - axis: direction of measurement, body axes
    """

    scale: float
    noise_m: Float64[np.ndarray, "knots"]
    stuck_m: float | None = None
    count_m: float = 0.0
    limits_m: tuple[float, float] = (0.0, np.inf)
    axis: tuple[float, float, float] = (0.0, 0.0, -1.0)


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
    reference[:, : kernels.VELOCITY] += first_image_position_m
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
    rows[0, : kernels.VELOCITY] = reference[0, : kernels.VELOCITY]
    rows[0, kernels.ANGLE : kernels.RATE] = [heading_rad, pitch, roll]
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
    ground: kernels.GroundPatch,
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
    start = transit_knots - 1
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
        hover_m=float(rows[start, kernels.POSITION + 2] + padded_errors[start, kernels.POSITION + 2]),
        wait_until=start + round((guidance.wait_s - TAIL_S) / step),
        laser_scale=laser.scale,
        laser_stuck_m=np.nan if laser.stuck_m is None else laser.stuck_m,
        laser_count_m=laser.count_m,
        laser_min_m=laser.limits_m[0],
        laser_max_m=laser.limits_m[1],
        laser_x=laser.axis[0],
        laser_y=laser.axis[1],
        laser_z=laser.axis[2],
    )
    flight = kernels.Flight(rows, transit.autopilot.copy(), transit.heading_rad, air.mean_m_s, air.gusts_m_s, step)
    craft = transit.craft.to_kernel(transit.path.gravity_m_s2)
    kernels.land(flight, phases, start, padded_errors, laser.noise_m, ground, landing, craft)
    ground_knots = np.flatnonzero(phases == Phase.ON_GROUND.value)
    if end_s is not None:
        count = min(count, round((end_s - transit.path.start_s) / step) + 1)
    elif ground_knots.size:
        count = min(count, int(ground_knots[0]) + int(np.ceil(guidance.rest_s / step)))
    path = replace(transit.path, rows=rows[:count])
    return replace(transit, path=path, phases=phases[:count], autopilot=flight.autopilot)
