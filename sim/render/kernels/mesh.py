"""Compiled kernels of the ground's mesh: the cells that a picture shows, their corners and faces."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from marsyard.sim.render.kernels.structs import Longs
from marsyard.sim.terrain.kernels import Array, Level, sample


@njit(cache=True)
def spans_in_hull(x: Array, y: Array, hull: Array) -> Longs:
    """First cell of each strip between two lines of y that reaches into a convex polygon, and the one after the last.

    Parameters
    ----------
    x, y
        The grid's lines, increasing.
    hull
        Corners of the polygon in order, shape (corners, 2).
    """
    spans = np.empty((y.size - 1, 2), dtype=np.int64)
    for strip in range(y.size - 1):
        low, high = y[strip], y[strip + 1]
        least, greatest = math.inf, -math.inf
        for k in range(hull.shape[0]):
            x0, y0 = hull[k - 1, 0], hull[k - 1, 1]
            x1, y1 = hull[k, 0], hull[k, 1]
            if min(y0, y1) > high or max(y0, y1) < low:
                continue
            # a side of the polygon, from where it enters the strip to where it leaves it
            for level, end in ((low, x0), (high, x1)):
                at = end if y0 == y1 else x0 + min(max((level - y0) / (y1 - y0), 0.0), 1.0) * (x1 - x0)
                least = min(least, at)
                greatest = max(greatest, at)
        first = min(max(int(np.searchsorted(x, least, side="right")) - 1, 0), x.size - 1)
        spans[strip, 0] = first
        spans[strip, 1] = min(max(int(np.searchsorted(x, greatest)), first), x.size - 1)
    return spans


@njit(cache=True)
def lay_out(
    levels: tuple[Level, ...], spacing: float, x: Array, y: Array, level_of_x: Longs, level_of_y: Longs, spans: Longs
) -> tuple[Array, NDArray[np.uint32]]:
    """Corners and faces of some cells of a grid, their heights taken from the coarser level of the two lines there.

    Parameters
    ----------
    levels, spacing
        The surface's pyramid, and the spacing of its level 0.
    x, y, level_of_x, level_of_y
        The grid's lines, and the level that suits each.
    spans
        As `spans_in_hull` gives them.

    Returns
    -------
    Shape (corners, 3), metres, and (2 cells, 3), counter-clockwise seen from above.
    """
    lines = y.size
    # a line has the corners of the cells to both its sides; where none is drawn it has none
    left = np.full(lines, x.size, dtype=np.int64)
    right = np.full(lines, -1, dtype=np.int64)
    cells = 0
    for strip in range(lines - 1):
        first, end = spans[strip, 0], spans[strip, 1]
        cells += end - first
        for line in range(strip, strip + 2):
            if end > first:
                left[line] = min(left[line], first)
                right[line] = max(right[line], end)
    starts = np.empty(lines, dtype=np.int64)
    count = 0
    for line in range(lines):
        starts[line] = count - left[line]
        count += max(right[line] + 1 - left[line], 0)
    corners = np.empty((count, 3))
    for line in range(lines):
        for column in range(left[line], right[line] + 1):
            level = max(level_of_x[column], level_of_y[line])
            inverse_spacing = 1.0 / (spacing * 2.0**level)
            height, _slope_x, _slope_y, _albedo = sample(levels[level], inverse_spacing, x[column], y[line])
            n = starts[line] + column
            corners[n, 0] = x[column]
            corners[n, 1] = y[line]
            corners[n, 2] = height
    faces = np.empty((2 * cells, 3), dtype=np.uint32)
    n = 0
    for strip in range(lines - 1):
        for cell in range(spans[strip, 0], spans[strip, 1]):
            corner, above = starts[strip] + cell, starts[strip + 1] + cell
            # a cell's two triangles follow each other: corners are then handed to the next at hand, not seen to twice
            faces[n, 0], faces[n, 1], faces[n, 2] = corner, corner + 1, above + 1
            faces[n + 1, 0], faces[n + 1, 1], faces[n + 1, 2] = corner, above + 1, above
            n += 2
    return corners, faces
