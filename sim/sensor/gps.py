"""GPS receiver: positions with white and time-correlated errors ("wander"); the antenna is at the body's origin.

The positions are processed after the flight: they are available at all times, without delay.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.random import Generator
from pydantic import Field

from marsyard.sim.dynamics import Trajectory
from marsyard.sim.error_sources import RECEIVER
from marsyard.sim.parameters import Parameters
from marsyard.sim.sensor.instrument import Clock, ClockParameters, GaussMarkov, Times, Vectors

Deviation = Annotated[float, Field(ge=0.0, le=1000.0)]  #: Standard deviation, m or m/s.


class GpsParameters(Parameters):
    """Parameters of a GPS receiver; errors are standard deviations per axis."""

    horizontal_noise_m: Annotated[Deviation, RECEIVER, Field(description="white noise per fix, m")] = 0.3
    vertical_noise_m: Annotated[Deviation, RECEIVER, Field(description="white noise per fix, m")] = 0.6
    horizontal_wander_m: Annotated[Deviation, RECEIVER, Field(description="time-correlated error, m")] = 1.5
    vertical_wander_m: Annotated[Deviation, RECEIVER, Field(description="time-correlated error, m")] = 3.0
    correlation_s: Annotated[float, Field(gt=0.0, description="correlation time, s")] = 300.0
    clock: ClockParameters = ClockParameters()


#: Carrier-phase positions, post-processed with precise orbits (as by GIPSY-OASIS II).
POST_PROCESSED = GpsParameters(
    horizontal_noise_m=0.02, vertical_noise_m=0.03, horizontal_wander_m=0.05, vertical_wander_m=0.1,
    correlation_s=600.0,
)  # fmt: skip


@dataclass(frozen=True)
class Gps:
    """A GPS receiver with sampled time-correlated errors, which are valid in a time span."""

    parameters: GpsParameters
    clock: Clock
    wander: GaussMarkov

    @classmethod
    def draw(cls, parameters: GpsParameters, span_s: tuple[float, float], rng: Generator) -> Gps:
        """Draw the errors for use within a time span."""
        p = parameters
        sd = np.array([p.horizontal_wander_m, p.horizontal_wander_m, p.vertical_wander_m])
        clock = Clock.draw(p.clock, rng)
        return cls(p, clock, GaussMarkov.draw(sd, p.correlation_s, span_s, rng))

    def measure(self, trajectory: Trajectory, tags_s: Times, rng: Generator) -> Vectors:
        """Measure the position at each time tag of the receiver, world axes."""
        p = self.parameters
        times = tags_s - (self.clock.tags(tags_s, rng) - tags_s)
        sd = np.array([p.horizontal_noise_m, p.horizontal_noise_m, p.vertical_noise_m])
        noise = sd * rng.standard_normal((times.size, 3))
        return np.asarray(trajectory.motion(times).positions_m + self.wander.at(times) + noise)
