"""Thin lava flows: overlapping lobes of pahoehoe, and patches of rough a'a."""

from typing import Annotated

import numpy as np
from numpy.random import Generator
from pydantic import Field

from marsyard.sim.parameters import Fraction, NonNegative, Parameters, Positive
from marsyard.sim.terrain.landforms.ground import TerrainGround, resample
from marsyard.sim.terrain.landforms.kernels.shapes import stamp_lobes
from marsyard.sim.terrain.landforms.random_fields import draw_smooth_fields

#: RMS displacement of a lobe's outline, in half widths; bends of the outline along a lobe of median length (assumed).
CRENULATION, _BENDS_PER_LOBE = 0.28, 12.0
_SAMPLES_PER_LOBE = 36.0  #: Minimum number of samples along a lobe of median length.
#: RMS of a two-dimensional cubic B-spline divided by that of its control values, if these are independent. The mean
#: square has the factor 151/315 along each axis: the integral of the squared basis function.
SPLINE_OF_NOISE_RMS = 151.0 / 315.0


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
        layer = ground.coarser(max(self.lobe_length_m / _SAMPLES_PER_LOBE, self.lobe_thickness_m))
        scale_m = self.lobe_length_m / _BENDS_PER_LOBE
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
