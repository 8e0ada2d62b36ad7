"""A desert basin: alluvial fans around a playa, and the playa's polygons."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from marsyard.sim.terrain.landforms.channels import walk
from marsyard.sim.terrain.landforms.ground import Ground, LandformParameters, finer, fitted
from marsyard.sim.terrain.landforms.kernels import add_cracks, cut_channels, raise_cones

#: Rounding of a fan's apex, as a share of its radius.
APEX_ROUNDING = 0.06
#: Scale of the smallest detail of the fans' broad shape, as a share of their radius.
CONE_DETAIL = 1.0 / 50.0


class Playa(LandformParameters):
    """Desiccation polygons: fissures of a stated spacing, dark or bright, and a finer net between them.

    Giant polygons, tens to hundreds of metres wide with fissures about a metre wide whose fills look different from
    above, are known from many playas of the Great Basin (Neal, Langer & Kerr 1968).
    """

    polygon_m: Annotated[float, Field(gt=0.0, description="width of the polygons, m")] = 60.0
    fissure_m: Annotated[float, Field(gt=0.0, description="half width over which a fissure fades, m")] = 3.0
    fissure_depth_m: Annotated[float, Field(ge=0.0, description="depth of a fissure, m")] = 0.1
    contrast: Annotated[float, Field(ge=-2.0, le=2.0, description="log albedo of fissures over the plates'")] = -0.12

    def apply(self, ground: Ground, rng: np.random.Generator) -> None:
        """Adds the fissures, everywhere."""
        ground.add(self.fissures(ground, rng))

    def fissures(self, ground: Ground, rng: np.random.Generator) -> Ground:
        """The fissures alone."""
        part = ground.coarser(self.fissure_m)
        for scale in (1.0, 0.4):
            cells = max(round(ground.period_m / (scale * self.polygon_m)), 3)
            points = rng.uniform(0.1, 0.9, (cells, cells, 2))
            width = max(scale * self.fissure_m, part.spacing_m)
            add_cracks(
                part.height,
                part.tone,
                part.spacing_m,
                points,
                ground.period_m / cells,
                width,
                scale * self.fissure_depth_m,
                scale * self.contrast,
            )
        return part


class Fans(LandformParameters):
    """Alluvial fans that run down from a divide to an almost level playa.

    One divide lies along y = 0, so fans face north and south and the playa lies around y = period / 2; further divides
    are spaced evenly. Radial profiles
    flatten towards the toe; slopes of 1-5 deg are usual (Blair & McPherson 1994). Washes spread from the apexes.
    What relief was there before is kept on the fans and reduced to `playa_relief` of it on the playa, which may have
    polygons.
    """

    slope_deg: Annotated[float, Field(gt=0.0, le=15.0, description="slope at the apex")] = 4.5
    divides: Annotated[int, Field(ge=1, le=20, description="number of divides, hence of playas")] = 2
    radius_m: Annotated[float, Field(gt=0.0, description="mean distance from apex to toe, m")] = 1300.0
    apex_spacing_m: Annotated[float, Field(gt=0.0, description="distance between apexes, m")] = 600.0
    concavity: Annotated[float, Field(ge=1.0, le=3.0, description="1: straight profile; larger: flatter toe")] = 1.15
    playa_relief: Annotated[float, Field(ge=0.0, le=1.0, description="relief left on the playa")] = 0.05
    washes_per_fan: Annotated[int, Field(ge=0, le=500, description="channels on a fan")] = 50
    wash_width_m: Annotated[float, Field(gt=0.0, description="median width of a wash, m")] = 9.0
    wash_depth_m: Annotated[float, Field(ge=0.0, description="median depth of a wash, m")] = 0.7
    wash_contrast: Annotated[float, Field(ge=-1.0, le=1.0, description="log albedo of washes over the fan's")] = 0.06
    fan_contrast: Annotated[float, Field(ge=-2.0, le=2.0, description="log albedo of fans over the playa's")] = -0.12

    polygons: Annotated[Playa | None, Field(description="desiccation polygons on the playa")] = None

    def apply(self, ground: Ground, rng: np.random.Generator) -> None:
        """Adds the fans and their washes; flattens the playa."""
        apexes = self._apexes(ground.period_m, rng)
        broad = ground.coarser(CONE_DETAIL * self.radius_m)
        rounding = APEX_ROUNDING * self.radius_m
        slope = float(np.tan(np.radians(self.slope_deg)))
        raise_cones(broad.height, broad.tone, broad.spacing_m, apexes, slope, self.concavity, rounding)
        if self.polygons is not None:
            fissures = self.polygons.fissures(ground, rng)
            bare = np.float32(1.0) - fitted(broad.tone, fissures.side)
            np.multiply(fissures.height, bare, out=fissures.height)
            np.multiply(fissures.tone, bare, out=fissures.tone)
        kept = finer(np.float32(self.playa_relief) + np.float32(1.0 - self.playa_relief) * broad.tone, ground.side)
        np.multiply(ground.height, kept, out=ground.height)
        np.multiply(ground.tone, kept, out=ground.tone)
        broad.tone[...] *= np.float32(self.fan_contrast)
        ground.add(broad)
        if self.polygons is not None:
            ground.add(fissures)
        if self.washes_per_fan:
            self._add_washes(ground, apexes, rng)

    def _apexes(self, period_m: float, rng: np.random.Generator) -> Float64[np.ndarray, "fans 3"]:
        count = max(round(period_m / self.apex_spacing_m), 1)
        along = (np.tile(np.arange(count), self.divides) + rng.uniform(-0.3, 0.3, count * self.divides)) / count
        across = np.repeat(np.arange(self.divides), count) / self.divides
        stray = rng.uniform(-0.06, 0.06, along.size) * self.radius_m
        radius = self.radius_m * rng.uniform(0.85, 1.15, along.size)
        return np.column_stack([along * period_m, (across * period_m + stray) % period_m, radius])

    def _add_washes(self, ground: Ground, apexes: Float64[np.ndarray, "fans 3"], rng: np.random.Generator) -> None:
        part = ground.coarser(self.wash_width_m / 3.0)
        for apex in apexes:
            count = self.washes_per_fan
            # half of them to either side of the divide, within 30 deg of straight down
            heading = rng.choice([-1.0, 1.0], count) * np.pi / 2.0 + rng.uniform(-0.52, 0.52, count)
            begin = apex[2] * rng.uniform(0.02, 0.5, count)
            width = self.wash_width_m * np.exp(0.5 * rng.standard_normal(count))
            depth = self.wash_depth_m * np.exp(0.4 * rng.standard_normal(count))
            start = apex[:2] + begin[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
            length = apex[2] * rng.uniform(0.9, 1.05, count) - begin
            discs = walk(start, heading, np.maximum(length, width), width, depth, 0.06, rng)
            cut_channels(part.tone, part.spacing_m, discs, 2.0)
        part.height[...] = -part.tone
        part.tone[...] *= np.float32(self.wash_contrast / max(self.wash_depth_m, 1e-6))
        np.clip(part.tone, -0.5, 0.5, out=part.tone)
        ground.add(part)
