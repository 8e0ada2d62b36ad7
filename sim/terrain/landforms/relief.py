"""Landforms: lava flows, swells, ramps, gullies, and the fans and playa of a desert basin."""

from __future__ import annotations

from itertools import product
from typing import Annotated, Literal

import numpy as np
import scipy  # scipy.signal is slow to import: it is loaded at its first use
from jaxtyping import Float64
from numpy.random import Generator
from pydantic import Field

from marsyard.sim.parameters import Fraction, NonNegative, Parameters, Positive, bounded_field
from marsyard.sim.terrain.landforms.bedrock import locate_points
from marsyard.sim.terrain.landforms.ground import TerrainGround, refine, resample
from marsyard.sim.terrain.landforms.kernels.bedrock import add_cracks
from marsyard.sim.terrain.landforms.kernels.shapes import cut_channels, raise_cones, stamp_lobes
from marsyard.sim.terrain.landforms.random_fields import draw_smooth_fields

CRENULATION = 0.28  #: RMS displacement of a lobe's outline, in half widths.
#: RMS of a two-dimensional cubic B-spline divided by that of its control values, if these are independent. The mean
#: square has the factor 151/315 along each axis: the integral of the squared basis function.
SPLINE_OF_NOISE_RMS = 151.0 / 315.0
APEX_ROUNDING = 0.06  #: Rounding of a fan's apex, as a fraction of its radius.
CONE_DETAIL = 1.0 / 50.0  #: Scale of the smallest detail of the fans' broad shape, as a fraction of their radius.
Channels = Float64[np.ndarray, "channels"]  #: One value per channel.
Points = Float64[np.ndarray, "channels 2"]


class Lava(Parameters):
    """Thin lava flows as at Pisgah (Wood & Kienle 1990; field test paper, III.A), rough at scales of a few metres.

    Lobes of 1-3 m thickness overlap. Patches of a'a lava have blocks and pinnacles of a few metres.
    """

    layers: Annotated[float, Field(gt=0.0, le=10.0, description="mean number of overlapping lobes")] = 3.0
    lobe_length_m: Annotated[Positive, Field(description="median length of a lobe, m")] = 210.0
    lobe_thickness_m: Annotated[NonNegative, Field(description="median thickness of a lobe, m")] = 1.5
    flow_to_deg: Annotated[float, Field(ge=0.0, lt=360.0, description="azimuth to which the flows run")] = 280.0
    lobe_contrast: Annotated[Fraction, Field(description="RMS of the lobes' log albedo")] = 0.05
    aa_fraction: Annotated[Fraction, Field(description="fraction of the ground under a'a")] = 0.25
    aa_block_m: Annotated[Positive, Field(description="size of its blocks, m")] = 6.0
    aa_relief_m: Annotated[NonNegative, Field(description="RMS height of its blocks, m")] = 0.45
    aa_contrast: Annotated[float, Field(ge=-1.0, le=1.0, description="ln(albedo of a'a / of pahoehoe)")] = -0.06
    pahoehoe_relief_m: Annotated[NonNegative, Field(description="RMS height of hummocks on pahoehoe, m")] = 0.05

    def apply(self, ground: TerrainGround, rng: Generator) -> None:
        """Add the flows, then the blocks."""
        layer = ground.coarser(max(self.lobe_length_m / 36.0, self.lobe_thickness_m))
        scale_m = self.lobe_length_m / 12.0
        warp = np.float32(CRENULATION) * draw_smooth_fields(ground.period_m, scale_m, scale_m, 0.0, rng)
        # log-normal lengths: the mean square is the square of the median times exp(2 SD**2)
        # widths are 1/4 to 1/2 of the lengths; the number of lobes assumes a mean ratio of 0.38
        log_length_sd = 0.5
        mean_area = np.pi / 4.0 * self.lobe_length_m**2 * np.exp(2.0 * log_length_sd**2) * 0.38
        count = int(rng.poisson(self.layers * ground.period_m**2 / mean_area))
        half_length = 0.5 * self.lobe_length_m * np.exp(log_length_sd * rng.standard_normal(count))
        half_width = half_length / rng.uniform(2.0, 4.0, count)
        thickness = self.lobe_thickness_m * np.exp(0.35 * rng.standard_normal(count))
        heading = np.radians(90.0 - self.flow_to_deg) + 0.45 * rng.standard_normal(count)
        position = rng.uniform(0.0, ground.period_m, (count, 2))
        log_albedo = self.lobe_contrast * rng.standard_normal(count)
        outline = (half_length, half_width, thickness, np.cos(heading), np.sin(heading), log_albedo)
        lobes = np.column_stack([position, *outline])
        warp_x, warp_y = (resample(warp[..., axis], layer.side) for axis in (0, 1))
        stamp_lobes(layer.height, layer.log_albedo, layer.spacing_m, lobes, warp_x, warp_y)
        ground.add(layer)
        if self.aa_fraction > 0.0 or self.pahoehoe_relief_m > 0.0:
            self._add_blocks(ground, rng)

    def _add_blocks(self, ground: TerrainGround, rng: Generator) -> None:
        """Add noise with the wavelength of the blocks, in patches where a smooth random field exceeds a threshold."""
        blocks = ground.coarser(self.aa_block_m / 2.0)
        patches = np.zeros((blocks.side, blocks.side), dtype=np.float32)
        # three random fields with decreasing size of the patches and decreasing strength
        for scale, strength in ((1.0, 1.0), (0.35, 0.45), (0.12, 0.2)):
            length = scale * self.lobe_length_m
            field = draw_smooth_fields(ground.period_m, length, length, 0.0, rng)[..., 0]
            patches += np.float32(strength) * resample(field, blocks.side)
        threshold = float(np.quantile(patches[::4, ::4], 1.0 - self.aa_fraction))
        # the coverage rises from 0 to 1 around the threshold, over 1/6 of the field's unit
        coverage = np.clip((patches - np.float32(threshold)) * np.float32(6.0) + np.float32(0.5), 0.0, 1.0)
        coverage *= self.aa_fraction > 0.0  # without a'a the threshold is a maximum, around which the coverage rises
        relief = np.float32(self.pahoehoe_relief_m) + np.float32(self.aa_relief_m - self.pahoehoe_relief_m) * coverage
        relief *= rng.standard_normal(relief.shape, dtype=np.float32)
        relief *= np.float32(1.0 / SPLINE_OF_NOISE_RMS)
        blocks.height[...] = relief
        np.multiply(coverage, np.float32(self.aa_contrast), out=blocks.log_albedo)
        ground.add(blocks)


class Swell(Parameters):
    """Broad relief of a specified height, such as a dune field: a few waves about as long as the terrain's side."""

    relief_m: Annotated[Positive, Field(description="lowest to highest, m")] = 200.0
    waves: Annotated[int, Field(ge=1, le=8, description="maximum number of waves along a side")] = 1

    def apply(self, ground: TerrainGround, rng: Generator) -> None:
        """Add the swell."""
        layer = ground.coarser(ground.period_m / 64.0)
        phase = 2.0 * np.pi * np.arange(layer.side) / layer.side
        field = np.zeros((layer.side, layer.side))
        for m, n in product(range(self.waves + 1), range(-self.waves, self.waves + 1)):
            if (m, n) > (0, 0):  # a wave with the opposite wave vector is the same wave
                strength = rng.uniform(0.7, 1.0) / (m * m + n * n) ** 1.25
                shift = rng.uniform(0.0, 2.0 * np.pi)
                field += strength * np.cos(m * phase[None, :] + n * phase[:, None] + shift)
        field *= self.relief_m / np.ptp(field)
        layer.height[...] = field
        ground.add(layer, include_albedo=False)


class Ramp(Parameters):
    """Slope of constant angle for driving tests, as one side of a ridge, because the ground is periodic.

    Along the direction `uphill` the ground is level, climbs with the slope `slope_deg` over `length_m`, is level again
    and descends with the same slope. Perpendicular to it the profile is constant. The centre of the climb is at a
    quarter of the period (east_m or north_m = 0.25 period), that of the descent at three quarters. Bends are rounded
    over a tenth of the length of the slope.
    """

    slope_deg: Annotated[float, Field(gt=0.0, le=40.0, description="slope of the ramp")] = 8.0
    length_m: Annotated[Positive, Field(description="horizontal length of the even slope, m")] = 30.0
    uphill: Annotated[Literal["east", "north"], Field(description="direction in which the first slope climbs")] = "east"

    def apply(self, ground: TerrainGround, rng: Generator) -> None:
        """Add the ramp."""
        period = ground.period_m
        max_length = 0.45 * period
        if self.length_m > max_length:
            raise ValueError(f"ramp.length_m is {self.length_m:g}; at most {max_length:g} fit on this terrain")
        position = np.arange(ground.side) * ground.spacing_m
        bend = 0.1 * self.length_m
        climb, fall = (
            np.clip((0.5 * self.length_m + bend / 2.0 - np.abs(position - centre * period)) / bend, 0.0, 1.0)
            for centre in (0.25, 0.75)
        )
        relative_slope = climb - fall
        profile = np.cumsum(relative_slope) - 0.5 * relative_slope
        profile = profile * ground.spacing_m * np.tan(np.radians(self.slope_deg))
        profile = (profile - profile.mean()).astype(np.float32)
        np.add(ground.height, profile[None, :] if self.uphill == "east" else profile[:, None], out=ground.height)


def draw_channels(
    start: Points, heading: Channels, length: Channels, width: Channels, depth: Channels, wander: float, rng: Generator
) -> Float64[np.ndarray, "discs 4"]:
    """Draw winding channels as rows of discs (x, y, half width, depth) with a spacing of a quarter of their width.

    The direction of a channel deviates from its heading (radians, counter-clockwise from x) by a first-order
    Gauss-Markov process. Its correlation length is eight widths, its RMS about four times `wander` (radians): each step
    adds noise with the standard deviation `wander`. Both ends of a channel are narrow and shallow.
    """
    channels = [np.empty((0, 4))]
    for origin, mean_heading, length_m, width_m, depth_m in zip(start, heading, length, width, depth, strict=True):
        step = 0.25 * width_m
        count = max(int(length_m / step), 2)
        correlation = np.exp(-step / (8.0 * width_m))
        noise = 2.0 * wander * np.sqrt(step / width_m) * rng.standard_normal(count)
        deviation = np.asarray(scipy.signal.lfilter([1.0], [1.0, -correlation], noise))
        steps = np.column_stack([np.cos(mean_heading + deviation), np.sin(mean_heading + deviation)]) * step
        fraction = (np.arange(count) + 0.5) / count
        taper = np.sqrt(np.minimum(1.0, 8.0 * fraction) * np.minimum(1.0, 5.0 * (1.0 - fraction)))
        position = origin + np.cumsum(steps, axis=0)
        channels.append(np.column_stack([position, 0.5 * width_m * np.maximum(taper, 0.3), depth_m * taper]))
    return np.concatenate(channels)


class Gullies(Parameters):
    """Steep-walled gullies, which are landing hazards: trunks with tributaries, and walls with a specified slope."""

    per_km2: Annotated[NonNegative, Field(description="trunks per square kilometre")] = 200.0
    width_m: Annotated[Positive, Field(description="median width of a trunk from rim to rim, m")] = 6.0
    wall_slope_deg: Annotated[float, Field(gt=0.0, le=60.0, description="steepest slope of the walls")] = 35.0
    length_m: Annotated[Positive, Field(description="mean length of a trunk, m")] = 90.0
    tributaries: Annotated[int, Field(ge=0, le=50, description="tributaries of a trunk")] = 4
    downhill_deg: Annotated[float, Field(ge=0.0, lt=360.0, description="azimuth to which they run")] = 90.0
    contrast: Annotated[float, bounded_field(-1.0, 1.0, "ln(albedo of their floors / of the ground)")] = -0.1

    def apply(self, ground: TerrainGround, rng: Generator) -> None:
        """Cut the gullies."""
        # until the channels are complete, the albedo grid of `layer` contains their depth
        layer = ground.coarser(self.width_m / 12.0)
        count = int(rng.poisson(self.per_km2 * (ground.period_m / 1000.0) ** 2))
        heading = np.radians(90.0 - self.downhill_deg) + 0.3 * rng.standard_normal(count)
        width = self.width_m * np.exp(0.3 * rng.standard_normal(count))
        length = self.length_m * rng.uniform(0.6, 1.4, count)
        start = rng.uniform(0.0, ground.period_m, (count, 2))
        # the depth is proportional to the width
        depth = width * self._compute_depth(1.0)
        trunks = draw_channels(start, heading, length, width, depth, 0.15, rng)
        # the profile depth (1 - (r / w)**1.5) has its maximum slope at the rim: 1.5 depth / w
        cut_channels(layer.log_albedo, layer.spacing_m, trunks, 1.5)
        if self.tributaries and trunks.size:
            mouths = trunks[rng.integers(0, len(trunks), count * self.tributaries)]
            start, half_width, _ = np.split(mouths, [2, 3], axis=1)
            heading = np.radians(90.0 - self.downhill_deg) + np.pi + rng.choice([-0.7, 0.7], len(mouths))
            width = half_width[:, 0] * 2.0 * rng.uniform(0.35, 0.6, len(mouths))
            length = 6.0 * width + 0.1 * self.length_m
            depth = width * self._compute_depth(1.0)
            branches = draw_channels(start, heading, length, width, depth, 0.15, rng)
            cut_channels(layer.log_albedo, layer.spacing_m, branches, 1.5)
        layer.height[...] = -layer.log_albedo
        layer.log_albedo[...] *= np.float32(self.contrast / (0.5 * self._compute_depth(self.width_m)))
        np.clip(layer.log_albedo, -abs(self.contrast), abs(self.contrast), out=layer.log_albedo)
        ground.add(layer)

    def _compute_depth(self, width: float) -> float:
        """Compute the depth of a gully from its width and the slope of its walls, m."""
        return float(0.5 * width * np.tan(np.radians(self.wall_slope_deg)) / 1.5)


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
