"""Gullies, and the alluvial fans and playa of a desert basin."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field
from scipy.signal import lfilter

from marsyard.sim.parameters import NonNegative, Parameters, Positive
from marsyard.sim.terrain.landforms.ground import Ground, refined, resampled
from marsyard.sim.terrain.landforms.kernels import add_cracks, cut_channels, raise_cones

#: Rounding of a fan's apex, as a fraction of its radius.
APEX_ROUNDING = 0.06
#: Scale of the smallest detail of the fans' broad shape, as a fraction of their radius.
CONE_DETAIL = 1.0 / 50.0
#: One value per channel.
Channels = Float64[np.ndarray, "channels"]


def walk(
    start: Float64[np.ndarray, "channels 2"],
    heading: Channels,
    length: Channels,
    width: Channels,
    depth: Channels,
    wander: float,
    rng: np.random.Generator,
) -> Float64[np.ndarray, "discs 4"]:
    """Draw winding channels as rows of discs (x, y, half width, depth), a quarter of their width apart.

    Each swings about its heading (radians, counter-clockwise from x): the deviation is a first-order Gauss-Markov
    process of RMS `wander` per width travelled, correlated over about eight widths. Channels begin and end narrow and
    shallow.
    """
    parts = [np.empty((0, 4))]
    for origin, mean_heading, reach, wide, deep in zip(start, heading, length, width, depth, strict=True):
        step = 0.25 * wide
        count = max(int(reach / step), 2)
        correlation = np.exp(-step / (8.0 * wide))
        noise = 2.0 * wander * np.sqrt(step / wide) * rng.standard_normal(count)
        swing = np.asarray(lfilter([1.0], [1.0, -correlation], noise))
        steps = np.column_stack([np.cos(mean_heading + swing), np.sin(mean_heading + swing)]) * step
        along = (np.arange(count) + 0.5) / count
        taper = np.sqrt(np.minimum(1.0, 8.0 * along) * np.minimum(1.0, 5.0 * (1.0 - along)))
        position = origin + np.cumsum(steps, axis=0)
        parts.append(np.column_stack([position, 0.5 * wide * np.maximum(taper, 0.3), deep * taper]))
    return np.concatenate(parts)


class Gullies(Parameters):
    """Steep-walled gullies, hazards to a landing: trunks with tributaries, walls at a stated slope."""

    per_km2: Annotated[NonNegative, Field(description="trunks per square kilometre")] = 200.0
    width_m: Annotated[Positive, Field(description="median width of a trunk from rim to rim, m")] = 6.0
    wall_slope_deg: Annotated[float, Field(gt=0.0, le=60.0, description="steepest slope of the walls")] = 35.0
    length_m: Annotated[Positive, Field(description="mean length of a trunk, m")] = 90.0
    tributaries: Annotated[int, Field(ge=0, le=50, description="tributaries of a trunk")] = 4
    downhill_deg: Annotated[float, Field(ge=0.0, lt=360.0, description="azimuth they run to")] = 90.0
    contrast: Annotated[
        float, Field(ge=-1.0, le=1.0, description="log albedo of their floors over the ground's")
    ] = -0.1

    def apply(self, ground: Ground, rng: np.random.Generator) -> None:
        """Cut the gullies."""
        part = ground.coarser(self.width_m / 12.0)
        count = int(rng.poisson(self.per_km2 * (ground.period_m / 1000.0) ** 2))
        heading = np.radians(90.0 - self.downhill_deg) + 0.3 * rng.standard_normal(count)
        width = self.width_m * np.exp(0.3 * rng.standard_normal(count))
        length = self.length_m * rng.uniform(0.6, 1.4, count)
        start = rng.uniform(0.0, ground.period_m, (count, 2))
        trunks = walk(start, heading, length, width, width * self._depth(1.0), 0.15, rng)
        # depth (1 - (d / w)**1.5) is steepest at the rim: 1.5 depth / w
        cut_channels(part.tone, part.spacing_m, trunks, 1.5)
        if self.tributaries and trunks.size:
            mouths = rng.integers(0, trunks.shape[0], count * self.tributaries)
            heading = np.radians(90.0 - self.downhill_deg) + np.pi + rng.choice([-0.7, 0.7], mouths.size)
            width = trunks[mouths, 2] * 2.0 * rng.uniform(0.35, 0.6, mouths.size)
            length = 6.0 * width + 0.1 * self.length_m
            branches = walk(trunks[mouths, :2], heading, length, width, width * self._depth(1.0), 0.15, rng)
            cut_channels(part.tone, part.spacing_m, branches, 1.5)
        part.height[...] = -part.tone
        part.tone[...] *= np.float32(self.contrast / (0.5 * self._depth(self.width_m)))
        np.clip(part.tone, -abs(self.contrast), abs(self.contrast), out=part.tone)
        ground.add(part)

    def _depth(self, width: float) -> float:
        return float(0.5 * width * np.tan(np.radians(self.wall_slope_deg)) / 1.5)


class Playa(Parameters):
    """Desiccation polygons: fissures of a stated spacing, dark or bright, and a finer net between them.

    Giant polygons, tens to hundreds of metres wide with fissures about a metre wide whose fills look different from
    above, are known from many playas of the Great Basin (Neal, Langer & Kerr 1968).
    """

    polygon_m: Annotated[Positive, Field(description="width of the polygons, m")] = 60.0
    fissure_m: Annotated[Positive, Field(description="half width over which a fissure fades, m")] = 3.0
    fissure_depth_m: Annotated[NonNegative, Field(description="depth of a fissure, m")] = 0.1
    contrast: Annotated[float, Field(ge=-2.0, le=2.0, description="log albedo of fissures over the plates'")] = -0.12

    def apply(self, ground: Ground, rng: np.random.Generator) -> None:
        """Add the fissures, everywhere."""
        ground.add(self.fissures(ground, rng))

    def fissures(self, ground: Ground, rng: np.random.Generator) -> Ground:
        """Return the fissures alone."""
        part = ground.coarser(self.fissure_m)
        for scale in (1.0, 0.4):
            cells = max(round(ground.period_m / (scale * self.polygon_m)), 3)
            points = rng.uniform(0.1, 0.9, (cells, cells, 2))
            width = max(scale * self.fissure_m, part.spacing_m)
            depth, contrast = scale * self.fissure_depth_m, scale * self.contrast
            cell_m = ground.period_m / cells
            add_cracks(part.height, part.tone, part.spacing_m, points, cell_m, width, depth, contrast)
        return part


class Fans(Parameters):
    """Alluvial fans that run down from a divide to an almost level playa.

    One divide lies along y = 0, so fans face north and south and the playa lies around y = period / 2; further divides
    are spaced evenly. Radial profiles flatten towards the toe; slopes of 1-5 deg are usual (Blair & McPherson 1994).
    Washes spread from the apexes. The fans keep the relief from before; the playa keeps `playa_relief` of it, and may
    have polygons.
    """

    slope_deg: Annotated[float, Field(gt=0.0, le=15.0, description="slope at the apex")] = 4.5
    divides: Annotated[int, Field(ge=1, le=20, description="number of divides, hence of playas")] = 2
    radius_m: Annotated[Positive, Field(description="mean distance from apex to toe, m")] = 1300.0
    apex_spacing_m: Annotated[Positive, Field(description="distance between apexes, m")] = 600.0
    concavity: Annotated[float, Field(ge=1.0, le=3.0, description="1: straight profile; larger: flatter toe")] = 1.15
    playa_relief: Annotated[float, Field(ge=0.0, le=1.0, description="relief left on the playa")] = 0.05
    washes_per_fan: Annotated[int, Field(ge=0, le=500, description="channels on a fan")] = 50
    wash_width_m: Annotated[Positive, Field(description="median width of a wash, m")] = 9.0
    wash_depth_m: Annotated[NonNegative, Field(description="median depth of a wash, m")] = 0.7
    wash_contrast: Annotated[float, Field(ge=-1.0, le=1.0, description="log albedo of washes over the fan's")] = 0.06
    fan_contrast: Annotated[float, Field(ge=-2.0, le=2.0, description="log albedo of fans over the playa's")] = -0.12

    polygons: Annotated[Playa | None, Field(description="desiccation polygons on the playa")] = None

    def apply(self, ground: Ground, rng: np.random.Generator) -> None:
        """Add the fans and their washes; flatten the playa."""
        apexes = self._apexes(ground.period_m, rng)
        broad = ground.coarser(CONE_DETAIL * self.radius_m)
        slope = float(np.tan(np.radians(self.slope_deg)))
        rounding = APEX_ROUNDING * self.radius_m
        raise_cones(broad.height, broad.tone, broad.spacing_m, apexes, slope, self.concavity, rounding)
        if self.polygons is not None:
            fissures = self.polygons.fissures(ground, rng)
            bare = np.float32(1.0) - resampled(broad.tone, fissures.side)
            np.multiply(fissures.height, bare, out=fissures.height)
            np.multiply(fissures.tone, bare, out=fissures.tone)
        relief = np.float32(self.playa_relief) + np.float32(1.0 - self.playa_relief) * broad.tone
        kept = refined(relief, ground.side)
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
        offset = rng.uniform(-0.06, 0.06, along.size) * self.radius_m
        radius = self.radius_m * rng.uniform(0.85, 1.15, along.size)
        return np.column_stack([along * period_m, (across * period_m + offset) % period_m, radius])

    def _add_washes(self, ground: Ground, apexes: Float64[np.ndarray, "fans 3"], rng: np.random.Generator) -> None:
        part = ground.coarser(self.wash_width_m / 3.0)
        count = self.washes_per_fan
        for apex in apexes:
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
