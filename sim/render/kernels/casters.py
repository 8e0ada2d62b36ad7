"""Occlusion of the sun by triangles (shadow casters), with nested grids perpendicular to the sun's direction.

All rays to the sun are parallel. Projected along the sun's direction, a ray is a point (u, v). The coordinate s of a
triangle's plane and the barycentric weights are linear in u and v. The triangles of each body are listed in the cells
of a grid over the body's projection. The bodies are listed in the cells of a coarse grid over all bodies, and those of
each coarse cell again in the cells of a fine grid over them: most bodies may be in few coarse cells, such as the rocks
around a camera in a scene with hills at a distance of kilometres. A ray is tested only against the triangles of one
cell of each body with a projection that contains the ray.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from marsyard.sim.render.kernels.strips import rotate, unpack_matrix
from marsyard.sim.render.kernels.structs import Flags, Longs
from marsyard.sim.terrain.kernels import Array

#: Grids over all bodies: coarse grid (minimum u and v, cells per metre along u and v); cells along its side; one fine
#: grid per coarse cell: rows of (minimum u and v, cells per metre along u and v, maximum s), and rows of (cells along a
#: side, first cell); start of each fine cell's list and the end of the last list; bodies listed in the fine cells.
SceneGrids = tuple[Array, Longs, Array, Longs, Longs, Longs]
#: Grids of the bodies: one row of (minimum u and v, cells per metre along u and v, maximum s) per body; one row of
#: (cells along a side, first cell) per body; start of each cell's list and the end of the last list; triangles listed
#: in the cells; maximum s of each listed triangle.
BodyGrids = tuple[Array, Longs, Longs, Longs, Array]
#: Triangles prepared for one direction of the sun. Three linear functions (constant, slope along u, slope along v) of
#: each triangle: barycentric weights of its second and third corner, and s of its plane. Axes: unit vectors u and v
#: perpendicular to the sun's direction, and s along it. Grids over all bodies. Grids of the bodies.
Casters = tuple[Array, Array, SceneGrids, BodyGrids]
#: Bounds: minimum u and v, maximum u, v and s.
BoundsUVS = tuple[float, float, float, float, float]
#: Row of a grid: minimum u and v, cells per metre along u and v, maximum s.
GridRow = tuple[float, float, float, float, float]
#: Average number of triangles per cell of a body's grid, and of bodies per cell of a fine grid; maximum number of cells
#: along a side.
TRIANGLES_PER_CELL, BODIES_PER_CELL, MAX_CELLS = 4, 4, 1024
#: Margin of all bounds, metres; larger than rounding errors.
SLACK_M = 1e-6
#: Twice the projected area of a triangle, square metres, below which it is edge-on and casts no shadow.
MIN_DOUBLE_AREA_M2 = 1e-18


@njit(cache=True)
def _project_along_sun(triangles: Array, axes: Array) -> tuple[Array, Array]:
    """Compute bounds of each triangle (minimum u and v, maximum u, v and s), and its linear functions (`Casters`)."""
    bounds = np.empty((triangles.shape[0], 5))
    linear = np.empty((triangles.shape[0], 9))
    projected = np.empty((3, 3))
    for n in range(triangles.shape[0]):
        for corner in range(3):
            x, y, z = triangles[n, corner, 0], triangles[n, corner, 1], triangles[n, corner, 2]
            for k in range(3):
                projected[k, corner] = axes[k, 0] * x + axes[k, 1] * y + axes[k, 2] * z
        for k in range(3):
            if k < 2:
                bounds[n, k] = min(min(projected[k, 0], projected[k, 1]), projected[k, 2]) - SLACK_M
            bounds[n, k + 2] = max(max(projected[k, 0], projected[k, 1]), projected[k, 2]) + SLACK_M
        u, v, s = projected[0, 0], projected[1, 0], projected[2, 0]
        u2, v2, s2 = projected[0, 1] - u, projected[1, 1] - v, projected[2, 1] - s
        u3, v3, s3 = projected[0, 2] - u, projected[1, 2] - v, projected[2, 2] - s
        double_area = u2 * v3 - u3 * v2
        if abs(double_area) < MIN_DOUBLE_AREA_M2:
            linear[n] = math.nan
            continue
        weight2_u, weight2_v = v3 / double_area, -u3 / double_area
        weight3_u, weight3_v = -v2 / double_area, u2 / double_area
        slope_u, slope_v = weight2_u * s2 + weight3_u * s3, weight2_v * s2 + weight3_v * s3
        linear[n, 0], linear[n, 1], linear[n, 2] = -(weight2_u * u + weight2_v * v), weight2_u, weight2_v
        linear[n, 3], linear[n, 4], linear[n, 5] = -(weight3_u * u + weight3_v * v), weight3_u, weight3_v
        linear[n, 6], linear[n, 7], linear[n, 8] = s - slope_u * u - slope_v * v, slope_u, slope_v
    return bounds, linear


@njit(cache=True)
def _enclose_bounds(bounds: Array, first: int, end: int) -> BoundsUVS:
    """Compute bounds that enclose the rows of bounds from `first` to before `end`."""
    u0, v0, u1, v1, s1 = math.inf, math.inf, -math.inf, -math.inf, -math.inf
    for n in range(first, end):
        u0 = min(u0, bounds[n, 0])
        v0 = min(v0, bounds[n, 1])
        u1 = max(u1, bounds[n, 2])
        v1 = max(v1, bounds[n, 3])
        s1 = max(s1, bounds[n, 4])
    return u0, v0, u1, v1, s1


@njit(cache=True)
def _choose_side(items: float) -> int:
    """Choose the number of cells along a side for about one item per cell."""
    return min(max(math.ceil(math.sqrt(items)), 1), MAX_CELLS)


@njit(cache=True, inline="always")
def _find_cell(value: float, low: float, per_metre: float, count: int) -> int:
    """Find the cell of a coordinate; values outside the grid by rounding errors belong to its border cells."""
    return min(max(int((value - low) * per_metre), 0), count - 1)


@njit(cache=True)
def _add_to_cells(bounds: Array, n: int, grid: Array, side: int, first: int, ends: Longs, items: Longs) -> None:
    """Add the n-th row of bounds to the list of each cell of a grid that it overlaps.

    `grid` is a row of `grid_rows` of `_list_in_cells`, `first` the grid's first cell. `ends`, the ends of the cells'
    lists, are updated. With an empty `items` the rows are only counted.
    """
    low, high = _find_cell(bounds[n, 1], grid[1], grid[3], side), _find_cell(bounds[n, 3], grid[1], grid[3], side)
    left, right = _find_cell(bounds[n, 0], grid[0], grid[2], side), _find_cell(bounds[n, 2], grid[0], grid[2], side)
    for i in range(low, high + 1):
        for j in range(left, right + 1):
            cell = first + i * side + j
            if items.size > 0:
                items[ends[cell]] = n
            ends[cell] += 1


@njit(cache=True)
def _list_in_cells(
    bounds: Array, first_row: Longs, grid_rows: Array, sides: Longs, first_cells: Longs
) -> tuple[Longs, Longs]:
    """List the rows of bounds in the cells of grids; rows `first_row[g]` to `first_row[g + 1] - 1` belong to grid g.

    - grid_rows: minimum u and v, cells per metre along u and v of each grid
    - sides, first_cells: cells along a side, and index of the first cell of each grid

    Returns the start of each cell's list (and the end of the last list), and the listed rows.
    """
    grid_count = sides.size
    cells = first_cells[-1] + sides[-1] ** 2 if grid_count > 0 else 0
    starts = np.zeros(cells + 1, dtype=np.int64)
    items = np.empty(0, dtype=np.int64)
    for is_second_pass in range(2):
        # the first pass counts the entries of each cell, the second lists them
        ends = starts[:-1].copy() if is_second_pass else starts[1:]
        for grid in range(grid_count):
            for n in range(first_row[grid], first_row[grid + 1]):
                _add_to_cells(bounds, n, grid_rows[grid], sides[grid], first_cells[grid], ends, items)
        if not is_second_pass:
            for k in range(cells):
                starts[k + 1] += starts[k]
            items = np.empty(starts[-1], dtype=np.int64)
    return starts, items


@njit(cache=True)
def _create_grid_row(bounds: BoundsUVS, side: int) -> GridRow:
    """Create the row of a grid over these bounds, with `side` cells along each side."""
    return bounds[0], bounds[1], side / (bounds[2] - bounds[0]), side / (bounds[3] - bounds[1]), bounds[4]


@njit(cache=True)
def list_casters(triangles: Array, first_triangle: Longs, axes: Array) -> Casters:
    """Project the triangles along the sun's direction and list them in grids.

    - triangles, first_triangle: corners; body b consists of the triangles `first_triangle[b]` to
      `first_triangle[b + 1] - 1`
    - axes: rows are the unit vectors u, v and s; s points to the sun
    """
    bodies = first_triangle.size - 1
    bounds, linear = _project_along_sun(triangles, axes)
    body_bounds = np.empty((bodies, 5))
    body_grids = np.empty((bodies, 5))
    layouts = np.empty((bodies, 2), dtype=np.int64)
    cells = 0
    for body in range(bodies):
        first, end = first_triangle[body], first_triangle[body + 1]
        side = _choose_side((end - first) / TRIANGLES_PER_CELL)
        enclosing = _enclose_bounds(bounds, first, end)
        body_bounds[body], body_grids[body] = enclosing, _create_grid_row(enclosing, side)
        layouts[body, 0], layouts[body, 1] = side, cells
        cells += side * side
    triangle_starts, listed_triangles = _list_in_cells(
        bounds, first_triangle, body_grids, layouts[:, 0].copy(), layouts[:, 1].copy()
    )
    max_s = np.empty(listed_triangles.size)
    for k in range(listed_triangles.size):
        max_s[k] = bounds[listed_triangles[k], 4]
    return linear, axes, _list_bodies(body_bounds), (body_grids, layouts, triangle_starts, listed_triangles, max_s)


@njit(cache=True)
def _list_bodies(body_bounds: Array) -> SceneGrids:
    """List the bodies in the cells of a coarse grid, and the bodies of each of these cells in a fine grid."""
    bodies = body_bounds.shape[0]
    sides = np.array([_choose_side(float(bodies))])
    coarse = np.array([[0.0, 0.0, 1.0, 1.0, 0.0]])
    if bodies > 0:
        coarse[0] = _create_grid_row(_enclose_bounds(body_bounds, 0, bodies), sides[0])
    coarse_starts, coarse_bodies = _list_in_cells(
        body_bounds, np.array([0, bodies]), coarse, sides, np.zeros(1, dtype=np.int64)
    )
    bounds = body_bounds[coarse_bodies]
    fine_grids = np.empty((coarse_starts.size - 1, 5))
    layouts = np.empty((coarse_starts.size - 1, 2), dtype=np.int64)
    cells = 0
    for cell in range(coarse_starts.size - 1):
        first, end = coarse_starts[cell], coarse_starts[cell + 1]
        mean_area = _clip_to_cell(bounds, first, end, coarse[0], cell % sides[0], cell // sides[0])
        fine_side = 1
        fine_grids[cell] = 0.0, 0.0, 1.0, 1.0, 0.0
        if end > first:
            enclosing = _enclose_bounds(bounds, first, end)
            # cells smaller than the bodies would list each body many times
            area = (enclosing[2] - enclosing[0]) * (enclosing[3] - enclosing[1])
            fine_side = _choose_side(min((end - first) / BODIES_PER_CELL, area / mean_area))
            fine_grids[cell] = _create_grid_row(enclosing, fine_side)
        layouts[cell, 0], layouts[cell, 1] = fine_side, cells
        cells += fine_side * fine_side
    starts, rows = _list_in_cells(bounds, coarse_starts, fine_grids, layouts[:, 0].copy(), layouts[:, 1].copy())
    return coarse[0, :4].copy(), sides, fine_grids, layouts, starts, coarse_bodies[rows]


@njit(cache=True)
def _clip_to_cell(bounds: Array, first: int, end: int, grid: Array, column: int, row: int) -> float:
    """Clip rows of bounds in place to a cell of a grid, with a margin; return their mean area (0 without rows)."""
    low_u, high_u = grid[0] + column / grid[2] - SLACK_M, grid[0] + (column + 1) / grid[2] + SLACK_M
    low_v, high_v = grid[1] + row / grid[3] - SLACK_M, grid[1] + (row + 1) / grid[3] + SLACK_M
    total_area = 0.0
    for n in range(first, end):
        bounds[n, 0], bounds[n, 2] = max(bounds[n, 0], low_u), min(bounds[n, 2], high_u)
        bounds[n, 1], bounds[n, 3] = max(bounds[n, 1], low_v), min(bounds[n, 3], high_v)
        total_area += (bounds[n, 2] - bounds[n, 0]) * (bounds[n, 3] - bounds[n, 1])
    return total_area / max(end - first, 1)


@njit(cache=True)
def find_occluded_positions(casters: Casters, x: Array, y: Array, z: Array, hidden: Flags) -> None:
    """Test whether a triangle occludes the sun at each position; `hidden` is the output.

    All positions are tested in one call, because passing the arrays takes longer than testing most positions.
    """
    linear, axes, (grid, sides, fine_grids, fine_layouts, body_starts, listed_bodies), body_lists = casters
    body_grids, layouts, triangle_starts, listed_triangles, max_s = body_lists
    to_axes = unpack_matrix(axes)
    side = sides[0]
    min_u, min_v, per_u, per_v = grid[0], grid[1], grid[2], grid[3]
    for position in range(x.size):
        u, v, s = rotate(to_axes, x[position], y[position], z[position])
        hidden[position] = False
        column = (u - min_u) * per_u
        row = (v - min_v) * per_v
        # bounds have a margin: a ray on the border hits no triangle
        if not (0.0 <= column < side and 0.0 <= row < side):
            continue
        coarse_cell = int(row) * side + int(column)
        fine_side = fine_layouts[coarse_cell, 0]
        column = (u - fine_grids[coarse_cell, 0]) * fine_grids[coarse_cell, 2]
        row = (v - fine_grids[coarse_cell, 1]) * fine_grids[coarse_cell, 3]
        if not (0.0 <= column < fine_side and 0.0 <= row < fine_side):
            continue
        cell = fine_layouts[coarse_cell, 1] + int(row) * fine_side + int(column)
        k = body_starts[cell]
        while k < body_starts[cell + 1] and not hidden[position]:
            body = listed_bodies[k]
            k += 1
            if body_grids[body, 4] < s:
                continue
            body_side = layouts[body, 0]
            column = (u - body_grids[body, 0]) * body_grids[body, 2]
            row = (v - body_grids[body, 1]) * body_grids[body, 3]
            if not (0.0 <= column < body_side and 0.0 <= row < body_side):
                continue
            body_cell = layouts[body, 1] + int(row) * body_side + int(column)
            for m in range(triangle_starts[body_cell], triangle_starts[body_cell + 1]):
                if max_s[m] < s:
                    continue
                n = listed_triangles[m]
                weight2 = linear[n, 0] + linear[n, 1] * u + linear[n, 2] * v
                weight3 = linear[n, 3] + linear[n, 4] * u + linear[n, 5] * v
                above = linear[n, 6] + linear[n, 7] * u + linear[n, 8] * v > s
                if above and weight2 >= 0.0 and weight3 >= 0.0 and weight2 + weight3 <= 1.0:
                    hidden[position] = True
                    break
