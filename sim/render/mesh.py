"""Level pyramid of a surface, and its triangle mesh: dense near a position, coarse far away, without cracks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import brentq
from scipy.spatial import ConvexHull

from marsyard.sim.render.kernels.structs import Array32, Extent, Ground
from marsyard.sim.render.kernels.views import build_mesh, spans_in_hull
from marsyard.sim.terrain import Surface

if TYPE_CHECKING:
    import trimesh

#: Number of levels that kernels take: they are compiled for one number of arrays, which takes a minute. Terrains of
#: 2**15 samples along a side have as many.
LEVELS = 12
#: Replaces the ceilings of a surface that are not worth their time: no ray is known to be clear.
NO_CEILING = np.full((1, 1), np.inf, dtype=np.float32)


def pyramid(surface: Surface) -> tuple[Array32, ...]:
    """The levels of a surface, the last of them repeated."""
    return surface.levels + surface.levels[-1:] * (LEVELS - len(surface.levels))


def ground_struct(surface: Surface, extent_m: Extent, *, ceilings: bool) -> Ground:
    """Pack a surface for kernels, with or without upper bounds of its levels' heights."""
    bounds = surface.ceilings if ceilings else (NO_CEILING,)
    bounds += bounds[-1:] * (LEVELS - len(bounds))
    return Ground(pyramid(surface), bounds, len(surface.levels) - 1, surface.spacing_m, extent_m)


def graded_offsets(reach_m: float, finest_m: float, count: int) -> Float[np.ndarray, "count"]:
    """Increasing offsets ``a sinh(b i)`` from -reach to reach, `finest_m` apart in the middle.

    The spacing grows in proportion to the distance, as the footprint of a pixel does. Raises ValueError when `count` is
    even or `count` offsets `finest_m` apart already reach beyond `reach_m`.
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
    surface: Surface,
    x: Float[np.ndarray, "columns"],
    y: Float[np.ndarray, "rows"],
    spans: Int[np.ndarray, "strips 2"] | None = None,
) -> trimesh.Trimesh:
    """Triangulate the ground over the grid of these lines, in world coordinates.

    Each vertex takes its height from the level whose samples are about as far apart as the grid's lines there, so that
    the mesh does not alias the terrain. `spans` holds the first cell and the end of those to include in each strip
    between two lines of y; by default all.
    """
    import trimesh  # here, as it is slow to import

    if spans is None:
        spans = np.tile([0, x.size - 1], (y.size - 1, 1))
    level_of_x, level_of_y = (
        np.clip(np.floor(np.log2(np.gradient(lines) / surface.spacing_m)), 0, len(surface.levels) - 1).astype(int)
        for lines in (x, y)
    )
    vertices, faces = build_mesh(pyramid(surface), surface.spacing_m, x, y, level_of_x, level_of_y, spans)
    return trimesh.Trimesh(vertices, faces, process=False, validate=False)


def cells_in_hull(
    x: Float[np.ndarray, "columns"], y: Float[np.ndarray, "rows"], points: Float[np.ndarray, "points 2"]
) -> Int[np.ndarray, "strips 2"]:
    """Spans of a grid's cells, for `ground_mesh`, that reach into the convex hull of points not all on one line."""
    spans: Int[np.ndarray, "strips 2"] = spans_in_hull(x, y, points[ConvexHull(points).vertices])
    return spans


def lines_in_view(lines: Float[np.ndarray, "count"], low: float, high: float) -> Float[np.ndarray, "kept"]:
    """Select the lines between two bounds and one more to either side."""
    first = max(int(np.searchsorted(lines, low)) - 2, 0)
    last = min(int(np.searchsorted(lines, high)) + 2, lines.size)
    if last - first < 3:
        first, last = max(min(first, lines.size - 3), 0), min(max(last, 3), lines.size)
    return lines[first:last]
