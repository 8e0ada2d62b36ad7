"""Triangle meshes of the ground around a place, dense near it and coarse far away, without cracks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import brentq
from scipy.spatial import ConvexHull

from sim.terrain import Surface

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
    first, end = spans.T
    # a line has the corners of the cells to both its sides; where none is drawn it has none
    left = np.minimum(np.append(first, x.size), np.append(x.size, first))
    counts = np.maximum(np.maximum(np.append(end, -1), np.append(-1, end)) + 1 - left, 0)
    starts = np.cumsum(counts) - counts
    row, column = _ragged(left, counts)
    level = np.maximum(_levels_of_lines(surface, y)[row], _levels_of_lines(surface, x)[column])
    across, along = x[column], y[row]
    z = np.empty_like(across)
    for one in np.unique(level):
        chosen = level == one
        z[chosen] = surface.height(across[chosen], along[chosen], int(one))
    strip, cell = _ragged(first, end - first)
    corner, above = (starts - left)[strip] + cell, (starts - left)[strip + 1] + cell
    faces = np.empty((2, strip.size, 3), dtype=np.uint32)
    # counter-clockwise seen from above
    for triangle, corners in enumerate(((corner, corner + 1, above + 1), (corner, above + 1, above))):
        for place, number in enumerate(corners):
            faces[triangle, :, place] = number
    vertices = np.stack([across, along, z], axis=-1)
    return trimesh.Trimesh(vertices, faces.reshape(-1, 3), process=False, validate=False)


def _ragged(
    first: Int[np.ndarray, "rows"], counts: Int[np.ndarray, "rows"]
) -> tuple[Int[np.ndarray, "items"], Int[np.ndarray, "items"]]:
    """Row and column of each item of rows of so many items that begin at a column each."""
    row = np.repeat(np.arange(counts.size), counts)
    return row, np.arange(row.size) + np.repeat(first - (np.cumsum(counts) - counts), counts)


def cells_in_hull(
    x: Float[np.ndarray, "columns"],
    y: Float[np.ndarray, "rows"],
    places: Float[np.ndarray, "places 2"],
) -> Int[np.ndarray, "strips 2"]:
    """The spans of a grid's cells, for `ground_mesh`, that reach into the convex hull of places not all on one line."""
    hull = places[ConvexHull(places).vertices]
    (x0, y0), (x1, y1) = hull.T, np.roll(hull, -1, axis=0).T
    low, high = y[:-1, None], y[1:, None]
    # each side of the hull from where it enters a strip to where it leaves it
    rise = np.where(y1 == y0, 1.0, y1 - y0)
    enters, leaves = (x0 + np.clip((level - y0) / rise, 0.0, 1.0) * (x1 - x0) for level in (low, high))
    flat = y1 == y0
    enters, leaves = np.where(flat, x0, enters), np.where(flat, x1, leaves)
    beside = (np.minimum(y0, y1) > high) | (np.maximum(y0, y1) < low)
    least = np.where(beside, np.inf, np.minimum(enters, leaves)).min(axis=1)
    greatest = np.where(beside, -np.inf, np.maximum(enters, leaves)).max(axis=1)
    first = np.clip(np.searchsorted(x, least, side="right") - 1, 0, x.size - 1)
    end = np.clip(np.searchsorted(x, greatest), first, x.size - 1)
    return np.column_stack([first, end])


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
