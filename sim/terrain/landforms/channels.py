"""Winding channels: washes, and the gullies of landing tests."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from marsyard.sim.terrain.landforms.ground import Ground, LandformParameters
from marsyard.sim.terrain.landforms.kernels import cut_channels


def walk(
    start: Float64[np.ndarray, "channels 2"],
    heading: Float64[np.ndarray, "channels"],
    length: Float64[np.ndarray, "channels"],
    width: Float64[np.ndarray, "channels"],
    depth: Float64[np.ndarray, "channels"],
    wander: float,
    rng: np.random.Generator,
) -> Float64[np.ndarray, "discs 4"]:
    """Channels as rows of discs (x, y, half width, depth), a quarter of their width apart.

    Each keeps to its heading (radians, counter-clockwise from x) and swings about it: the deviation is a first-order
    Gauss-Markov process of RMS `wander` per width travelled, forgotten over about eight widths. Channels begin and end
    narrow and shallow.
    """
    parts = []
    for place, straight, far, wide, deep in zip(start, heading, length, width, depth, strict=True):
        step = 0.25 * wide
        count = max(int(far / step), 2)
        keep = np.exp(-step / (8.0 * wide))
        kicks = 2.0 * wander * np.sqrt(step / wide) * rng.standard_normal(count)
        swing = _forgetting_sum(kicks, keep)
        path = np.column_stack([np.cos(straight + swing), np.sin(straight + swing)]) * step
        place_along = place + np.cumsum(path, axis=0)
        along = (np.arange(count) + 0.5) / count
        swell = np.sqrt(np.minimum(1.0, 8.0 * along) * np.minimum(1.0, 5.0 * (1.0 - along)))
        parts.append(np.column_stack([place_along, 0.5 * wide * np.maximum(swell, 0.3), deep * swell]))
    return np.concatenate(parts) if parts else np.empty((0, 4))


def _forgetting_sum(kicks: Float64[np.ndarray, "n"], keep: float) -> Float64[np.ndarray, "n"]:
    from scipy.signal import lfilter

    return np.asarray(lfilter([1.0], [1.0, -keep], kicks))


class Gullies(LandformParameters):
    """Steep-walled gullies, hazards to a landing: trunks with tributaries, walls at a stated slope."""

    per_km2: Annotated[float, Field(ge=0.0, description="trunks per square kilometre")] = 200.0
    width_m: Annotated[float, Field(gt=0.0, description="median width of a trunk from rim to rim, m")] = 6.0
    wall_slope_deg: Annotated[float, Field(gt=0.0, le=60.0, description="steepest slope of the walls")] = 35.0
    length_m: Annotated[float, Field(gt=0.0, description="mean length of a trunk, m")] = 90.0
    tributaries: Annotated[int, Field(ge=0, le=50, description="tributaries of a trunk")] = 4
    downhill_deg: Annotated[float, Field(ge=0.0, lt=360.0, description="azimuth they run to")] = 90.0
    contrast: Annotated[
        float, Field(ge=-1.0, le=1.0, description="log albedo of their floors over the ground's")
    ] = -0.1

    def apply(self, ground: Ground, rng: np.random.Generator) -> None:
        """Cuts the gullies."""
        part = ground.coarser(self.width_m / 12.0)
        count = int(rng.poisson(self.per_km2 * (ground.period_m / 1000.0) ** 2))
        heading = np.radians(90.0 - self.downhill_deg) + 0.3 * rng.standard_normal(count)
        width = self.width_m * np.exp(0.3 * rng.standard_normal(count))
        length = self.length_m * rng.uniform(0.6, 1.4, count)
        trunks = self._discs(rng.uniform(0.0, ground.period_m, (count, 2)), heading, length, width, rng)
        # depth (1 - (d / w)**1.5) is steepest at the rim: 1.5 depth / w
        cut_channels(part.tone, part.spacing_m, trunks, 1.5)
        if self.tributaries and trunks.size:
            mouths = rng.integers(0, trunks.shape[0], count * self.tributaries)
            towards = np.radians(90.0 - self.downhill_deg) + np.pi + rng.choice([-0.7, 0.7], mouths.size)
            small = trunks[mouths, 2] * 2.0 * rng.uniform(0.35, 0.6, mouths.size)
            branches = self._discs(trunks[mouths, :2], towards, 6.0 * small + 0.1 * self.length_m, small, rng)
            cut_channels(part.tone, part.spacing_m, branches, 1.5)
        part.height[...] = -part.tone
        part.tone[...] *= np.float32(self.contrast / (0.5 * self._depth(self.width_m)))
        np.clip(part.tone, -abs(self.contrast), abs(self.contrast), out=part.tone)
        ground.add(part)

    def _depth(self, width: float) -> float:
        return float(0.5 * width * np.tan(np.radians(self.wall_slope_deg)) / 1.5)

    def _discs(
        self,
        start: Float64[np.ndarray, "channels 2"],
        heading: Float64[np.ndarray, "channels"],
        length: Float64[np.ndarray, "channels"],
        width: Float64[np.ndarray, "channels"],
        rng: np.random.Generator,
    ) -> Float64[np.ndarray, "discs 4"]:
        return walk(start, heading, length, width, width * self._depth(1.0), 0.15, rng)
