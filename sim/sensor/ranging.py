"""What ranging instruments share: their errors, and the true altitude to which readings are compared."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field, model_validator

from marsyard.sim.parameters import Parameters
from marsyard.sim.sensor.clock import Clock, ClockParameters
from marsyard.sim.sensor.instrument import Readings, Sampling
from marsyard.sim.terrain import Surface

#: Where an altimeter points in body axes, down at the identity attitude, as the descent camera does.
DOWN = np.array([0.0, 0.0, -1.0])


class RangingParameters(Parameters):
    """Errors of a ranging instrument. Shares of the range are one standard deviation."""

    rate_hz: Annotated[float, Field(gt=0.0, le=10000.0, description="readings per second")] = 10.0
    scale_error: Annotated[
        float, Field(ge=0.0, le=0.2, description="share of the range, common to all of a unit's readings")
    ] = 0.0
    noise: Annotated[float, Field(ge=0.0, le=0.2, description="share of the range, new in every reading")] = 0.0
    noise_m: Annotated[float, Field(ge=0.0, le=100.0, description="at any range, new in every reading, m")] = 0.0
    count_m: Annotated[float, Field(ge=0.0, le=100.0, description="range of a count, m; 0: no rounding")] = 0.0
    min_range_m: Annotated[float, Field(ge=0.0, description="shortest range that is read, m")] = 0.0
    max_range_m: Annotated[float, Field(gt=0.0, le=20000.0, description="longest range that is read, m")] = 5000.0
    clock: ClockParameters = ClockParameters()

    @model_validator(mode="after")
    def _ranges_in_order(self) -> RangingParameters:
        if self.min_range_m >= self.max_range_m:
            raise ValueError(
                f"min_range_m is {self.min_range_m}; allowed: less than max_range_m, which is {self.max_range_m}"
            )
        return self


@dataclass(frozen=True)
class RangingUnit:
    """The errors of one unit, drawn once.

    Attributes
    ----------
    parameters
        Its class.
    sampling, clock
        When it reads, and what its clock makes of that.
    scale
        What its readings are to true ranges, noise apart.
    """

    parameters: RangingParameters
    sampling: Sampling
    clock: Clock
    scale: float

    @classmethod
    def drawn(cls, parameters: RangingParameters, rng: np.random.Generator) -> RangingUnit:
        """A unit with its constant errors drawn."""
        return cls(
            parameters,
            Sampling.drawn(parameters.rate_hz, rng),
            Clock.drawn(parameters.clock, rng),
            1.0 + parameters.scale_error * float(rng.standard_normal()),
        )

    def readings(
        self, times_s: Float64[np.ndarray, "n"], ranges_m: Float64[np.ndarray, "n"], rng: np.random.Generator
    ) -> Readings:
        """What the unit delivers of true ranges (infinite where nothing returns) at true times."""
        p = self.parameters
        tags = self.clock.tags(times_s, rng)
        relative = self.scale + p.noise * rng.standard_normal(times_s.size)
        values = ranges_m * relative + p.noise_m * rng.standard_normal(times_s.size)
        if p.count_m > 0.0:
            values = p.count_m * np.rint(values / p.count_m)
        heard = (ranges_m >= p.min_range_m) & (ranges_m <= p.max_range_m)
        return Readings(tags, np.where(heard, values, np.nan))


def height_above_ground(surface: Surface, positions_m: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n"]:
    """True altitude: height above the ground straight below, metres."""
    return np.asarray(positions_m[:, 2] - surface.height(positions_m[:, 0], positions_m[:, 1]))
