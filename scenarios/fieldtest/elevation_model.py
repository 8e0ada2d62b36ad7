"""Elevation model that is subtracted from the GPS height (paper, III.D.1).

The paper is Johnson et al., "Field Testing of the MER DIMES".
"""

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import gaussian_filter

from marsyard.scenarios.fieldtest.parameters import ElevationParameters
from marsyard.sim.terrain import Surface

#: Margin of the elevation model around the requested points, posts.
_MARGIN_POSTS = 2


def simulate_elevation_model(
    p: ElevationParameters, surface: Surface, points_m: Float64[np.ndarray, "n 2"], rng: np.random.Generator
) -> RegularGridInterpolator:
    """Simulate an elevation model of the ground around points; heights are linear between posts (paper, III.D.1).

    The height of a post is the mean height of its cell plus a correlated error.
    """
    x, y = (
        p.posting_m * np.arange(np.floor(low) - _MARGIN_POSTS, np.ceil(high) + _MARGIN_POSTS + 1.0)
        for low, high in zip(points_m.min(axis=0) / p.posting_m, points_m.max(axis=0) / p.posting_m, strict=True)
    )
    level = int(np.clip(np.rint(np.log2(p.posting_m / surface.spacing_m)), 0, len(surface.levels) - 1))
    ground = surface.height(*np.meshgrid(x, y, indexing="ij"), level)
    sigma = p.correlation_m / p.posting_m
    error = gaussian_filter(rng.standard_normal(ground.shape), sigma, mode="wrap")
    # Gaussian smoothing reduces the variance of white noise to the fraction 1 / (4 pi sigma**2)
    error *= p.error_m * np.sqrt(4.0 * np.pi) * sigma
    return RegularGridInterpolator((x, y), ground + error)
