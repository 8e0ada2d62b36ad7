"""A helicopter's flight back and forth along a line while it climbs, its camera on a gimbal (field test paper, III.C).

The flight begins and ends with a slow pass over surveyed targets. In between the helicopter flies passes along a
horizontal line, each in the direction opposite to the one before; between two passes it slows down, turns about and
comes back. It climbs on the passes and turns level. The stabilised platform keeps the gimbal's base level and its
azimuth, or turns it with the helicopter; the gimbal tilts the camera along and across, and swings it on some passes.

Every coordinate is a piecewise quintic polynomial or such a polynomial times a sine: twice continuously
differentiable, so that velocity, rates and specific force are exact derivatives of position and attitude.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field, model_validator
from scipy.interpolate import BPoly
from scipy.spatial.transform import Rotation

from marsyard.sim.dynamics.angles import turning
from marsyard.sim.dynamics.trajectory import Motion, Trajectory
from marsyard.sim.parameters import Parameters, Positive


class HelicopterParameters(Parameters):
    """A flight. Numbers are the field test paper's (III.C, III.D) unless they are called assumed.

    At 1 m/s on passes of 100 s, with turns of 60 s, ten passes climb from 1000 m to 2000 m in 27 min: the paper says
    1 to 2 m/s, about 30 min of pictures, and about 40 min between the passes over the targets.
    """

    passes: Annotated[int, Field(ge=1, le=100, description="passes along the line")] = 10
    pass_s: Annotated[Positive, Field(le=1000.0, description="duration of a pass, s (assumed)")] = 100.0
    turn_s: Annotated[Positive, Field(le=1000.0, description="duration of a turn, s (assumed)")] = 60.0
    speed_m_s: Annotated[Positive, Field(le=100.0, description="mean speed along a pass, m/s")] = 30.0
    speed_change_m_s: Annotated[
        float, Field(ge=0.0, le=10.0, description="RMS change of speed within a pass, m/s (assumed)")
    ] = 1.0
    lowest_m: Annotated[Positive, Field(description="height of the first pass's start above the line's ground, m")] = (
        1000.0
    )
    climb_m_s: Annotated[float, Field(ge=0.0, le=10.0, description="climb on a pass, m/s")] = 1.0
    wander_m: Annotated[float, Field(ge=0.0, le=200.0, description="RMS distance from the line, m (assumed)")] = 8.0
    pointing_deg: Annotated[
        float, Field(ge=0.0, le=45.0, description="RMS tilt of the camera along and across the flight (assumed)")
    ] = 9.0
    most_tilt_deg: Annotated[float, Field(ge=0.0, le=45.0, description="greatest tilt along and across")] = 30.0
    swinging_share: Annotated[
        float, Field(ge=0.0, le=1.0, description="share of passes on which the gimbal swings the camera (assumed)")
    ] = 0.5
    swing_rate_deg_s: Annotated[float, Field(ge=0.0, le=120.0, description="greatest rate of the swinging")] = 60.0
    swing_hz: Annotated[Positive, Field(le=5.0, description="frequency of the swinging, 1/s (assumed)")] = 0.6
    platform_deg: Annotated[
        float, Field(ge=0.0, le=10.0, description="RMS of what the stabilised platform leaves of the motion (assumed)")
    ] = 0.2
    turns_with_flight: Annotated[
        bool,
        Field(
            description="whether the platform turns about with the helicopter; if not it keeps its azimuth (assumed)"
        ),
    ] = False
    fly_over_m: Annotated[Positive, Field(description="height of the passes over the targets, m (assumed)")] = 500.0
    fly_over_m_s: Annotated[Positive, Field(description="speed of the passes over the targets, m/s (assumed)")] = 3.0
    fly_over_s: Annotated[Positive, Field(le=120.0, description="duration of a pass over the targets, s")] = 90.0
    between_s: Annotated[Positive, Field(description="time between the passes over the targets, s")] = 2400.0
    approach_s: Annotated[
        Positive, Field(description="from the end of the first pass over the targets to the first pass, s (assumed)")
    ] = 350.0

    @model_validator(mode="after")
    def _there_is_time_to_come_back(self) -> HelicopterParameters:
        if self.return_s <= 0.0:
            raise ValueError(
                f"passes and turns of {self.collection_s} s do not fit into the {self.between_s} s between the passes "
                "over the targets"
            )
        return self

    @property
    def length_m(self) -> float:
        """Length of the line."""
        return self.speed_m_s * self.pass_s

    @property
    def collection_s(self) -> float:
        """From the start of the first pass to the end of the last."""
        return self.passes * self.pass_s + (self.passes - 1) * self.turn_s

    @property
    def return_s(self) -> float:
        """From the end of the last pass to the start of the second pass over the targets."""
        return self.between_s - self.fly_over_s - self.approach_s - self.collection_s


@dataclass(frozen=True)
class FlownPass:
    """A pass along the line: its number, when it was flown, and its direction, +1 or -1 along the line."""

    number: int
    start_s: float
    end_s: float
    direction: int


@dataclass(frozen=True)
class Tilt:
    """An angle of the gimbal over time: a pointing, and a swinging of varying size about it; radians."""

    pointing: BPoly
    swing: BPoly
    swing_rad_s: float

    def derivatives(self, times_s: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "2 n"]:
        """The angle and its rate."""
        size, growth = self.swing(times_s), self.swing.derivative()(times_s)
        sine, cosine = np.sin(self.swing_rad_s * times_s), np.cos(self.swing_rad_s * times_s)
        rate = self.pointing.derivative()(times_s) + growth * sine + size * self.swing_rad_s * cosine
        return np.stack([self.pointing(times_s) + size * sine, rate])


@dataclass(frozen=True)
class HelicopterFlight(Trajectory):
    """A flight, known from the start of the first pass over the targets to the end of the second.

    The body frame is the camera's: x along the line, y to its left, z up when the gimbal is at rest and the platform
    not turned; the camera looks along -z. Time 0 is the middle of the first pass over the targets.

    Attributes
    ----------
    origin_m
        World point at ground level in the middle of the line, above which heights count.
    azimuth_rad
        Direction of the line, clockwise from north.
    along, across, up
        Distance along the line from its middle, to the left of it, and above the origin, metres.
    turned
        Angle of the platform from the line, counterclockwise, radians.
    tilt_along, tilt_across
        The gimbal's angles, about the body's y axis (positive: looks back) and then about its x axis (positive: looks
        to the right).
    passes
        The passes along the line, in the order flown.
    fly_overs_s
        Start and end of both passes over the targets.
    gravity_m_s2
        Acceleration of gravity.
    """

    origin_m: Float64[np.ndarray, "3"]
    azimuth_rad: float
    along: BPoly
    across: BPoly
    up: BPoly
    turned: BPoly
    tilt_along: Tilt
    tilt_across: Tilt
    passes: tuple[FlownPass, ...]
    fly_overs_s: tuple[tuple[float, float], tuple[float, float]]
    gravity_m_s2: float

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last time at which the motion is known."""
        return self.fly_overs_s[0][0], self.fly_overs_s[1][1]

    def motion(self, times_s: Float64[np.ndarray, "n"]) -> Motion:
        """Truth at many times. Raises ValueError outside of the span."""
        first, last = self.span_s
        if times_s.size and (times_s.min() < first or times_s.max() > last):
            raise ValueError(f"the flight is known from {first} s to {last} s, not at {times_s.min()}..{times_s.max()}")
        attitudes, rates = self._turning(times_s)
        weightless = self._moving(times_s, 2) + np.array([0.0, 0.0, self.gravity_m_s2])
        return Motion(
            times_s=times_s,
            positions_m=self.origin_m + self._moving(times_s, 0),
            velocities_m_s=self._moving(times_s, 1),
            attitudes=attitudes,
            body_rates_rad_s=rates,
            specific_forces_m_s2=attitudes.inv().apply(weightless),
        )

    def _moving(self, times_s: Float64[np.ndarray, "n"], order: int) -> Float64[np.ndarray, "n 3"]:
        """Place relative to the origin, or a derivative of it, world axes."""
        along, across, up = (one.derivative(order)(times_s) for one in (self.along, self.across, self.up))
        forward = np.array([np.sin(self.azimuth_rad), np.cos(self.azimuth_rad), 0.0])
        left = np.array([-forward[1], forward[0], 0.0])
        place: Float64[np.ndarray, "n 3"] = np.outer(along, forward) + np.outer(across, left)
        place[:, 2] += up
        return place

    def _turning(self, times_s: Float64[np.ndarray, "n"]) -> tuple[Rotation, Float64[np.ndarray, "n 3"]]:
        """Attitudes, and angular velocities in body axes."""
        yaw = 0.5 * np.pi - self.azimuth_rad + self.turned(times_s)
        yaw_rate = self.turned.derivative()(times_s)
        pitch, pitch_rate = self.tilt_along.derivatives(times_s)
        roll, roll_rate = self.tilt_across.derivatives(times_s)
        angles = np.stack([yaw, pitch, roll], axis=-1)
        return turning(angles, np.stack([yaw_rate, pitch_rate, roll_rate], axis=-1))


def helicopter_flight(
    parameters: HelicopterParameters,
    origin_m: Float64[np.ndarray, "3"],
    azimuth_rad: float,
    gravity_m_s2: float,
    rng: np.random.Generator,
) -> HelicopterFlight:
    """A flight along a line through a point of the ground, its irregularities drawn from this stream."""
    p = parameters
    flown = _passes(p)
    half = 0.5 * p.fly_over_s
    fly_overs = ((-half, half), (p.between_s - half, p.between_s + half))
    times = np.arange(fly_overs[0][0], fly_overs[1][1] + 15.0, 15.0)
    return HelicopterFlight(
        origin_m=origin_m,
        azimuth_rad=azimuth_rad,
        along=_along(p, flown, fly_overs, rng),
        across=_resting(times, p.wander_m * rng.standard_normal(times.size)),
        up=_up(p, flown, fly_overs),
        turned=_turned(p, flown, fly_overs),
        tilt_along=_tilt(p, flown, times, rng),
        tilt_across=_tilt(p, flown, times, rng),
        passes=flown,
        fly_overs_s=fly_overs,
        gravity_m_s2=gravity_m_s2,
    )


def _passes(p: HelicopterParameters) -> tuple[FlownPass, ...]:
    first = 0.5 * p.fly_over_s + p.approach_s
    starts = [first + number * (p.pass_s + p.turn_s) for number in range(p.passes)]
    return tuple(FlownPass(k, start, start + p.pass_s, 1 - 2 * (k % 2)) for k, start in enumerate(starts))


#: Breakpoints within a pass, at which the speed is a little off the mean.
_WITHIN_PASS = 4


def _along(
    p: HelicopterParameters,
    flown: Sequence[FlownPass],
    fly_overs_s: Sequence[tuple[float, float]],
    rng: np.random.Generator,
) -> BPoly:
    """Distance along the line."""
    reach = 0.5 * p.fly_over_s * p.fly_over_m_s
    points = [(fly_overs_s[0][0], -reach, p.fly_over_m_s), (fly_overs_s[0][1], reach, p.fly_over_m_s)]
    for one in flown:
        share = np.linspace(0.0, 1.0, _WITHIN_PASS + 2)
        changes = p.speed_change_m_s * rng.standard_normal(share.size)
        changes[[0, -1]] = 0.0
        places = one.direction * p.length_m * (share - 0.5)
        speeds = one.direction * (p.speed_m_s + changes)
        times = one.start_s + share * (one.end_s - one.start_s)
        points += list(zip(times.tolist(), places.tolist(), speeds.tolist(), strict=True))
    points += [(fly_overs_s[1][0], -reach, p.fly_over_m_s), (fly_overs_s[1][1], reach, p.fly_over_m_s)]
    return _moving(points)


def _up(p: HelicopterParameters, flown: Sequence[FlownPass], fly_overs_s: Sequence[tuple[float, float]]) -> BPoly:
    """Height above the origin."""
    points = [(time, p.fly_over_m, 0.0) for time in fly_overs_s[0]]
    gained = p.climb_m_s * p.pass_s
    for one in flown:
        start = p.lowest_m + one.number * gained
        points += [(one.start_s, start, p.climb_m_s), (one.end_s, start + gained, p.climb_m_s)]
    points += [(time, p.fly_over_m, 0.0) for time in fly_overs_s[1]]
    return _moving(points)


def _turned(p: HelicopterParameters, flown: Sequence[FlownPass], fly_overs_s: Sequence[tuple[float, float]]) -> BPoly:
    """The platform's angle: where it turns with the flight, half a turn after each pass, left and right in turns."""
    angles = [np.pi if one.direction < 0 and p.turns_with_flight else 0.0 for one in flown]
    points = [(time, 0.0) for time in fly_overs_s[0]]
    points += [(time, angle) for one, angle in zip(flown, angles, strict=True) for time in (one.start_s, one.end_s)]
    points += [(time, 0.0) for time in fly_overs_s[1]]
    times, values = zip(*points, strict=True)
    return _resting(np.array(times), np.array(values))


def _tilt(
    p: HelicopterParameters, flown: Sequence[FlownPass], times: Float64[np.ndarray, "n"], rng: np.random.Generator
) -> Tilt:
    """An angle of the gimbal: a new pointing every few seconds on the passes, none over the targets."""
    on_pass = np.any([(times > one.start_s) & (times < one.end_s) for one in flown], axis=0)
    limit = p.most_tilt_deg
    pointing = np.clip(p.pointing_deg * rng.standard_normal(times.size), -limit, limit) * on_pass
    pointing = pointing + p.platform_deg * rng.standard_normal(times.size)
    swing_rad_s = 2.0 * np.pi * p.swing_hz
    # both axes swing: each has the rate over the square root of 2
    largest = np.radians(p.swing_rate_deg_s) / np.sqrt(2.0) / swing_rad_s
    sizes = np.zeros(times.size)
    for one in flown:
        swings = rng.uniform() < p.swinging_share
        size = largest * rng.uniform(0.2, 1.0)
        inside = (times > one.start_s) & (times < one.end_s)
        sizes[inside] = size if swings else 0.0
    return Tilt(_resting(times, np.radians(pointing)), _resting(times, sizes), swing_rad_s)


def _moving(points: Sequence[tuple[float, float, float]]) -> BPoly:
    """The curve through (time, value, rate), without acceleration there."""
    return BPoly.from_derivatives([time for time, _, _ in points], [[value, rate, 0.0] for _, value, rate in points])


def _resting(times_s: Float64[np.ndarray, "n"], values: Float64[np.ndarray, "n"]) -> BPoly:
    """The curve through values, at rest at each of them."""
    zero = np.zeros_like(values)
    return BPoly.from_derivatives(times_s, np.stack([values, zero, zero], axis=-1))
