"""Pixels that hold an edge, traced by several rays each.

One ray a pixel draws outlines ragged. A picture is therefore searched for edges: of objects, of ground before other
ground or the sky, and of shadows. Their pixels are traced again by rays spread over them, each shaded as a pixel is;
the radiance is their mean. Range, body and normal remain those of the ray through the pixel's middle.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from marsyard.sim.render.kernels.edges import mark_edges, split_rays
from marsyard.sim.render.kernels.structs import Rays
from marsyard.sim.render.rays import PixelRays


def edge_pixels(
    radiance: Float32[np.ndarray, "rows columns"],
    distance: Float64[np.ndarray, "rows columns"],
    body: Int32[np.ndarray, "rows columns"],
) -> Int64[np.ndarray, "pixels"]:
    """Numbers, row by row, of the pixels to both sides of edges that can be seen in a picture."""
    marked = np.zeros(radiance.shape, dtype=np.bool_)
    mark_edges(radiance, distance, body, marked)
    return np.flatnonzero(marked)


def rays_within(rays: PixelRays, pixels: Int64[np.ndarray, "pixels"], side: int) -> Rays:
    """`side` x `side` rays spread over each of some pixels; each sees the ground as smooth as its pixel does."""
    columns, rows = rays.size
    count = len(pixels) * side**2
    origins, directions = np.empty((count, 3), dtype=np.float32), np.empty((count, 3), dtype=np.float32)
    split_rays(rays.origins, (rows, columns), pixels, side, False, origins)
    split_rays(rays.directions, (rows, columns), pixels, side, True, directions)
    return Rays(origins, directions, np.repeat(rays.pixel_angles[pixels], side**2))
