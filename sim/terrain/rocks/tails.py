"""Wind tails: ridges of sand and dust in the lee of rocks, and moats on the side of the wind."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.random import Generator
from pydantic import Field

from marsyard.sim.parameters import NonNegative, Parameters, Positive, bounded_field
from marsyard.sim.terrain.rocks.kernels import stamp_tails
from marsyard.sim.terrain.surface import Surface

if TYPE_CHECKING:
    from marsyard.sim.terrain.rocks.field import RockField

SAMPLES_ACROSS = 2.5  #: Minimum width of a tail in samples of the terrain; narrower tails are omitted.


class WindTails(Parameters):
    """Ridges in the lee of rocks, as in images of Spirit and Opportunity (Greeley et al. 2004; Sullivan et al. 2005).

    Like a shadow dune (Hesp 1981), a ridge has the rock's width at the rock and narrows to a point. Its height is the
    half width times the tangent of the angle of repose, limited to a fraction of the rock's height. The vortex in front
    of the rock digs a moat. Rocks are buried by at least 20 % of their height, a quarter of the part above the ground:
    a moat does not expose their undersides.
    """

    wind_from_deg: Annotated[float, Field(ge=0.0, lt=360.0, description="azimuth from which the wind blows")] = 330.0
    length_heights: Annotated[Positive, Field(description="median length in heights of the rock; assumed")] = 4.0
    length_spread: Annotated[NonNegative, Field(description="SD of the logarithm of the length; assumed")] = 0.4
    height_fraction: Annotated[float, bounded_field(0.0, 1.0, "maximum height in heights of the rock; assumed")] = 0.4
    moat_fraction: Annotated[float, bounded_field(0.0, 0.2, "depth of the moat in heights of the rock; assumed")] = 0.12
    repose_deg: Annotated[float, Field(ge=5.0, le=36.0, description="slope of the ridge's sides; assumed")] = 20.0
    log_albedo: Annotated[float, bounded_field(-1.0, 1.0, "logarithm of the ridge's albedo over the ground's")] = 0.0

    def apply(self, surface: Surface, rocks: RockField, rng: Generator) -> Surface:
        """Return the surface with the tails of all rocks; tails narrower than `SAMPLES_ACROSS` samples are omitted."""
        width = rocks.diameter_m
        length = self.length_heights * rocks.height_m * np.exp(self.length_spread * rng.standard_normal(width.size))
        height = np.minimum(self.height_fraction * rocks.height_m, 0.5 * width * np.tan(np.radians(self.repose_deg)))
        tails = np.column_stack(
            [rocks.position_m[:, :2], 0.5 * width, 0.5 * width + length, height, self.moat_fraction * rocks.height_m]
        )
        downwind = np.radians(90.0 - (self.wind_from_deg + 180.0))
        samples = np.array(surface.levels[0])
        wide_tails = tails[width >= SAMPLES_ACROSS * surface.spacing_m]
        stamp_tails(
            samples, surface.spacing_m, wide_tails, float(np.cos(downwind)), float(np.sin(downwind)), self.log_albedo
        )
        return Surface.from_samples(samples, surface.spacing_m, surface.factors)
