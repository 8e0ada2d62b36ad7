"""Helicopter flight in climbing passes along a line, with a camera on a gimbal (field test paper, III.C).

The flight begins and ends with a slow pass over surveyed targets. Between these the helicopter flies passes along a
line in alternating directions. It climbs on the passes, each at a rate of its own, and turns at constant height between
them. The last pass ends at the maximum height; the helicopter flies on to the end of the line without images. The
gimbal is mounted on a stabilised platform, which is level and has a constant azimuth or rotates with the helicopter.
The gimbal tilts the camera along and across the line, and swings it on some passes.

Every coordinate is a piecewise quintic polynomial, or such a polynomial times a sine. It is twice continuously
differentiable: velocity, rates and specific force are exact derivatives of position and attitude.

The field test paper is Johnson et al., "Field Testing of the MER DIMES".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field, model_validator
from scipy.interpolate import BPoly

from marsyard.sim.dynamics.rotorcraft import Vibration, VibrationParameters
from marsyard.sim.dynamics.trajectory import Motion, Trajectory, attitudes_and_body_rates, check_times
from marsyard.sim.parameters import Fraction, Parameters, Positive, bounded_field

Vector = Float64[np.ndarray, "3"]
Angle = Annotated[float, Field(ge=0.0, le=45.0)]

#: Number of points within a pass at which the speed is drawn.
_SPEED_POINTS = 4
#: Minimum duration of a turn: a reversal of 30 m/s in this time takes up to 4.5 m/s2, a bank angle of 25 deg.
_MIN_TURN_S = 20.0
#: Time between the points at which distance from the line, pointing and swing are drawn.
_POINT_SPACING_S = 15.0


class HelicopterParameters(Parameters):
    """Parameters of a flight. Values are from the field test paper (III.C, III.D) unless marked as assumed.

    Each pass has a rate of climb from a uniform distribution. The number of passes follows: the last pass ends at the
    maximum height. The turns have equal durations, and share the time of the collection that the passes leave. With the
    defaults, nine to twelve passes take about 11 of the 30 min. The paper reports a climb of 1 to 2 m/s, images for
    about 30 min, and about 40 min between the passes over the targets. The approach climbs at 1.7 m/s on average.
    """

    pass_s: Annotated[Positive, Field(le=1000.0, description="duration of a pass (assumed)")] = 70.0
    collection_s: Annotated[
        Positive, Field(description="time from the start of the first to the end of the last pass")
    ] = 1800.0
    speed_m_s: Annotated[Positive, Field(le=100.0, description="mean speed along a pass")] = 30.0
    speed_change_m_s: Annotated[float, bounded_field(0.0, 10.0, "RMS change of speed within a pass (assumed)")] = 1.0
    lowest_m: Annotated[Positive, Field(description="initial height of the first pass above the line's ground")] = (
        1000.0
    )
    highest_m: Annotated[Positive, Field(description="height above the line's ground that ends the last pass")] = 2000.0
    min_climb_m_s: Annotated[float, bounded_field(0.1, 10.0, "minimum rate of climb on a pass")] = 1.0
    max_climb_m_s: Annotated[float, bounded_field(0.1, 10.0, "maximum rate of climb on a pass")] = 2.0
    wander_m: Annotated[float, bounded_field(0.0, 200.0, "RMS distance from the line (assumed)")] = 8.0
    pointing_deg: Annotated[
        Angle, Field(description="RMS tilt along and across the line (assumed: flights reach the maximum)")
    ] = 12.0
    max_tilt_deg: Annotated[Angle, Field(description="maximum angle off nadir of pointing and swing")] = 45.0
    swinging_fraction: Annotated[Fraction, Field(description="fraction of passes with a swinging camera (assumed)")] = (
        0.5
    )
    swing_rate_deg_s: Annotated[float, bounded_field(0.0, 120.0, "maximum rate of the swinging")] = 60.0
    swing_hz: Annotated[Positive, Field(le=5.0, description="frequency of the swinging, 1/s (assumed)")] = 0.6
    platform_deg: Annotated[float, bounded_field(0.0, 10.0, "RMS residual motion of the platform (assumed)")] = 0.2
    turns_with_flight: Annotated[bool, Field(description="the platform rotates with the helicopter (assumed)")] = False
    fly_over_m: Annotated[Positive, Field(description="height of the passes over the targets (assumed)")] = 500.0
    fly_over_m_s: Annotated[Positive, Field(description="speed of the passes over the targets (assumed)")] = 3.0
    fly_over_s: Annotated[Positive, Field(le=120.0, description="duration of a pass over the targets")] = 90.0
    between_s: Annotated[Positive, Field(description="time between the passes over the targets")] = 2500.0
    approach_s: Annotated[Positive, Field(description="time from the targets to the first pass (assumed)")] = 300.0
    vibration: Annotated[VibrationParameters, Field(description="platform vibration at the blades' rate (assumed)")] = (
        VibrationParameters(rate_hz=13.0, acceleration_m_s2=1.0, angle_deg=0.005)
    )

    @model_validator(mode="after")
    def _check_climb(self) -> HelicopterParameters:
        if self.max_climb_m_s < self.min_climb_m_s:
            raise ValueError(
                f"max_climb_m_s is {self.max_climb_m_s}; allowed: at least min_climb_m_s, {self.min_climb_m_s}"
            )
        if self.highest_m <= self.lowest_m:
            raise ValueError(f"highest_m is {self.highest_m}; allowed: more than lowest_m, {self.lowest_m}")
        return self

    @model_validator(mode="after")
    def _check_times(self) -> HelicopterParameters:
        max_passes_s = (self.highest_m - self.lowest_m) / self.min_climb_m_s
        min_collection_s = max_passes_s + _MIN_TURN_S * max(np.ceil(max_passes_s / self.pass_s) - 1.0, 0.0)
        if self.collection_s < min_collection_s:
            raise ValueError(
                f"collection_s is {self.collection_s}; allowed: at least {min_collection_s:.6g}, the time of passes "
                f"at min_climb_m_s with turns of {_MIN_TURN_S:.0f} s"
            )
        # after the last image the helicopter flies at most another pass to the end of the line
        flight_s = self.fly_over_s + self.approach_s + self.collection_s + self.pass_s
        if flight_s >= self.between_s:
            raise ValueError(
                f"a pass over the targets, the approach, the collection and the rest of its last pass, {flight_s} s, "
                f"do not fit into the {self.between_s} s between the passes over the targets"
            )
        return self

    @property
    def length_m(self) -> float:
        """Length of the line."""
        return self.speed_m_s * self.pass_s


@dataclass(frozen=True)
class FlightPass:
    """A pass along the line.

    - number, direction: number from 0, and direction of flight, +1 or -1 along the line
    - start_s, end_s: start and end; the last pass ends at the maximum height
    - start_m, climb_m_s: initial height above the line's ground, and rate of climb
    """

    number: int
    direction: int
    start_s: float
    end_s: float
    start_m: float
    climb_m_s: float

    @property
    def end_m(self) -> float:
        """Final height above the line's ground."""
        return self.start_m + self.climb_m_s * (self.end_s - self.start_s)


@dataclass(frozen=True)
class Tilt:
    """An angle of the gimbal over time, radians: pointing + amplitude sin(swing_rad_s t)."""

    pointing: BPoly
    amplitude: BPoly
    swing_rad_s: float

    def derivatives(self, times_s: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "2 n"]:
        """Compute the angle and its rate."""
        amplitude, amplitude_rate = self.amplitude(times_s), self.amplitude.derivative()(times_s)
        sine, cosine = np.sin(self.swing_rad_s * times_s), np.cos(self.swing_rad_s * times_s)
        rate = self.pointing.derivative()(times_s) + amplitude_rate * sine + amplitude * self.swing_rad_s * cosine
        return np.stack([self.pointing(times_s) + amplitude * sine, rate])


@dataclass(frozen=True)
class HelicopterFlight(Trajectory):
    """A flight from the start of the first pass over the targets to the end of the second.

    The body frame is the camera's; the camera looks along -z. If the gimbal's angles are zero and the platform has its
    initial azimuth, x is along the line, y to its left and z up. Time 0 is the middle of the first pass over the
    targets.

    - origin_m: world point at ground level in the middle of the line, reference of the heights
    - azimuth_rad: direction of the line, clockwise from north
    - along, across, up: coordinates along the line from its middle, to its left, and above the origin, metres
    - platform: angle of the platform from the line, counterclockwise, radians
    - tilt_along, tilt_across: the gimbal's angles, about the body's y axis (positive: the camera looks backwards) and
      then about its x axis (positive: it looks to the right)
    - fly_overs_s: start and end of both passes over the targets
    """

    origin_m: Float64[np.ndarray, "3"]
    azimuth_rad: float
    along: BPoly
    across: BPoly
    up: BPoly
    platform: BPoly
    tilt_along: Tilt
    tilt_across: Tilt
    passes: tuple[FlightPass, ...]
    fly_overs_s: tuple[tuple[float, float], tuple[float, float]]
    gravity_m_s2: float
    vibration: Vibration

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last time of the flight."""
        return self.fly_overs_s[0][0], self.fly_overs_s[1][1]

    def motion(self, times_s: Float64[np.ndarray, "n"]) -> Motion:
        """Compute the true states at many times. Raises ValueError for times outside the span."""
        check_times(times_s, self.span_s)
        yaw = 0.5 * np.pi - self.azimuth_rad + self.platform(times_s)
        pitch, pitch_rate = self.tilt_along.derivatives(times_s)
        roll, roll_rate = self.tilt_across.derivatives(times_s)
        angle_rates = np.stack([self.platform.derivative()(times_s), pitch_rate, roll_rate], axis=-1)
        shakes, (twist, twist_rate, _) = self.vibration.derivatives(times_s)
        angles = np.stack([yaw, pitch, roll], axis=-1) + twist
        attitudes, rates = attitudes_and_body_rates(angles, angle_rates + twist_rate)
        forward = np.array([np.sin(self.azimuth_rad), np.cos(self.azimuth_rad), 0.0])
        left = np.array([-forward[1], forward[0], 0.0])
        derivatives = []
        for order in range(3):
            along, across, up = (curve.derivative(order)(times_s) for curve in (self.along, self.across, self.up))
            derivatives.append(np.outer(along, forward) + np.outer(across, left) + shakes[order])
            derivatives[order][:, 2] += up
        derivatives[0] = self.origin_m + derivatives[0]
        return Motion.from_accelerations(times_s, derivatives, attitudes, rates, self.gravity_m_s2)


def draw_helicopter_flight(
    p: HelicopterParameters, origin_m: Vector, azimuth_rad: float, gravity_m_s2: float, rng: np.random.Generator
) -> HelicopterFlight:
    """Draw a flight along a line whose middle is above `origin_m`, a point of the ground."""
    half_s = 0.5 * p.fly_over_s
    passes = _draw_passes(p, half_s + p.approach_s, rng)
    fly_overs = ((-half_s, half_s), (p.between_s - half_s, p.between_s + half_s))
    times = np.arange(fly_overs[0][0], fly_overs[1][1] + _POINT_SPACING_S, _POINT_SPACING_S)
    # points of the curves: (time, value, rate) or (time, value). Height and platform angle are constant over the
    # targets. A platform that rotates with the helicopter rotates by 180 deg after each pass, forward and back
    half_m, speed = half_s * p.fly_over_m_s, p.fly_over_m_s
    positions = [point for start, end in fly_overs for point in ((start, -half_m, speed), (end, half_m, speed))]
    heights = [(time, p.fly_over_m, 0.0) for times_s in fly_overs for time in times_s]
    angles = [(time, 0.0) for times_s in fly_overs for time in times_s]
    fraction = np.linspace(0.0, 1.0, _SPEED_POINTS + 2)
    for flight_pass in passes:
        changes = p.speed_change_m_s * rng.standard_normal(fraction.size)
        changes[[0, -1]] = 0.0
        distances = flight_pass.direction * p.length_m * (fraction - 0.5)
        speeds = flight_pass.direction * (p.speed_m_s + changes)
        # also on the last pass, which ends before the end of the line
        pass_times = flight_pass.start_s + fraction * p.pass_s
        positions += list(zip(pass_times.tolist(), distances.tolist(), speeds.tolist(), strict=True))
        heights += [(flight_pass.start_s, flight_pass.start_m, flight_pass.climb_m_s)]
        heights += [(flight_pass.end_s, flight_pass.end_m, flight_pass.climb_m_s)]
        angle = np.pi if flight_pass.direction < 0 and p.turns_with_flight else 0.0
        angles += [(flight_pass.start_s, angle), (flight_pass.end_s, angle)]
    tilt_along, tilt_across = _draw_tilts(p, passes, times, rng)
    return HelicopterFlight(
        origin_m=origin_m,
        azimuth_rad=azimuth_rad,
        along=_fit_rates(sorted(positions)),
        across=_fit_zero_rates(times, p.wander_m * rng.standard_normal(times.size)),
        up=_fit_rates(sorted(heights)),
        platform=_fit_zero_rates(*np.array(sorted(angles)).T),
        tilt_along=tilt_along,
        tilt_across=tilt_across,
        passes=passes,
        fly_overs_s=fly_overs,
        gravity_m_s2=gravity_m_s2,
        vibration=Vibration.draw(p.vibration, rng),
    )


def _draw_passes(p: HelicopterParameters, start_s: float, rng: np.random.Generator) -> tuple[FlightPass, ...]:
    """Draw the passes, in alternating directions, from a start time until the helicopter reaches the maximum height."""
    climbs_m_s, heights_m = [], [p.lowest_m]
    while heights_m[-1] < p.highest_m:
        climbs_m_s.append(float(rng.uniform(p.min_climb_m_s, p.max_climb_m_s)))
        heights_m.append(heights_m[-1] + climbs_m_s[-1] * p.pass_s)
    heights_m[-1] = p.highest_m
    durations_s = np.diff(heights_m) / climbs_m_s
    turn_s = (p.collection_s - durations_s.sum()) / max(len(climbs_m_s) - 1, 1)
    passes = []
    for number, (climb_m_s, duration_s) in enumerate(zip(climbs_m_s, durations_s.tolist(), strict=True)):
        end_s = start_s + duration_s
        passes.append(FlightPass(number, 1 - 2 * (number % 2), start_s, end_s, heights_m[number], climb_m_s))
        start_s = end_s + turn_s
    return tuple(passes)


def _draw_tilts(
    p: HelicopterParameters, passes: Sequence[FlightPass], times: Float64[np.ndarray, "n"], rng: np.random.Generator
) -> tuple[Tilt, Tilt]:
    """Draw the gimbal's angles over time: pointing and swing on the passes; elsewhere only residual motion.

    The pointing is reduced where pointing and swing together would exceed the maximum angle off nadir.
    """
    on_pass = np.any([(times > flight_pass.start_s) & (times < flight_pass.end_s) for flight_pass in passes], axis=0)
    swing_rad_s = 2.0 * np.pi * p.swing_hz
    # both axes swing: the maximum rate of each is the parameter divided by sqrt(2)
    max_amplitude = np.radians(p.swing_rate_deg_s) / np.sqrt(2.0) / swing_rad_s
    amplitudes = np.zeros((2, times.size))
    for flight_pass in passes:
        is_inside = (times > flight_pass.start_s) & (times < flight_pass.end_s)
        for axis in range(2):
            has_swing = rng.uniform() < p.swinging_fraction
            amplitude = max_amplitude * rng.uniform(0.2, 1.0)  # from a fifth of the maximum (assumed)
            amplitudes[axis, is_inside] = amplitude if has_swing else 0.0
    pointing = np.radians(p.pointing_deg * rng.standard_normal((2, times.size)) * on_pass)
    limit = np.maximum(np.radians(p.max_tilt_deg) - np.linalg.norm(amplitudes, axis=0), 0.0)
    pointing *= np.minimum(1.0, limit / np.maximum(np.linalg.norm(pointing, axis=0), 1e-9))
    pointing += np.radians(p.platform_deg) * rng.standard_normal((2, times.size))
    along, across = (
        Tilt(_fit_zero_rates(times, angles), _fit_zero_rates(times, swing), swing_rad_s)
        for angles, swing in zip(pointing, amplitudes, strict=True)
    )
    return along, across


def _fit_rates(points: Sequence[tuple[float, float, float]]) -> BPoly:
    """Fit a curve through points (time, value, rate), with zero acceleration at each point."""
    return BPoly.from_derivatives([time for time, _, _ in points], [[value, rate, 0.0] for _, value, rate in points])


def _fit_zero_rates(times_s: Float64[np.ndarray, "n"], values: Float64[np.ndarray, "n"]) -> BPoly:
    """Fit a curve through values, with zero rate and zero acceleration at each of them."""
    zero = np.zeros_like(values)
    return BPoly.from_derivatives(times_s, np.stack([values, zero, zero], axis=-1))
