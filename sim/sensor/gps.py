"""A satellite navigation receiver: position with white and wandering errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from marsyard.sim.dynamics import Trajectory
from marsyard.sim.parameters import Parameters
from marsyard.sim.sensor.clock import Clock, ClockParameters
from marsyard.sim.sensor.instrument import Readings, Sampling
from marsyard.sim.sensor.stochastic import GaussMarkov

NonNegative = Annotated[float, Field(ge=0.0, le=1000.0)]


class GpsParameters(Parameters):
    """A receiver. Spreads are one standard deviation per axis; the vertical is worse than the horizontal."""

    rate_hz: Annotated[float, Field(gt=0.0, le=1000.0, description="fixes per second")] = 10.0
    horizontal_noise_m: Annotated[NonNegative, Field(description="new in every fix, m")] = 0.3
    vertical_noise_m: Annotated[NonNegative, Field(description="new in every fix, m")] = 0.6
    horizontal_wander_m: Annotated[NonNegative, Field(description="wanders with the correlation time, m")] = 1.5
    vertical_wander_m: Annotated[NonNegative, Field(description="wanders with the correlation time, m")] = 3.0
    correlation_s: Annotated[float, Field(gt=0.0, description="correlation time of the wandering error, s")] = 300.0
    latency_s: Annotated[float, Field(ge=0.0, le=10.0, description="from a fix to its delivery, s")] = 0.1
    clock: ClockParameters = ClockParameters()


#: Carrier phases after the fact, with precise orbits, in flight (the class of GIPSY-OASIS II).
POST_PROCESSED = GpsParameters(
    rate_hz=1.0,
    horizontal_noise_m=0.02,
    vertical_noise_m=0.03,
    horizontal_wander_m=0.05,
    vertical_wander_m=0.1,
    correlation_s=600.0,
    latency_s=0.0,
)


@dataclass(frozen=True)
class Gps:
    """One receiver at the body's origin; its wandering error over a span of time is drawn once."""

    parameters: GpsParameters
    sampling: Sampling
    clock: Clock
    wander: GaussMarkov

    @classmethod
    def drawn(cls, parameters: GpsParameters, span_s: tuple[float, float], rng: np.random.Generator) -> Gps:
        """A receiver with its errors drawn for use within a span of time."""
        p = parameters
        sd = np.array([p.horizontal_wander_m, p.horizontal_wander_m, p.vertical_wander_m])
        return cls(
            p,
            Sampling.drawn(p.rate_hz, rng),
            Clock.drawn(p.clock, rng),
            GaussMarkov.drawn(sd, p.correlation_s, span_s, rng),
        )

    def measure(self, trajectory: Trajectory, times_s: Float64[np.ndarray, "n"], rng: np.random.Generator) -> Readings:
        """One fix at each true time, world axes. A fix is delivered `latency_s` after that time."""
        p = self.parameters
        tags = self.clock.tags(times_s, rng)
        sd = np.array([p.horizontal_noise_m, p.horizontal_noise_m, p.vertical_noise_m])
        noise = sd * rng.standard_normal((times_s.size, 3))
        return Readings(tags, trajectory.motion(times_s).positions_m + self.wander.at(times_s) + noise)

    def delivered(self, readings: Readings, by_s: float) -> Readings:
        """Those of its fixes that have been delivered by a time of its own clock."""
        arrived = readings.times_s + self.parameters.latency_s <= by_s
        return Readings(readings.times_s[arrived], readings.values[arrived])
