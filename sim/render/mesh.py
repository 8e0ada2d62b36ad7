"""Triangle meshes of the ground around a place, dense near it and coarse far away, without cracks."""

from __future__ import annotations

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.optimize import brentq

from sim.terrain import Surface


def graded_offsets(reach_m: float, finest_m: float, count: int) -> Float[np.ndarray, "count"]:
    """Increasing offsets from -reach to reach, `finest_m` apart in the middle, ever farther apart outwards.

    Offsets are ``a sinh(b i)``: the spacing grows in proportion to the distance, as the footprint of a pixel does.
    Raises ValueError when `count` is even or `count` offsets `finest_m` apart already reach beyond `reach_m`.
    """
    if count % 2 == 0:
        raise ValueError(f"{count} offsets have none in the middle; an odd number is needed")
    steps = np.arange(count) - (count - 1) / 2.0
    last = steps[-1]
    if finest_m * last >= reach_m:
        raise ValueError(f"{count} offsets {finest_m:g} m apart reach beyond {reach_m:g} m")
    target = np.log(reach_m / finest_m)
    b = brentq(lambda b: np.log(np.sinh(b * last) / np.sinh(b)) - target, 1e-6 / last, 500.0 / last, xtol=1e-15)
    offsets: Float[np.ndarray, "count"] = finest_m / np.sinh(b) * np.sinh(b * steps)
    return offsets


def ground_mesh(
    surface: Surface, centre: Float[np.ndarray, "2"], offsets: Float[np.ndarray, "count"]
) -> trimesh.Trimesh:
    """The ground as triangles over the grid ``centre + offsets`` by ``centre + offsets``, in world coordinates.

    Each vertex takes its height from the level of the surface whose samples are about as far apart as the grid's, so
    that the mesh does not alias the terrain.
    """
    gaps = np.gradient(offsets)
    level_of_line = np.clip(np.floor(np.log2(gaps / surface.spacing_m)), 0, len(surface.levels) - 1).astype(int)
    level = np.maximum(level_of_line[:, None], level_of_line[None, :])
    x, y = np.meshgrid(centre[0] + offsets, centre[1] + offsets)
    z = np.empty_like(x)
    for one in np.unique(level):
        chosen = level == one
        z[chosen] = surface.height(x[chosen], y[chosen], int(one))
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    return trimesh.Trimesh(vertices, grid_faces(offsets.size), process=False, validate=False)


def grid_faces(count: int) -> np.ndarray:
    """Triangles of a grid of count x count vertices stored row by row, counter-clockwise seen from above."""
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)[None, :]).ravel()
    right, above = corner + 1, corner + count
    lower = np.column_stack([corner, right, above + 1])
    upper = np.column_stack([corner, above + 1, above])
    return np.concatenate([lower, upper]).astype(np.uint32)
