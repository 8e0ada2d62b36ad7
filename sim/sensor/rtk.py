"""RTK (real-time kinematic) satellite receiver: positions, velocities and standard deviations.

The receiver compares carrier phases of satellites with a base station. Its solution is *fixed* while the integer phase
ambiguities are resolved, and *floating* otherwise; each type has its own time-correlated errors ("wander") and white
errors. The type changes at random times. There are no solutions during an outage. The antenna is at the body's origin.

The landing paper is Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float64
from numpy.random import Generator
from pydantic import Field, model_validator

from marsyard.sim.dynamics import Trajectory
from marsyard.sim.error_sources import RECEIVER
from marsyard.sim.parameters import Fraction, Parameters, Positive
from marsyard.sim.sensor.gps import Deviation
from marsyard.sim.sensor.instrument import Clock, ClockParameters, GaussMarkov, Sampling, Times, Vectors

PerAxis = tuple[Deviation, Deviation, Deviation]  #: East, north, up.


class SolutionErrors(Parameters):
    """Errors of one type of solution: standard deviations along east, north and up."""

    wander_m: Annotated[PerAxis, RECEIVER, Field(description="time-correlated error, m")]
    noise_m: Annotated[PerAxis, RECEIVER, Field(description="white noise per solution, m")]
    correlation_s: Annotated[Positive, Field(le=10000.0, description="correlation time, s")]

    @property
    def total_m(self) -> Float64[np.ndarray, "3"]:
        """Total standard deviation of the position."""
        return np.hypot(self.wander_m, self.noise_m)


_FIXED = SolutionErrors(wander_m=(0.01, 0.01, 0.02), noise_m=(0.008, 0.008, 0.015), correlation_s=120.0)
_FLOATING = SolutionErrors(wander_m=(0.42, 0.55, 0.8), noise_m=(0.03, 0.03, 0.05), correlation_s=120.0)


class Outage(Parameters):
    """An interval without solutions."""

    start_s: Annotated[float, Field(description="true start time, s")]
    duration_s: Annotated[Positive, Field(description="duration, s")]


class RtkParameters(Parameters):
    """Parameters of an RTK receiver like NovAtel's RT2.

    Fixed solutions: 2 cm, the specification of such receivers. Floating solutions: within the deviations in Table II of
    the landing paper, 0.35 to 0.7 m. All other values are assumed.
    """

    rate_hz: Annotated[Positive, Field(le=100.0, description="solutions per second")] = 10.0
    latency_s: Annotated[float, Field(ge=0.0, le=2.0, description="delay from solution to delivery, s")] = 0.07
    fixed: SolutionErrors = _FIXED
    floating: SolutionErrors = _FLOATING
    float_fraction: Annotated[Fraction, Field(description="fraction of the time with a floating solution")] = 0.1
    float_s: Annotated[Positive, Field(description="mean duration of a floating solution, s")] = 60.0
    velocity_noise_m_s: Annotated[PerAxis, RECEIVER, Field(description="velocity noise per solution")] = (
        0.03,
        0.03,
        0.05,
    )
    velocity_wander_m_s: Annotated[PerAxis, RECEIVER, Field(description="velocity wander, m/s")] = (0.01, 0.01, 0.02)
    velocity_correlation_s: Annotated[Positive, Field(description="correlation time of the velocity error, s")] = 10.0
    reported_spread: Annotated[Fraction, Field(description="sd of log(reported / true deviation)")] = 0.1
    outages: Annotated[tuple[Outage, ...], Field(description="times without solutions")] = ()
    clock: ClockParameters = ClockParameters(offset_sd_s=0.001, jitter_sd_s=0.0002)

    @model_validator(mode="after")
    def _check_fixed_duration(self) -> RtkParameters:
        if 0.0 < self.float_fraction < 1.0 and self.float_s * (1.0 / self.float_fraction - 1.0) < 1.0 / self.rate_hz:
            raise ValueError(f"float_fraction {self.float_fraction} makes fixed solutions shorter than one reading")
        return self


@dataclass(frozen=True)
class RtkSolutions:
    """Solutions of an RTK receiver, delivered `latency_s` after their time.

    - positions_m, velocities_m_s: world axes; NaN during an outage
    - reported_m: standard deviation of the position reported by the receiver, east, north and up
    - fixed: whether the solution is fixed
    """

    times_s: Times
    positions_m: Vectors
    velocities_m_s: Vectors
    reported_m: Vectors
    fixed: Bool[np.ndarray, "n"]


@dataclass(frozen=True)
class RtkReceiver:
    """An RTK receiver with sampled time-correlated errors, which are valid in a time span.

    - starts_floating, changes_s: whether the first solution is floating, and true times of the type changes
    - reported_factor: ratio of the reported to the true standard deviation
    """

    parameters: RtkParameters
    sampling: Sampling
    clock: Clock
    fixed_wander: GaussMarkov
    floating_wander: GaussMarkov
    velocity_wander: GaussMarkov
    starts_floating: bool
    changes_s: Times = field(repr=False)
    reported_factor: float

    @classmethod
    def draw(cls, parameters: RtkParameters, span_s: tuple[float, float], rng: Generator) -> RtkReceiver:
        """Draw the errors for use within a time span."""
        p = parameters
        floating = bool(rng.random() < p.float_fraction)
        fixed_wander, floating_wander, velocity_wander = (
            GaussMarkov.draw(np.array(sd), correlation_s, span_s, rng)
            for sd, correlation_s in (
                (p.fixed.wander_m, p.fixed.correlation_s),
                (p.floating.wander_m, p.floating.correlation_s),
                (p.velocity_wander_m_s, p.velocity_correlation_s),
            )
        )
        sampling, clock = Sampling.draw(p.rate_hz, rng), Clock.draw(p.clock, rng)
        changes = _draw_changes(p, floating, span_s, rng)
        factor = float(np.exp(p.reported_spread * rng.standard_normal()))
        return cls(p, sampling, clock, fixed_wander, floating_wander, velocity_wander, floating, changes, factor)

    def is_floating(self, times_s: Times) -> Bool[np.ndarray, "n"]:
        """Return whether the solution is floating at true times."""
        has_changed = np.searchsorted(self.changes_s, times_s, side="right") % 2 == 1
        return np.asarray(has_changed != self.starts_floating)

    def measure(self, trajectory: Trajectory, times_s: Times, rng: Generator) -> RtkSolutions:
        """Simulate one solution per true time."""
        p = self.parameters
        motion, floating = trajectory.motion(times_s), self.is_floating(times_s)[:, None]
        tags = self.clock.tags(times_s, rng)
        position_noise, velocity_noise = np.split(rng.standard_normal((times_s.size, 6)), 2, axis=1)
        wander = np.where(floating, self.floating_wander.at(times_s), self.fixed_wander.at(times_s))
        noise = np.where(floating, p.floating.noise_m, p.fixed.noise_m)
        positions = motion.positions_m + wander + noise * position_noise
        velocities = motion.velocities_m_s + self.velocity_wander.at(times_s)
        velocities = velocities + p.velocity_noise_m_s * velocity_noise
        for outage in p.outages:
            is_outage = (times_s >= outage.start_s) & (times_s < outage.start_s + outage.duration_s)
            positions[is_outage], velocities[is_outage] = np.nan, np.nan
        reported = self.reported_factor * np.where(floating, p.floating.total_m, p.fixed.total_m)
        return RtkSolutions(tags, positions, velocities, reported, ~floating[:, 0])


def _draw_changes(p: RtkParameters, floating: bool, span_s: tuple[float, float], rng: Generator) -> Times:
    """Draw the times at which the type of solution changes: a stationary process with exponential durations."""
    if p.float_fraction in (0.0, 1.0):
        return np.zeros(0)
    mean_durations = {True: p.float_s, False: p.float_s * (1.0 / p.float_fraction - 1.0)}
    times: list[float] = []
    time = span_s[0]
    while True:
        time += mean_durations[floating] * float(rng.standard_exponential())
        if time > span_s[1]:
            return np.array(times)
        times.append(time)
        floating = not floating
