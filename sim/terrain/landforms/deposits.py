"""Albedo that follows the ground: layers of rock that relief exposes, and sand that the wind leaves in its lee."""

from typing import Annotated

import numpy as np
from numpy.random import Generator
from pydantic import Field

from marsyard.sim.parameters import Fraction, NonNegative, Parameters, Positive, bounded_field
from marsyard.sim.terrain.landforms.ground import Grid, TerrainGround, resample
from marsyard.sim.terrain.landforms.kernels.bedrock import expose_strata
from marsyard.sim.terrain.landforms.kernels.shapes import cast_lee
from marsyard.sim.terrain.landforms.relief import Dunes

_ROWS_PER_STRATUM = 32  #: Rows of the table of a stratum of mean thickness.


class Strata(Parameters):
    """Level layers of different brightness, which end in scarps where the ground cuts them.

    A stratum has a gently sloping tread and a steep scarp: the fraction `scarp_height` of its thickness is compressed
    to the fraction `scarp_width` of its outcrop. Thicknesses have a gamma distribution with the shape 3 (assumed).
    """

    thickness_m: Annotated[Positive, Field(description="mean thickness, m")] = 15.0
    log_albedo_rms: Annotated[Fraction, Field(description="RMS of the strata's log albedo")] = 0.08
    scarp_height: Annotated[Fraction, Field(description="fraction of the thickness that is in the scarp")] = 0.6
    scarp_width: Annotated[float, Field(gt=0.0, le=1.0, description="fraction of the outcrop that is the scarp")] = 0.2
    scarp_log_albedo: Annotated[float, bounded_field(-1.0, 1.0, "ln(albedo of scarps / of their strata)")] = 0.0

    def apply(self, ground: TerrainGround, rng: Generator) -> None:
        """Replace the heights by those of treads and scarps, and add the albedo of the strata."""
        lowest, highest = float(ground.height.min()), float(ground.height.max())
        count = int(2.0 * (highest - lowest) / self.thickness_m) + 8
        thickness = self.thickness_m * rng.gamma(3.0, 1.0 / 3.0, count)
        base = lowest - rng.uniform(0.0, thickness[0]) + np.concatenate([[0.0], np.cumsum(thickness)])
        log_albedo = self.log_albedo_rms * rng.standard_normal(count)
        rows = int((highest - lowest) / self.thickness_m * _ROWS_PER_STRATUM) + 2
        height = np.linspace(lowest, highest, rows)
        stratum = np.clip(np.searchsorted(base, height, side="right") - 1, 0, count - 1)
        fraction = (height - base[stratum]) / thickness[stratum]
        # the scarp is the lower end of a stratum's outcrop
        knots = [0.0, self.scarp_width, 1.0]
        exposed = base[stratum] + thickness[stratum] * np.interp(fraction, knots, [0.0, self.scarp_height, 1.0])
        scarp = self.scarp_log_albedo * (fraction < self.scarp_width)
        table = np.column_stack([exposed, log_albedo[stratum] + scarp])
        step = (highest - lowest) / (rows - 1) if highest > lowest else 1.0
        expose_strata(ground.height, ground.log_albedo, lowest, step, table)


class Drifts(Parameters):
    """Sand in the lee of relief: in craters, behind rims and crests, and at the foot of scarps.

    Behind a crest the wind shelters the ground below a surface that falls with `lee_slope_deg`; a separated flow
    reattaches after some ten heights of the obstacle. Sand covers the fraction ``d**2 / (1 + d**2)`` of ground that is
    d times `depth_m` below this surface. It can have bedforms.
    """

    wind_from_deg: Annotated[float, Field(ge=0.0, lt=360.0, description="azimuth from which the wind blows")] = 270.0
    wind_spread_deg: Annotated[NonNegative, Field(description="SD of this azimuth between terrains, deg")] = 10.0
    lee_slope_deg: Annotated[float, Field(gt=0.0, le=30.0, description="slope of the lee behind a crest")] = 6.0
    depth_m: Annotated[Positive, Field(description="depth in the lee at which sand covers half the ground, m")] = 3.0
    filled: Annotated[Fraction, Field(description="fraction of the lee's depth that the sand fills")] = 0.3
    log_albedo: Annotated[float, bounded_field(-1.0, 1.0, "ln(albedo of the sand / of the ground)")] = -0.2
    bedforms: Annotated[Dunes | None, Field(description="bedforms on the sand; None: smooth")] = None
    detail_m: Annotated[Positive, Field(description="spacing of the grid of the lee, m")] = 8.0

    def apply(self, ground: TerrainGround, rng: Generator) -> None:
        """Add the sand and its bedforms."""
        downwind = np.radians(270.0 - self.wind_from_deg - self.wind_spread_deg * rng.standard_normal())
        layer = ground.coarser(self.detail_m)
        step = ground.side // layer.side
        height = np.ascontiguousarray(ground.height[::step, ::step])
        depth = compute_lee(height, layer.spacing_m, float(downwind), float(np.tan(np.radians(self.lee_slope_deg))))
        depth -= height
        square = np.square(depth / np.float32(self.depth_m))
        coverage = square / (square + np.float32(1.0))
        np.multiply(coverage, np.float32(self.log_albedo), out=layer.log_albedo)
        np.multiply(coverage, np.float32(self.filled) * depth, out=layer.height)
        ground.add(layer)
        if self.bedforms is not None:
            bedforms = self.bedforms.create_layer(ground, rng)
            coverage = resample(coverage, bedforms.side)
            bedforms.height[...] *= coverage
            bedforms.log_albedo[...] *= coverage
            ground.add(bedforms)


def compute_lee(height: Grid, spacing_m: float, downwind_rad: float, slope: float) -> Grid:
    """Compute the surface that bounds the lee of periodic ground: nowhere below the ground, falling with `slope`.

    `downwind_rad` is the direction to which the wind blows, counter-clockwise from x.
    """
    x, y = np.cos(downwind_rad), np.sin(downwind_rad)
    is_along_rows = abs(y) >= abs(x)
    forward, sideways = (y, x) if is_along_rows else (x, y)
    order = np.s_[::1] if forward > 0.0 else np.s_[::-1]
    grid = np.ascontiguousarray((height if is_along_rows else height.T)[order])
    lee = cast_lee(grid, float(sideways / abs(forward)), float(slope * spacing_m / abs(forward)))[order]
    return np.array(lee if is_along_rows else lee.T)
