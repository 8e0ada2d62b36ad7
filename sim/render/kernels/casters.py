"""What hides the sun from a place: triangles, listed by where they lie across the sun's rays.

All rays to the sun run the same way: seen along it, each is a point. The triangles of a body are listed in the cells of
a grid over the body's outline as the sun sees it, and bodies in the cells of one grid over them all. A ray is then held
against the few triangles of one cell of each body in whose outline it lies.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim.render.kernels.intersection import hit_triangle
from sim.terrain.kernels import Array

Longs = NDArray[np.int64]
#: Cells of a grid: least u and v, cells a metre along u and v; columns, rows; the first item of each cell, and one more
#: at the end; the items.
Grid = tuple[Array, Longs, Longs, Longs]
#: The same for every body: rows of outlines (least u and v, cells a metre along both, greatest s) and of columns, rows
#: and first cell; first item of each cell; triangles in cells; greatest s of each of these.
BodyGrids = tuple[Array, Longs, Longs, Longs, Array]
#: Triangles; two unit vectors across the sun's direction, u and v, and that itself, s; grids.
Casters = tuple[Array, Array, Grid, BodyGrids]
#: Triangles to a cell of a body's grid, if none reached over more than one, and most cells along a side of a grid.
TO_A_CELL, MOST_CELLS = 4, 1024
#: Slack of all bounds, metres: more than rounding.
SLACK_M = 1e-6


@njit(cache=True)
def _bounds(triangles: Array, axes: Array) -> Array:
    """Least u and v, greatest u, v and s of each triangle."""
    bounds = np.empty((triangles.shape[0], 5))
    for n in range(triangles.shape[0]):
        for k in range(3):
            low = math.inf
            high = -math.inf
            for corner in range(3):
                value = (
                    axes[k, 0] * triangles[n, corner, 0]
                    + axes[k, 1] * triangles[n, corner, 1]
                    + axes[k, 2] * triangles[n, corner, 2]
                )
                low = min(low, value)
                high = max(high, value)
            if k < 2:
                bounds[n, k] = low - SLACK_M
            bounds[n, k + 2] = high + SLACK_M
    return bounds


@njit(cache=True)
def _joint(bounds: Array, first: int, end: int) -> tuple[float, float, float, float, float]:
    """Bounds of some rows of bounds."""
    u0, v0, u1, v1, s1 = math.inf, math.inf, -math.inf, -math.inf, -math.inf
    for n in range(first, end):
        u0 = min(u0, bounds[n, 0])
        v0 = min(v0, bounds[n, 1])
        u1 = max(u1, bounds[n, 2])
        v1 = max(v1, bounds[n, 3])
        s1 = max(s1, bounds[n, 4])
    return u0, v0, u1, v1, s1


@njit(cache=True)
def _side(items: float) -> int:
    """Cells along a side for so many items to be one to a cell."""
    return min(max(math.ceil(math.sqrt(items)), 1), MOST_CELLS)


@njit(cache=True, inline="always")
def _cell(value: float, low: float, per_metre: float, count: int) -> int:
    """The cell of a coordinate; those at the borders hold what rounding carries over."""
    return min(max(int((value - low) * per_metre), 0), count - 1)


@njit(cache=True)
def _count(
    bounds: Array, n: int, grid: tuple[float, float, float, float], side: int, first: int, counts: Longs
) -> None:
    """Counts a row of bounds in each cell that it touches."""
    u0, v0, per_u, per_v = grid
    for i in range(_cell(bounds[n, 1], v0, per_v, side), _cell(bounds[n, 3], v0, per_v, side) + 1):
        for j in range(_cell(bounds[n, 0], u0, per_u, side), _cell(bounds[n, 2], u0, per_u, side) + 1):
            counts[first + i * side + j] += 1


@njit(cache=True)
def _list(
    bounds: Array, n: int, grid: tuple[float, float, float, float], side: int, first: int, ends: Longs, items: Longs
) -> None:
    """Lists a row of bounds in each cell that it touches; `ends` are where the cells' lists begin, moved on."""
    u0, v0, per_u, per_v = grid
    for i in range(_cell(bounds[n, 1], v0, per_v, side), _cell(bounds[n, 3], v0, per_v, side) + 1):
        for j in range(_cell(bounds[n, 0], u0, per_u, side), _cell(bounds[n, 2], u0, per_u, side) + 1):
            cell = first + i * side + j
            items[ends[cell]] = n
            ends[cell] += 1


@njit(cache=True)
def _starts(counts: Longs) -> Longs:
    """Where the list of each cell begins, and where the last one ends."""
    starts = np.zeros(counts.size + 1, dtype=np.int64)
    for k in range(counts.size):
        starts[k + 1] = starts[k] + counts[k]
    return starts


@njit(cache=True)
def listed_casters(triangles: Array, first_triangle: Longs, axes: Array) -> Casters:
    """The lists for bodies of triangles that follow each other, and a sun in the direction of the third axis."""
    bodies = first_triangle.size - 1
    bounds = _bounds(triangles, axes)
    outlines = np.empty((bodies, 5))
    sides = np.empty(bodies, dtype=np.int64)
    first_cells = np.empty(bodies, dtype=np.int64)
    rects = np.empty((bodies, 5))
    cells = 0
    for body in range(bodies):
        first, end = first_triangle[body], first_triangle[body + 1]
        u0, v0, u1, v1, s1 = _joint(bounds, first, end)
        side = _side((end - first) / TO_A_CELL)
        rects[body, 0], rects[body, 1], rects[body, 2], rects[body, 3], rects[body, 4] = u0, v0, u1, v1, s1
        outlines[body, 0], outlines[body, 1] = u0, v0
        outlines[body, 2], outlines[body, 3], outlines[body, 4] = side / (u1 - u0), side / (v1 - v0), s1
        sides[body], first_cells[body] = side, cells
        cells += side * side
    counts = np.zeros(cells, dtype=np.int64)
    for body in range(bodies):
        grid = (outlines[body, 0], outlines[body, 1], outlines[body, 2], outlines[body, 3])
        for n in range(first_triangle[body], first_triangle[body + 1]):
            _count(bounds, n, grid, sides[body], first_cells[body], counts)
    starts = _starts(counts)
    items = np.empty(starts[-1], dtype=np.int64)
    ends = starts[:-1].copy()
    for body in range(bodies):
        grid = (outlines[body, 0], outlines[body, 1], outlines[body, 2], outlines[body, 3])
        for n in range(first_triangle[body], first_triangle[body + 1]):
            _list(bounds, n, grid, sides[body], first_cells[body], ends, items)
    tops = np.empty(items.size)
    for k in range(items.size):
        tops[k] = bounds[items[k], 4]
    shapes = np.empty((bodies, 2), dtype=np.int64)
    shapes[:, 0], shapes[:, 1] = sides, first_cells
    return triangles, axes, _listed_bodies(rects), (outlines, shapes, starts, items, tops)


@njit(cache=True)
def _listed_bodies(rects: Array) -> Grid:
    """The grid over all bodies."""
    bodies = rects.shape[0]
    side = _side(float(bodies))
    u0, v0, u1, v1, _s1 = _joint(rects, 0, bodies)
    grid = (u0, v0, side / (u1 - u0), side / (v1 - v0)) if bodies > 0 else (0.0, 0.0, 1.0, 1.0)
    counts = np.zeros(side * side, dtype=np.int64)
    for body in range(bodies):
        _count(rects, body, grid, side, 0, counts)
    starts = _starts(counts)
    items = np.empty(starts[-1], dtype=np.int64)
    ends = starts[:-1].copy()
    for body in range(bodies):
        _list(rects, body, grid, side, 0, ends, items)
    return np.array(grid), np.array([side]), starts, items


@njit(cache=True)
def hides_sun(casters: Casters, x: float, y: float, z: float) -> bool:
    """Whether a triangle stands between a place and the sun."""
    triangles, axes, (grid, sides, starts, items), (outlines, shapes, first_items, listed, tops) = casters
    u = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z
    v = axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z
    s = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z
    side = sides[0]
    column = (u - grid[0]) * grid[2]
    row = (v - grid[1]) * grid[3]
    # bounds have slack: a ray on the border meets nothing
    if not (0.0 <= column < side and 0.0 <= row < side):
        return False
    of_all = int(row) * side + int(column)
    for k in range(starts[of_all], starts[of_all + 1]):
        body = items[k]
        if outlines[body, 4] < s:
            continue
        fine = shapes[body, 0]
        column = (u - outlines[body, 0]) * outlines[body, 2]
        row = (v - outlines[body, 1]) * outlines[body, 3]
        if not (0.0 <= column < fine and 0.0 <= row < fine):
            continue
        cell = shapes[body, 1] + int(row) * fine + int(column)
        for m in range(first_items[cell], first_items[cell + 1]):
            if tops[m] < s:
                continue
            t, second, third = hit_triangle(triangles, listed[m], x, y, z, axes[2, 0], axes[2, 1], axes[2, 2])
            if 0.0 < t < math.inf and second >= 0.0 and third >= 0.0 and second + third <= 1.0:
                return True
    return False
