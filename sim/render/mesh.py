"""Triangle meshes of the ground around a place, dense near it and coarse far away, without cracks."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt32
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


def ground_mesh(surface: Surface, x: Float[np.ndarray, "columns"], y: Float[np.ndarray, "rows"]) -> trimesh.Trimesh:
    """The ground as triangles over the grid of these lines, in world coordinates.

    Each vertex takes its height from the level of the surface whose samples are about as far apart as the grid's lines
    there, so that the mesh does not alias the terrain.
    """
    level = np.maximum(_levels_of_lines(surface, y)[:, None], _levels_of_lines(surface, x)[None, :])
    across, along = np.meshgrid(x, y)
    z = np.empty_like(across)
    for one in np.unique(level):
        chosen = level == one
        z[chosen] = surface.height(across[chosen], along[chosen], int(one))
    vertices = np.stack([across, along, z], axis=-1).reshape(-1, 3)
    return trimesh.Trimesh(vertices, grid_faces(y.size, x.size), process=False, validate=False)


def _levels_of_lines(surface: Surface, lines: Float[np.ndarray, "count"]) -> Int[np.ndarray, "count"]:
    level: Int[np.ndarray, "count"] = np.clip(
        np.floor(np.log2(np.gradient(lines) / surface.spacing_m)), 0, len(surface.levels) - 1
    ).astype(int)
    return level


@lru_cache(maxsize=4)
def grid_faces(rows: int, columns: int) -> UInt32[np.ndarray, "faces 3"]:
    """Triangles of a grid of vertices stored row by row, counter-clockwise seen from above."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)[None, :]).ravel()
    right, above = corner + 1, corner + columns
    lower = np.column_stack([corner, right, above + 1])
    upper = np.column_stack([corner, above + 1, above])
    faces = np.concatenate([lower, upper]).astype(np.uint32)
    faces.setflags(write=False)
    return faces


def lines_in_view(lines: Float[np.ndarray, "count"], low: float, high: float) -> Float[np.ndarray, "kept"]:
    """The lines between two bounds and one more to either side."""
    first = max(int(np.searchsorted(lines, low)) - 2, 0)
    last = min(int(np.searchsorted(lines, high)) + 2, lines.size)
    if last - first < 3:
        first, last = max(min(first, lines.size - 3), 0), min(max(last, 3), lines.size)
    return lines[first:last]
