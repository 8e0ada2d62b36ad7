"""Altitude of the pictures: GPS height less an elevation model of the site (paper, III.D.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import gaussian_filter

from marsyard.scenarios.fieldtest.parameters import ElevationParameters
from marsyard.sim.terrain import Surface

#: Posts beyond the places that are asked for.
_MARGIN = 2


@dataclass(frozen=True)
class ElevationModel:
    """Heights on a grid, with errors; linear between posts."""

    posts: RegularGridInterpolator
    interpolation_m: float

    @classmethod
    def surveyed(
        cls,
        parameters: ElevationParameters,
        surface: Surface,
        around_m: Float64[np.ndarray, "n 2"],
        rng: np.random.Generator,
    ) -> ElevationModel:
        """A model of the ground around these places, its errors drawn.

        A post holds the mean ground of its cell. Its error is white noise smoothed to the correlation distance.
        """
        p = parameters
        low, high = around_m.min(axis=0), around_m.max(axis=0)
        x, y = (
            p.posting_m * np.arange(np.floor(a / p.posting_m) - _MARGIN, np.ceil(b / p.posting_m) + _MARGIN + 1.0)
            for a, b in zip(low, high, strict=True)
        )
        level = int(np.clip(np.rint(np.log2(p.posting_m / surface.spacing_m)), 0, len(surface.levels) - 1))
        ground = surface.height(*np.meshgrid(x, y, indexing="ij"), level)
        sigma = p.correlation_m / p.posting_m
        error = gaussian_filter(rng.standard_normal(ground.shape), sigma, mode="wrap")
        # white noise smoothed by a Gaussian keeps 1 / (4 pi sigma**2) of its variance
        error *= p.error_m * np.sqrt(4.0 * np.pi) * sigma
        return cls(RegularGridInterpolator((x, y), ground + error), p.interpolation_m)

    def heights(self, places_m: Float64[np.ndarray, "n 2"], rng: np.random.Generator) -> Float64[np.ndarray, "n"]:
        """Interpolated heights at places, metres."""
        noise = self.interpolation_m * rng.standard_normal(len(places_m))
        heights: Float64[np.ndarray, "n"] = self.posts(places_m) + noise
        return heights
