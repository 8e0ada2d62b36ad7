"""GPS receiver: positions with white and time-correlated errors ("wander"); the antenna is at the body's origin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.random import Generator
from pydantic import Field

from marsyard.sim.dynamics import Trajectory
from marsyard.sim.error_sources import RECEIVER
from marsyard.sim.parameters import Parameters
from marsyard.sim.sensor.instrument import Clock, ClockParameters, GaussMarkov, Readings, Sampling, Times

Deviation = Annotated[float, Field(ge=0.0, le=1000.0)]  #: Standard deviation, m or m/s.


class GpsParameters(Parameters):
    """Parameters of a GPS receiver; errors are standard deviations per axis."""

    rate_hz: Annotated[float, Field(gt=0.0, le=1000.0, description="fixes per second")] = 10.0
    horizontal_noise_m: Annotated[Deviation, RECEIVER, Field(description="white noise per fix, m")] = 0.3
    vertical_noise_m: Annotated[Deviation, RECEIVER, Field(description="white noise per fix, m")] = 0.6
    horizontal_wander_m: Annotated[Deviation, RECEIVER, Field(description="time-correlated error, m")] = 1.5
    vertical_wander_m: Annotated[Deviation, RECEIVER, Field(description="time-correlated error, m")] = 3.0
    correlation_s: Annotated[float, Field(gt=0.0, description="correlation time, s")] = 300.0
    latency_s: Annotated[float, RECEIVER, Field(ge=0.0, le=10.0, description="delay from fix to delivery, s")] = 0.1
    clock: ClockParameters = ClockParameters()


#: Carrier-phase positions, post-processed with precise orbits (as by GIPSY-OASIS II).
POST_PROCESSED = GpsParameters(
    rate_hz=1.0, horizontal_noise_m=0.02, vertical_noise_m=0.03, horizontal_wander_m=0.05, vertical_wander_m=0.1,
    correlation_s=600.0, latency_s=0.0,
)  # fmt: skip


@dataclass(frozen=True)
class Gps:
    """A GPS receiver with sampled time-correlated errors, which are valid in a time span."""

    parameters: GpsParameters
    sampling: Sampling
    clock: Clock
    wander: GaussMarkov

    @classmethod
    def draw(cls, parameters: GpsParameters, span_s: tuple[float, float], rng: Generator) -> Gps:
        """Draw the errors for use within a time span."""
        p = parameters
        sd = np.array([p.horizontal_wander_m, p.horizontal_wander_m, p.vertical_wander_m])
        sampling, clock = Sampling.draw(p.rate_hz, rng), Clock.draw(p.clock, rng)
        return cls(p, sampling, clock, GaussMarkov.draw(sd, p.correlation_s, span_s, rng))

    def measure(self, trajectory: Trajectory, times_s: Times, rng: Generator) -> Readings:
        """Measure one position per true time, world axes; delivery is `latency_s` later."""
        p = self.parameters
        tags = self.clock.tags(times_s, rng)
        sd = np.array([p.horizontal_noise_m, p.horizontal_noise_m, p.vertical_noise_m])
        noise = sd * rng.standard_normal((times_s.size, 3))
        return Readings(tags, trajectory.motion(times_s).positions_m + self.wander.at(times_s) + noise)
