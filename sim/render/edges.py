"""Pixels that hold an edge, seen by several rays each.

One ray a pixel draws outlines ragged. A picture is therefore looked over for edges: of things, of ground before other
ground or the sky, and of shadows. Their pixels are seen again by rays spread over them, each shaded as a pixel is; the
radiance is their mean. Range, body and normal remain those of the ray through the pixel's middle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int8, Int32, Int64

from marsyard.sim.render.kernels.edges import look_closely, mark_edges, split_rays
from marsyard.sim.render.kernels.ground import Extent
from marsyard.sim.render.objects import Objects
from marsyard.sim.render.pyramid import Ceilings, pyramid
from marsyard.sim.render.rays import PixelRays, RayBundle
from marsyard.sim.terrain import Surface


@dataclass(frozen=True)
class Sight:
    """What rays meet.

    Attributes
    ----------
    distance
        Distance along each ray, metres, infinite for the sky.
    triangle
        Number of the object's triangle, -1 where a ray meets none.
    weights
        Weights of the triangle's second and third corner at the place met; empty where there are no triangles.
    level
        Level of the terrain on which the ground was met; -1 where the mesh's own distance stands.
    """

    distance: Float64[np.ndarray, "rays"]
    triangle: Int32[np.ndarray, "rays"]
    weights: Float32[np.ndarray, "weighed 2"]
    level: Int8[np.ndarray, "rays"]

    @classmethod
    def unseen(cls, count: int, objects: Objects) -> Sight:
        """Arrays for so many rays, to be filled."""
        return cls(
            np.empty(count, dtype=np.float64),
            np.empty(count, dtype=np.int32),
            np.empty((count if len(objects) > 0 else 0, 2), dtype=np.float32),
            np.empty(count, dtype=np.int8),
        )


def edge_pixels(
    radiance: Float32[np.ndarray, "rows columns"],
    distance: Float64[np.ndarray, "rows columns"],
    body: Int32[np.ndarray, "rows columns"],
) -> Int64[np.ndarray, "pixels"]:
    """Numbers, row by row, of the pixels to both sides of edges that can be seen in a picture."""
    marked = np.zeros(radiance.shape, dtype=np.bool_)
    mark_edges(radiance, distance, body, marked)
    return np.flatnonzero(marked)


def rays_within(rays: PixelRays, pixels: Int64[np.ndarray, "pixels"], side: int) -> RayBundle:
    """`side` x `side` rays spread over each of some pixels; each sees the ground as smooth as its pixel does."""
    columns, rows = rays.size
    count = len(pixels) * side**2
    origins, directions = np.empty((count, 3), dtype=np.float32), np.empty((count, 3), dtype=np.float32)
    split_rays(rays.origins, rows, columns, pixels, side, False, origins)
    split_rays(rays.directions, rows, columns, pixels, side, True, directions)
    return RayBundle(origins, directions, np.repeat(rays.pixel_angles[pixels], side**2))


def look_within(
    surface: Surface,
    tops: Ceilings,
    extent_m: Extent,
    objects: Objects,
    rotation: Float64[np.ndarray, "3 3"],
    position: Float64[np.ndarray, "3"],
    columns: int,
    pixels: Int64[np.ndarray, "pixels"],
    within: RayBundle,
    seen: Sight,
) -> Sight:
    """What the rays within some pixels meet, given what the picture's pixels do.

    Parameters
    ----------
    surface, tops, extent_m, objects
        The ground, bounds of its height (`marsyard.sim.render.pyramid.ceilings`), where it ends (`Scene.extent_m`), and
        what stands on it.
    rotation, position
        Pose of the camera: rotation matrix of the body, world position of its centre of projection.
    columns
        Columns of the picture.
    pixels, within
        The pixels and the rays in them.
    seen
        What the picture's pixels meet.
    """
    found = Sight.unseen(len(within.directions), objects)
    look_closely(
        pyramid(surface)[0],
        tops,
        surface.spacing_m,
        extent_m,
        objects.hierarchy,
        rotation,
        position,
        columns,
        pixels,
        len(within.directions) // max(len(pixels), 1),
        within.origins,
        within.directions,
        within.pixel_angles,
        seen.distance,
        seen.triangle,
        seen.level,
        seen.weights,
        found.distance,
        found.triangle,
        found.weights,
        found.level,
    )
    return found
