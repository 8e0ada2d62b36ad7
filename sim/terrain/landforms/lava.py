"""Basaltic lava: thin pahoehoe flows in lobes, and patches of blocky a'a."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from marsyard.sim.terrain.landforms.ground import Ground, LandformParameters, fitted, smooth_pair
from marsyard.sim.terrain.landforms.kernels import stamp_lobes

#: How far a lobe's outline strays, RMS, in half widths.
CRENULATION = 0.28
#: RMS of a cubic B-spline over that of its control values, where these are independent: 151/315.
SPLINE_OF_NOISE_RMS = 151.0 / 315.0


class Lava(LandformParameters):
    """Numerous thin flows, as at Pisgah: rough at a few metres, gentle beyond (Wood & Kienle 1990; field test III.A).

    Lobes of 1-3 m thickness overlap; a'a covers patches with blocks and pinnacles of a few metres.
    """

    layers: Annotated[float, Field(gt=0.0, le=10.0, description="lobes lying over one another, on average")] = 3.0
    lobe_length_m: Annotated[float, Field(gt=0.0, description="median length of a lobe, m")] = 210.0
    lobe_thickness_m: Annotated[float, Field(ge=0.0, description="median thickness of a lobe, m")] = 1.5
    flow_to_deg: Annotated[float, Field(ge=0.0, lt=360.0, description="azimuth the flows run to")] = 280.0
    lobe_contrast: Annotated[float, Field(ge=0.0, le=1.0, description="RMS of the lobes' log albedo")] = 0.05
    aa_share: Annotated[float, Field(ge=0.0, le=1.0, description="share of the ground under a'a")] = 0.25
    aa_block_m: Annotated[float, Field(gt=0.0, description="size of its blocks, m")] = 6.0
    aa_relief_m: Annotated[float, Field(ge=0.0, description="RMS height of its blocks, m")] = 0.45
    aa_contrast: Annotated[float, Field(ge=-1.0, le=1.0, description="log albedo of a'a over pahoehoe's")] = -0.06
    pahoehoe_relief_m: Annotated[
        float, Field(ge=0.0, description="RMS height of hummocks of the blocks' size on pahoehoe, m")
    ] = 0.05

    def apply(self, ground: Ground, rng: np.random.Generator) -> None:
        """Adds the flows, then the blocks."""
        part = ground.coarser(max(self.lobe_length_m / 36.0, self.lobe_thickness_m))
        crenulation = self.lobe_length_m / 12.0
        warp = np.float32(CRENULATION) * smooth_pair(ground.period_m, crenulation, crenulation, 0.0, rng)
        lobes = self._lobes(ground.period_m, rng)
        warp_x, warp_y = (fitted(warp[..., axis], part.side) for axis in (0, 1))
        stamp_lobes(part.height, part.tone, part.spacing_m, lobes, warp_x, warp_y)
        ground.add(part)
        self._add_blocks(ground, rng)

    def _lobes(self, period_m: float, rng: np.random.Generator) -> np.ndarray:
        """Rows of `stamp_lobes`, in random order: log-normal lengths, two to four times as long as wide."""
        spread = 0.5
        mean_area = np.pi / 4.0 * self.lobe_length_m**2 * np.exp(2.0 * spread**2) * 0.38
        count = int(rng.poisson(self.layers * period_m**2 / mean_area))
        half = 0.5 * self.lobe_length_m * np.exp(spread * rng.standard_normal(count))
        across = half / rng.uniform(2.0, 4.0, count)
        thick = self.lobe_thickness_m * np.exp(0.35 * rng.standard_normal(count))
        heading = np.radians(90.0 - self.flow_to_deg) + 0.45 * rng.standard_normal(count)
        place = rng.uniform(0.0, period_m, (count, 2))
        tone = self.lobe_contrast * rng.standard_normal(count)
        return np.column_stack([place, half, across, thick, np.cos(heading), np.sin(heading), tone])

    def _add_blocks(self, ground: Ground, rng: np.random.Generator) -> None:
        """Noise of the blocks' size, strong in patches whose borders are those of a smooth field's level."""
        blocks = ground.coarser(self.aa_block_m / 2.0)
        patches = np.zeros((blocks.side, blocks.side), dtype=np.float32)
        for scale, strength in ((1.0, 1.0), (0.35, 0.45), (0.12, 0.2)):
            size = scale * self.lobe_length_m
            patches += np.float32(strength) * fitted(
                smooth_pair(ground.period_m, size, size, 0.0, rng)[..., 0], blocks.side
            )
        threshold = float(np.quantile(patches[::4, ::4], 1.0 - self.aa_share))
        share = np.clip((patches - np.float32(threshold)) * np.float32(6.0) + np.float32(0.5), 0.0, 1.0)
        relief = np.float32(self.pahoehoe_relief_m) + np.float32(self.aa_relief_m - self.pahoehoe_relief_m) * share
        relief *= rng.standard_normal(relief.shape, dtype=np.float32)
        relief *= np.float32(1.0 / SPLINE_OF_NOISE_RMS)
        blocks.height[...] = relief
        np.multiply(share, np.float32(self.aa_contrast), out=blocks.tone)
        ground.add(blocks)
