"""Time tags: what an instrument's clock says of an instant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from marsyard.sim.parameters import Parameters

Spread = Annotated[float, Field(ge=0.0, le=10.0)]


class ClockParameters(Parameters):
    """Errors of time tags: tagged less true time."""

    offset_s: Annotated[float, Field(ge=-10.0, le=10.0, description="mean of the constant offset, s")] = 0.0
    offset_sd_s: Annotated[Spread, Field(description="spread of the constant offset between units, s")] = 0.0
    jitter_sd_s: Annotated[Spread, Field(description="spread of the tags about the offset, new in each, s")] = 0.0


@dataclass(frozen=True)
class Clock:
    """One instrument's clock; its offset is drawn once.

    Attributes
    ----------
    parameters
        Its errors.
    offset_s
        Constant part of tagged less true time, seconds.
    """

    parameters: ClockParameters
    offset_s: float

    @classmethod
    def drawn(cls, parameters: ClockParameters, rng: np.random.Generator) -> Clock:
        """A clock with its offset drawn."""
        return cls(parameters, parameters.offset_s + parameters.offset_sd_s * float(rng.standard_normal()))

    def tags(self, times_s: Float64[np.ndarray, "n"], rng: np.random.Generator) -> Float64[np.ndarray, "n"]:
        """Time tags of events at these true times, seconds."""
        jitter = self.parameters.jitter_sd_s * rng.standard_normal(times_s.size)
        return np.asarray(times_s + self.offset_s + jitter)
