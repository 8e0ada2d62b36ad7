"""A satellite receiver that works on carrier phases against a base station: position, velocity, and how good they are.

Its solution is *fixed* while the phases' ambiguities are known as integers, and *floating* otherwise: each has a
wandering and a white error of its own size. The receiver changes between them at random times, and delivers nothing
during an outage. Errors are those of the antenna, which is taken to sit at the body's origin.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float64
from pydantic import Field, model_validator

from marsyard.sim.dynamics import Trajectory
from marsyard.sim.parameters import Parameters, Positive
from marsyard.sim.sensor.clock import Clock, ClockParameters
from marsyard.sim.sensor.instrument import Sampling
from marsyard.sim.sensor.stochastic import GaussMarkov

NonNegative = Annotated[float, Field(ge=0.0, le=1000.0)]
#: East, north, up.
PerAxis = tuple[NonNegative, NonNegative, NonNegative]


class SolutionErrors(Parameters):
    """Errors of one kind of solution, one standard deviation towards east, north and up."""

    wander_m: Annotated[PerAxis, Field(description="wanders with the correlation time, m")]
    noise_m: Annotated[PerAxis, Field(description="new in every solution, m")]
    correlation_s: Annotated[Positive, Field(le=10000.0, description="correlation time of the wandering error, s")]

    @property
    def total_m(self) -> Float64[np.ndarray, "3"]:
        """Standard deviation of the position."""
        return np.hypot(self.wander_m, self.noise_m)


class Outage(Parameters):
    """A time without solutions."""

    start_s: Annotated[float, Field(description="true time at which it begins, s")]
    duration_s: Annotated[Positive, Field(description="how long it lasts, s")]


class RtkParameters(Parameters):
    """A receiver of the class of NovAtel's RT2.

    Fixed: 2 cm, the class's specification. Floating: within the deviations of the landing paper's Table II, 0.35 to
    0.7 m. All else is assumed.
    """

    rate_hz: Annotated[Positive, Field(le=100.0, description="solutions per second")] = 10.0
    latency_s: Annotated[float, Field(ge=0.0, le=2.0, description="from a solution's time to its delivery, s")] = 0.07
    fixed: SolutionErrors = SolutionErrors(
        wander_m=(0.01, 0.01, 0.02), noise_m=(0.008, 0.008, 0.015), correlation_s=120.0
    )
    floating: SolutionErrors = SolutionErrors(
        wander_m=(0.42, 0.55, 0.8), noise_m=(0.03, 0.03, 0.05), correlation_s=120.0
    )
    float_share: Annotated[float, Field(ge=0.0, le=1.0, description="share of the time with a floating solution")] = 0.1
    float_s: Annotated[Positive, Field(description="mean duration of a floating solution, s")] = 60.0
    velocity_noise_m_s: Annotated[PerAxis, Field(description="of velocity, new in every solution, m/s")] = (
        0.03,
        0.03,
        0.05,
    )
    velocity_wander_m_s: Annotated[PerAxis, Field(description="of velocity, wanders, m/s")] = (0.01, 0.01, 0.02)
    velocity_correlation_s: Annotated[Positive, Field(description="correlation time of that, s")] = 10.0
    reported_spread: Annotated[
        float, Field(ge=0.0, le=1.0, description="spread of the logarithm of reported over true deviation, per flight")
    ] = 0.1
    outages: Annotated[tuple[Outage, ...], Field(description="times without solutions")] = ()
    clock: ClockParameters = ClockParameters(offset_sd_s=0.001, jitter_sd_s=0.0002)

    @model_validator(mode="after")
    def _a_share_can_be_held(self) -> RtkParameters:
        if 0.0 < self.float_share < 1.0 and self.float_s * (1.0 / self.float_share - 1.0) < 1.0 / self.rate_hz:
            raise ValueError(f"a float_share of {self.float_share} leaves fixed solutions less than one reading")
        return self


@dataclass(frozen=True)
class RtkSolutions:
    """What the receiver delivers, `latency_s` after each solution's time.

    Attributes
    ----------
    times_s
        Time tags, seconds.
    positions_m, velocities_m_s
        World axes; not a number during an outage.
    reported_m
        The receiver's own estimate of its position's standard deviation, east, north and up.
    fixed
        Whether the solution was fixed.
    """

    times_s: Float64[np.ndarray, "n"]
    positions_m: Float64[np.ndarray, "n 3"]
    velocities_m_s: Float64[np.ndarray, "n 3"]
    reported_m: Float64[np.ndarray, "n 3"]
    fixed: Bool[np.ndarray, "n"]


@dataclass(frozen=True)
class RtkReceiver:
    """One receiver: what wanders over a span of time is drawn once, its noise with the solutions.

    Attributes
    ----------
    parameters, sampling, clock
        Its class, when it measures, and what its clock makes of that.
    fixed_wander, floating_wander, velocity_wander
        Its wandering errors.
    first_floating, changes_s
        Whether the solution floats at first, and the true times at which that changes.
    reported_factor
        Reported over true standard deviation.
    """

    parameters: RtkParameters
    sampling: Sampling
    clock: Clock
    fixed_wander: GaussMarkov
    floating_wander: GaussMarkov
    velocity_wander: GaussMarkov
    first_floating: bool
    changes_s: Float64[np.ndarray, "changes"] = field(repr=False)
    reported_factor: float

    @classmethod
    def drawn(cls, parameters: RtkParameters, span_s: tuple[float, float], rng: np.random.Generator) -> RtkReceiver:
        """A receiver with its errors drawn for use within a span of time."""
        p = parameters
        floating = bool(rng.random() < p.float_share)
        wanders = [
            GaussMarkov.drawn(np.array(sd), time, span_s, rng)
            for sd, time in (
                (p.fixed.wander_m, p.fixed.correlation_s),
                (p.floating.wander_m, p.floating.correlation_s),
                (p.velocity_wander_m_s, p.velocity_correlation_s),
            )
        ]
        return cls(
            parameters=p,
            sampling=Sampling.drawn(p.rate_hz, rng),
            clock=Clock.drawn(p.clock, rng),
            fixed_wander=wanders[0],
            floating_wander=wanders[1],
            velocity_wander=wanders[2],
            first_floating=floating,
            changes_s=_changes(p, floating, span_s, rng),
            reported_factor=float(np.exp(p.reported_spread * rng.standard_normal())),
        )

    def floats(self, times_s: Float64[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
        """Whether the solution floats at true times."""
        changed = np.searchsorted(self.changes_s, times_s, side="right") % 2 == 1
        return np.asarray(changed != self.first_floating)

    def measure(
        self, trajectory: Trajectory, times_s: Float64[np.ndarray, "n"], rng: np.random.Generator
    ) -> RtkSolutions:
        """One solution at each true time."""
        p = self.parameters
        motion, floating = trajectory.motion(times_s), self.floats(times_s)[:, None]
        tags = self.clock.tags(times_s, rng)
        shocks = rng.standard_normal((times_s.size, 6))
        wander = np.where(floating, self.floating_wander.at(times_s), self.fixed_wander.at(times_s))
        noise = np.where(floating, p.floating.noise_m, p.fixed.noise_m)
        positions = motion.positions_m + wander + noise * shocks[:, :3]
        velocities = motion.velocities_m_s + self.velocity_wander.at(times_s) + p.velocity_noise_m_s * shocks[:, 3:]
        silent = np.zeros(times_s.size, dtype=bool)
        for one in p.outages:
            silent |= (times_s >= one.start_s) & (times_s < one.start_s + one.duration_s)
        positions[silent], velocities[silent] = np.nan, np.nan
        reported = self.reported_factor * np.where(floating, p.floating.total_m, p.fixed.total_m)
        return RtkSolutions(tags, positions, velocities, reported, ~floating[:, 0])


def _changes(
    p: RtkParameters, floating: bool, span_s: tuple[float, float], rng: np.random.Generator
) -> Float64[np.ndarray, "changes"]:
    """Times at which the kind of solution changes: durations are exponential, the process stationary."""
    if p.float_share in (0.0, 1.0):
        return np.zeros(0)
    means = {True: p.float_s, False: p.float_s * (1.0 / p.float_share - 1.0)}
    times: list[float] = []
    now = span_s[0]
    while True:
        now += means[floating] * float(rng.standard_exponential())
        if now > span_s[1]:
            return np.array(times)
        times.append(now)
        floating = not floating
