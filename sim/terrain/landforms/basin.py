"""A desert basin: alluvial fans that run down from divides, and playas with desiccation polygons between them."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from jaxtyping import Float64
from numpy.random import Generator
from pydantic import Field

from marsyard.sim.parameters import NonNegative, Parameters, Positive
from marsyard.sim.terrain.landforms.bedrock import locate_points
from marsyard.sim.terrain.landforms.ground import TerrainGround, refine, resample
from marsyard.sim.terrain.landforms.kernels.bedrock import add_cracks
from marsyard.sim.terrain.landforms.kernels.shapes import cut_channels, raise_cones
from marsyard.sim.terrain.landforms.relief import draw_channels

APEX_ROUNDING = 0.06  #: Rounding of a fan's apex, as a fraction of its radius.
CONE_DETAIL = 1.0 / 50.0  #: Scale of the smallest detail of the fans' broad shape, as a fraction of their radius.


class Playa(Parameters):
    """Desiccation polygons: dark or bright fissures with a specified spacing, and a finer net between them.

    Giant polygons are known from many playas of the Great Basin (Neal, Langer & Kerr 1968). They are tens to hundreds
    of metres wide. Their fissures are about a metre wide, with fills of another brightness.
    """

    polygon_m: Annotated[Positive, Field(description="width of the polygons, m")] = 60.0
    fissure_m: Annotated[Positive, Field(description="half width over which a fissure fades, m")] = 3.0
    fissure_depth_m: Annotated[NonNegative, Field(description="depth of a fissure, m")] = 0.1
    contrast: Annotated[float, Field(ge=-2.0, le=2.0, description="ln(albedo of fissures / of the plates)")] = -0.12

    def apply(self, ground: TerrainGround, rng: Generator) -> None:
        """Add fissures to the whole terrain."""
        ground.add(self.compute_fissures(ground, rng))

    def compute_fissures(self, ground: TerrainGround, rng: Generator) -> TerrainGround:
        """Compute the fissures on a separate grid."""
        layer = ground.coarser(self.fissure_m)
        for scale in (1.0, 0.4):
            cells = max(round(ground.period_m / (scale * self.polygon_m)), 3)
            points = locate_points(rng.uniform(0.1, 0.9, (cells, cells, 2)))
            width = max(scale * self.fissure_m, layer.spacing_m)
            depth, contrast = scale * self.fissure_depth_m, scale * self.contrast
            cell_m = ground.period_m / cells
            add_cracks(layer.height, layer.log_albedo, layer.spacing_m, points, cell_m, width, depth, contrast)
        return layer


class Fans(Parameters):
    """Alluvial fans that run down from a divide to an almost level playa.

    The divides run from west to east with equal spacing, the first along y = 0. Fans face north and south of each
    divide, and a playa lies midway between two divides. Radial profiles flatten towards the toe; slopes of 1-5 deg are
    usual (Blair & McPherson 1994). Washes spread from the apexes. Existing relief is unchanged on the fans, and
    multiplied by `playa_relief` on the playa, which can have polygons.
    """

    slope_deg: Annotated[float, Field(gt=0.0, le=15.0, description="slope at the apex")] = 4.5
    divides: Annotated[int, Field(ge=1, le=20, description="number of divides, hence of playas")] = 2
    radius_m: Annotated[Positive, Field(description="mean distance from apex to toe, m")] = 1300.0
    apex_spacing_m: Annotated[Positive, Field(description="distance between apexes, m")] = 600.0
    concavity: Annotated[float, Field(ge=1.0, le=3.0, description="1: straight profile; larger: flatter toe")] = 1.15
    playa_relief: Annotated[float, Field(ge=0.0, le=1.0, description="factor of existing relief on the playa")] = 0.05
    washes_per_fan: Annotated[int, Field(ge=0, le=500, description="channels on a fan")] = 50
    wash_width_m: Annotated[Positive, Field(description="median width of a wash, m")] = 9.0
    wash_depth_m: Annotated[NonNegative, Field(description="median depth of a wash, m")] = 0.7
    wash_contrast: Annotated[float, Field(ge=-1.0, le=1.0, description="ln(albedo of washes / of the fan)")] = 0.06
    fan_contrast: Annotated[float, Field(ge=-2.0, le=2.0, description="ln(albedo of fans / of the playa)")] = -0.12

    polygons: Annotated[Playa | None, Field(description="desiccation polygons on the playa")] = None

    def apply(self, ground: TerrainGround, rng: Generator) -> None:
        """Add the fans and their washes; flatten the playa."""
        count = max(round(ground.period_m / self.apex_spacing_m), 1)
        apex_x = (np.tile(np.arange(count), self.divides) + rng.uniform(-0.3, 0.3, count * self.divides)) / count
        divide_y = np.repeat(np.arange(self.divides), count) / self.divides
        offset = rng.uniform(-0.06, 0.06, apex_x.size) * self.radius_m
        radius = self.radius_m * rng.uniform(0.85, 1.15, apex_x.size)
        y = (divide_y * ground.period_m + offset) % ground.period_m
        apexes = np.column_stack([apex_x * ground.period_m, y, radius])
        # until the fans are complete, the albedo grid of `cones` contains their coverage: 1 on a fan, 0 on the playa
        cones = ground.coarser(CONE_DETAIL * self.radius_m)
        slope = float(np.tan(np.radians(self.slope_deg)))
        rounding = APEX_ROUNDING * self.radius_m
        raise_cones(cones.height, cones.log_albedo, cones.spacing_m, apexes, slope, self.concavity, rounding)
        if self.polygons is not None:
            fissures = self.polygons.compute_fissures(ground, rng)
            playa_fraction = np.float32(1.0) - resample(cones.log_albedo, fissures.side)
            np.multiply(fissures.height, playa_fraction, out=fissures.height)
            np.multiply(fissures.log_albedo, playa_fraction, out=fissures.log_albedo)
        factor = np.float32(self.playa_relief) + np.float32(1.0 - self.playa_relief) * cones.log_albedo
        factor = refine(factor, ground.side)
        np.multiply(ground.height, factor, out=ground.height)
        np.multiply(ground.log_albedo, factor, out=ground.log_albedo)
        cones.log_albedo[...] *= np.float32(self.fan_contrast)
        ground.add(cones)
        if self.polygons is not None:
            ground.add(fissures)
        if self.washes_per_fan:
            self._add_washes(ground, apexes, rng)

    def _add_washes(self, ground: TerrainGround, apexes: Float64[np.ndarray, "fans 3"], rng: Generator) -> None:
        """Cut the washes of all fans; `apexes` has rows (x, y, radius)."""
        # until the channels are complete, the albedo grid of `layer` contains their depth
        layer = ground.coarser(self.wash_width_m / 3.0)
        count = self.washes_per_fan
        for x, y, radius in apexes:
            # on both sides of the divide, within 30 deg of the steepest descent
            heading = rng.choice([-1.0, 1.0], count) * np.pi / 2.0 + rng.uniform(-0.52, 0.52, count)
            start_radius = radius * rng.uniform(0.02, 0.5, count)
            width = self.wash_width_m * np.exp(0.5 * rng.standard_normal(count))
            depth = self.wash_depth_m * np.exp(0.4 * rng.standard_normal(count))
            start = np.array([x, y]) + start_radius[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
            length = radius * rng.uniform(0.9, 1.05, count) - start_radius
            discs = draw_channels(start, heading, np.maximum(length, width), width, depth, 0.06, rng)
            cut_channels(layer.log_albedo, layer.spacing_m, discs, 2.0)
        layer.height[...] = -layer.log_albedo
        layer.log_albedo[...] *= np.float32(self.wash_contrast / max(self.wash_depth_m, 1e-6))
        np.clip(layer.log_albedo, -0.5, 0.5, out=layer.log_albedo)
        ground.add(layer)
