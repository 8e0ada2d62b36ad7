"""Compiled kernels of the ground's mesh that pyrender draws: selection of cells in view, and their triangles."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from marsyard.sim.terrain.kernels import Array, Level, sample

Longs = NDArray[np.int64]


@njit(cache=True)
def spans_in_hull(x: Array, y: Array, hull: Array) -> Longs:
    """Select the cells of a grid that overlap a convex polygon; return first and end cell of each strip, (strips, 2).

    A strip lies between two successive lines of y. `x` and `y` are increasing; `hull` contains the polygon's corners in
    order, shape (corners, 2).
    """
    spans = np.empty((y.size - 1, 2), dtype=np.int64)
    for strip in range(y.size - 1):
        low, high = y[strip], y[strip + 1]
        min_x, max_x = math.inf, -math.inf
        for k in range(hull.shape[0]):
            x0, y0 = hull[k - 1, 0], hull[k - 1, 1]
            x1, y1 = hull[k, 0], hull[k, 1]
            if min(y0, y1) > high or max(y0, y1) < low:
                continue
            # the part of the polygon's side inside the strip
            for strip_y, corner_x in ((low, x0), (high, x1)):
                edge_x = corner_x if y0 == y1 else x0 + min(max((strip_y - y0) / (y1 - y0), 0.0), 1.0) * (x1 - x0)
                min_x = min(min_x, edge_x)
                max_x = max(max_x, edge_x)
        first = min(max(int(np.searchsorted(x, min_x, side="right")) - 1, 0), x.size - 1)
        spans[strip, 0] = first
        spans[strip, 1] = min(max(int(np.searchsorted(x, max_x)), first), x.size - 1)
    return spans


@njit(cache=True)
def build_mesh(
    levels: tuple[Level, ...], spacing: float, x: Array, y: Array, level_of_x: Longs, level_of_y: Longs, spans: Longs
) -> tuple[Array, NDArray[np.uint32]]:
    """Triangulate the selected cells of a grid: vertices, metres, and faces, counter-clockwise seen from above.

    `level_of_x` and `level_of_y` are the terrain levels of the grid lines; a vertex has the height of the coarser level
    of its two lines. `spans` are those of `spans_in_hull`.
    """
    lines = y.size
    # the vertices of a line are the corners of the selected cells on both sides of it
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
    # index of the vertex in column 0 of each line, if the line began there
    starts = np.empty(lines, dtype=np.int64)
    count = 0
    for line in range(lines):
        starts[line] = count - left[line]
        count += max(right[line] + 1 - left[line], 0)
    vertices = np.empty((count, 3))
    for line in range(lines):
        for column in range(left[line], right[line] + 1):
            level = max(level_of_x[column], level_of_y[line])
            inverse_spacing = 1.0 / (spacing * 2.0**level)
            height, _slope_x, _slope_y, _albedo = sample(levels[level], inverse_spacing, x[column], y[line])
            n = starts[line] + column
            vertices[n, 0], vertices[n, 1], vertices[n, 2] = x[column], y[line], height
    faces = np.empty((2 * cells, 3), dtype=np.uint32)
    n = 0
    for strip in range(lines - 1):
        for cell in range(spans[strip, 0], spans[strip, 1]):
            lower, upper = starts[strip] + cell, starts[strip + 1] + cell
            # the two triangles of a cell are successive, so that OpenGL transforms their common vertices once
            faces[n, 0], faces[n, 1], faces[n, 2] = lower, lower + 1, upper + 1
            faces[n + 1, 0], faces[n + 1, 1], faces[n + 1, 2] = lower, upper + 1, upper
            n += 2
    return vertices, faces
