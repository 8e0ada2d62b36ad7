"""What hides the sun from a place: triangles, listed by where they lie across the sun's rays.

All rays to the sun run the same way: seen along it, each is a point, and where it meets a triangle's plane, and with
which weights of the corners, is linear in the point. The triangles of a body are listed in the cells of a grid over the
body's outline as the sun sees it, and bodies in the cells of one grid over them all. A ray is then held against the few
triangles of one cell of each body in whose outline it lies.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from marsyard.sim.render.kernels.strips import Longs, numbers, times
from marsyard.sim.terrain.kernels import Array

#: Cells of a grid: least u and v, cells a metre along u and v; columns, rows; the first item of each cell, and one more
#: at the end; the items.
Grid = tuple[Array, Longs, Longs, Longs]
#: The same for every body: rows of outlines (least u and v, cells a metre along both, greatest s) and of columns, rows
#: and first cell; first item of each cell; triangles in cells; greatest s of each of these.
BodyGrids = tuple[Array, Longs, Longs, Longs, Array]
#: What of each triangle is linear in u and v, as constant, slope along u and slope along v: the weights of its second
#: and third corner, and s of its plane; unit vectors u and v across the sun's direction, and s along it; grids.
Casters = tuple[Array, Array, Grid, BodyGrids]
#: Triangles to a cell of a body's grid, if none reached over more than one, and most cells along a side of a grid.
TO_A_CELL, MOST_CELLS = 4, 1024
#: Slack of all bounds, metres: more than rounding.
SLACK_M = 1e-6


#: Twice the area in which the sun sees a triangle, square metres, below which it is seen edge-on and hides nothing.
EDGE_ON = 1e-18


@njit(cache=True)
def _as_the_sun_sees(triangles: Array, axes: Array) -> tuple[Array, Array]:
    """Least u and v, greatest u, v and s of each triangle; and what of it is linear in u and v (`Casters`)."""
    bounds = np.empty((triangles.shape[0], 5))
    linear = np.empty((triangles.shape[0], 9))
    at = np.empty((3, 3))
    for n in range(triangles.shape[0]):
        for corner in range(3):
            x, y, z = triangles[n, corner, 0], triangles[n, corner, 1], triangles[n, corner, 2]
            for k in range(3):
                at[k, corner] = axes[k, 0] * x + axes[k, 1] * y + axes[k, 2] * z
        for k in range(3):
            if k < 2:
                bounds[n, k] = min(min(at[k, 0], at[k, 1]), at[k, 2]) - SLACK_M
            bounds[n, k + 2] = max(max(at[k, 0], at[k, 1]), at[k, 2]) + SLACK_M
        u, v, s = at[0, 0], at[1, 0], at[2, 0]
        u2, v2, s2 = at[0, 1] - u, at[1, 1] - v, at[2, 1] - s
        u3, v3, s3 = at[0, 2] - u, at[1, 2] - v, at[2, 2] - s
        area = u2 * v3 - u3 * v2
        if abs(area) < EDGE_ON:
            linear[n] = math.nan
            continue
        second_u, second_v = v3 / area, -u3 / area
        third_u, third_v = -v2 / area, u2 / area
        slope_u, slope_v = second_u * s2 + third_u * s3, second_v * s2 + third_v * s3
        linear[n, 0], linear[n, 1], linear[n, 2] = -(second_u * u + second_v * v), second_u, second_v
        linear[n, 3], linear[n, 4], linear[n, 5] = -(third_u * u + third_v * v), third_u, third_v
        linear[n, 6], linear[n, 7], linear[n, 8] = s - slope_u * u - slope_v * v, slope_u, slope_v
    return bounds, linear


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
    bounds, linear = _as_the_sun_sees(triangles, axes)
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
    return linear, axes, _listed_bodies(rects), (outlines, shapes, starts, items, tops)


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
def sun_hidden(casters: Casters, x: Array, y: Array, z: Array, hidden: NDArray[np.bool_]) -> None:
    """Whether a triangle stands between each of some places and the sun; `hidden` is the output.

    All places in one call: handing over so many arrays takes longer than most places do.
    """
    linear, axes, (grid, sides, starts, items), (outlines, shapes, first_items, listed, tops) = casters
    to_axes = numbers(axes)
    side = sides[0]
    west, south, per_u, per_v = grid[0], grid[1], grid[2], grid[3]
    for place in range(x.size):
        u, v, s = times(to_axes, x[place], y[place], z[place])
        hidden[place] = False
        column = (u - west) * per_u
        row = (v - south) * per_v
        # bounds have slack: a ray on the border meets nothing
        if not (0.0 <= column < side and 0.0 <= row < side):
            continue
        of_all = int(row) * side + int(column)
        k = starts[of_all]
        while k < starts[of_all + 1] and not hidden[place]:
            body = items[k]
            k += 1
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
                n = listed[m]
                second = linear[n, 0] + linear[n, 1] * u + linear[n, 2] * v
                third = linear[n, 3] + linear[n, 4] * u + linear[n, 5] * v
                above = linear[n, 6] + linear[n, 7] * u + linear[n, 8] * v > s
                if above and second >= 0.0 and third >= 0.0 and second + third <= 1.0:
                    hidden[place] = True
                    break
