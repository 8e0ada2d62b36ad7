"""Triangle meshes of the ground around a place, dense near it and coarse far away, without cracks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import brentq
from scipy.spatial import ConvexHull

from marsyard.sim.render.kernels.mesh import lay_out, spans_in_hull
from marsyard.sim.render.pyramid import pyramid
from marsyard.sim.terrain import Surface

if TYPE_CHECKING:
    import trimesh


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
    surface: Surface,
    x: Float[np.ndarray, "columns"],
    y: Float[np.ndarray, "rows"],
    spans: Int[np.ndarray, "strips 2"] | None = None,
) -> trimesh.Trimesh:
    """The ground as triangles over the grid of these lines, in world coordinates.

    Each vertex takes its height from the level of the surface whose samples are about as far apart as the grid's lines
    there, so that the mesh does not alias the terrain.

    Parameters
    ----------
    surface
        The terrain.
    x, y
        World coordinates of the grid's lines, metres.
    spans
        Of each strip of cells between two lines of y the first cell that is drawn, and the one after the last; by
        default all are.
    """
    import trimesh  # here, as it is slow to import

    if spans is None:
        spans = np.tile([0, x.size - 1], (y.size - 1, 1))
    on_x, on_y = _levels_of_lines(surface, x), _levels_of_lines(surface, y)
    vertices, faces = lay_out(pyramid(surface), surface.spacing_m, x, y, on_x, on_y, spans)
    return trimesh.Trimesh(vertices, faces, process=False, validate=False)


def cells_in_hull(
    x: Float[np.ndarray, "columns"],
    y: Float[np.ndarray, "rows"],
    places: Float[np.ndarray, "places 2"],
) -> Int[np.ndarray, "strips 2"]:
    """The spans of a grid's cells, for `ground_mesh`, that reach into the convex hull of places not all on one line."""
    hull = places[ConvexHull(places).vertices]
    spans: Int[np.ndarray, "strips 2"] = spans_in_hull(x, y, hull)
    return spans


def _levels_of_lines(surface: Surface, lines: Float[np.ndarray, "count"]) -> Int[np.ndarray, "count"]:
    level: Int[np.ndarray, "count"] = np.clip(
        np.floor(np.log2(np.gradient(lines) / surface.spacing_m)), 0, len(surface.levels) - 1
    ).astype(int)
    return level


def lines_in_view(lines: Float[np.ndarray, "count"], low: float, high: float) -> Float[np.ndarray, "kept"]:
    """The lines between two bounds and one more to either side."""
    first = max(int(np.searchsorted(lines, low)) - 2, 0)
    last = min(int(np.searchsorted(lines, high)) + 2, lines.size)
    if last - first < 3:
        first, last = max(min(first, lines.size - 3), 0), min(max(last, 3), lines.size)
    return lines[first:last]
