"""Altitude above the ground as an altimeter measures it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import BaseModel, ConfigDict, Field

from sim.terrain import Surface


class AltimeterParameters(BaseModel):
    """Errors of an altimeter. Shares of the altitude are one standard deviation."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    scale_error: Annotated[
        float, Field(ge=0.0, le=0.2, description="share of the altitude, common to a descent's measurements")
    ] = 0.003
    noise: Annotated[float, Field(ge=0.0, le=0.2, description="share of the altitude, new in every measurement")] = (
        0.0015
    )
    beam_m: Annotated[
        float, Field(gt=0.0, le=2000.0, description="width of the ground patch whose mean height is measured, m")
    ] = 200.0


@dataclass(frozen=True)
class Altimeter:
    """An altimeter over one terrain; its scale error is drawn once."""

    parameters: AltimeterParameters
    surface: Surface
    scale: float

    @classmethod
    def drawn(cls, parameters: AltimeterParameters, surface: Surface, rng: np.random.Generator) -> Altimeter:
        """An altimeter with a scale error drawn from this stream."""
        return cls(parameters, surface, 1.0 + parameters.scale_error * float(rng.standard_normal()))

    def true_altitude(self, position_m: Float64[np.ndarray, "3"]) -> float:
        """Height above the mean ground of the beam's patch, metres."""
        samples = self.parameters.beam_m / self.surface.spacing_m
        level = int(np.clip(np.rint(np.log2(max(samples, 1.0))), 0, len(self.surface.levels) - 1))
        return float(position_m[2] - self.surface.height(position_m[0], position_m[1], level))

    def measure(self, position_m: Float64[np.ndarray, "3"], rng: np.random.Generator) -> float:
        """One measurement from this true position, metres."""
        altitude = self.true_altitude(position_m)
        return altitude * (self.scale + self.parameters.noise * float(rng.standard_normal()))
