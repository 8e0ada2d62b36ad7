"""Occlusion of the sun by triangles (shadow casters), with nested grids perpendicular to the sun's direction.

All rays to the sun are parallel. Projected along the sun's direction, a ray is a point (u, v). The coordinate s of a
triangle's plane and the barycentric weights are linear in u and v. The triangles of each body are listed in the cells
of a grid over the body's projection. The bodies are listed in the cells of a coarse grid over all bodies, and those of
each coarse cell again in the cells of a fine grid over them: most bodies may be in few coarse cells, such as the rocks
around a camera in a scene with hills at a distance of kilometres. A ray is tested only against the triangles of one
cell of each body with a projection that contains the ray.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np
from jaxtyping import Float32, Int64
from jaxtyping import Float64 as FloatArray
from scipy.sparse import coo_array

from marsyard.sim.render.device import (
    Array2f,
    Array2f64,
    Array4f,
    Bool,
    Float,
    Float64,
    Int32,
    Matrix3f64,
    UInt32,
    Values,
    to_device,
)

#: Minimum u, v and s, then maximum u, v and s, of items.
Bounds = FloatArray[np.ndarray, "items 6"]
#: Average number of triangles per cell of a body's grid, and of bodies per cell of a fine grid; maximum number of cells
#: along a side.
TRIANGLES_PER_CELL, BODIES_PER_CELL, MAX_CELLS = 4, 4, 1024
#: Margin of all bounds, metres; larger than rounding errors.
SLACK_M = 1e-6
#: Twice the projected area of a triangle, square metres, below which it is edge-on and casts no shadow.
MIN_DOUBLE_AREA_M2 = 1e-18


@dataclass(frozen=True, eq=False)
class Grids:
    """Grids of square numbers of cells, and the items listed in each cell.

    - low, cells_per_metre: minimum u, v, and cells per metre along u, v of each grid
    - side, first_cell: cells along a side, and first cell of each grid; the cells of all grids follow each other
    - starts, items: start of each cell's list (and the end of the last list), and the listed items
    """

    low: Values
    cells_per_metre: Values
    side: Values
    first_cell: Values
    starts: Values
    items: Values

    def locate(self, grid: Values, u: Values, v: Values, active: Values) -> tuple[Values, Values]:
        """Return the position of u, v relative to the corner of a grid, metres."""
        low = dr.gather(Array2f64, self.low, grid, active)
        return Float(u - low.x), Float(v - low.y)

    def find_cell(self, grid: Values, u: Values, v: Values, active: Values) -> tuple[Values, Values]:
        """Return the cell of a grid at a position from `locate`, and whether the position is inside the grid."""
        side, per_metre = (
            dr.gather(Int32, self.side, grid, active),
            dr.gather(Array2f, self.cells_per_metre, grid, active),
        )
        column, row, count = u * per_metre.x, v * per_metre.y, Float(side)
        # bounds have a margin: a ray on the border hits nothing
        is_inside = active & (column >= 0.0) & (row >= 0.0) & (column < count) & (row < count)
        first = dr.gather(UInt32, self.first_cell, grid, is_inside)
        return first + UInt32(Int32(row) * side + Int32(column)), is_inside

    def list_range(self, grid: Values, u: Values, v: Values, active: Values) -> tuple[Values, Values]:
        """Return first and end index in `items` of the cell at a position; equal if it is outside the grid."""
        cell, is_inside = self.find_cell(grid, u, v, active)
        return dr.gather(UInt32, self.starts, cell, is_inside), dr.gather(UInt32, self.starts, cell + 1, is_inside)


@dataclass(frozen=True, eq=False)
class Casters:
    """Triangles prepared for one direction of the sun.

    - axes: rows are the unit vectors u and v perpendicular to the sun's direction, and s along it
    - functions: three linear functions of each triangle: barycentric weights of its second and third corner, and s of
      its plane above the top of its body. A function is its value at the corner of the grid of the triangle's body,
      slope along u, slope along v, and 0
    - coarse, fine, bodies: the grid over all bodies, a grid for each of its cells, and a grid for each body
    - body_top: maximum s of each body
    """

    axes: Values
    functions: Values
    coarse: Grids
    fine: Grids
    bodies: Grids
    body_top: Values


def _bound(projected: np.ndarray) -> Bounds:
    """Compute the bounds of projected triangles, with a margin."""
    a, b, c = (projected[:, corner] for corner in range(3))
    low, high = np.minimum(np.minimum(a, b), c) - SLACK_M, np.maximum(np.maximum(a, b), c) + SLACK_M
    return np.concatenate([low, high], axis=1)


def _linear_functions(projected: np.ndarray, origins: np.ndarray) -> Float32[np.ndarray, "triangles 3 4"]:
    """Compute the linear functions (`Casters`) of projected triangles, relative to origins; NaN if they are edge-on."""
    u, v, s = (projected[:, 0] - origins).T
    (u2, v2, s2), (u3, v3, s3) = ((projected[:, corner] - projected[:, 0]).T for corner in (1, 2))
    double_area = u2 * v3 - u3 * v2
    double_area[np.abs(double_area) < MIN_DOUBLE_AREA_M2] = np.nan
    second_u, second_v, third_u, third_v = (slope / double_area for slope in (v3, -u3, -v2, u2))
    plane_u, plane_v = second_u * s2 + third_u * s3, second_v * s2 + third_v * s3
    functions = np.zeros((len(projected), 3, 4), dtype=np.float32)
    slopes = ((0.0, second_u, second_v), (0.0, third_u, third_v), (s, plane_u, plane_v))
    for k, (value, slope_u, slope_v) in enumerate(slopes):
        functions[:, k, 0], functions[:, k, 1], functions[:, k, 2] = value - slope_u * u - slope_v * v, slope_u, slope_v
    return functions


def _enclose(bounds: Bounds, first: Int64[np.ndarray, "groups"]) -> FloatArray[np.ndarray, "groups 6"]:
    """Compute the bounds of groups of successive items, which begin at `first`; no group may be empty."""
    low, high = (
        ufunc.reduceat(bounds[:, side], first) for ufunc, side in ((np.minimum, np.s_[:3]), (np.maximum, np.s_[3:]))
    )
    return np.concatenate([low, high], axis=1)


def _choose_sides(items: np.ndarray) -> Int64[np.ndarray, "grids"]:
    """Choose the number of cells along a side for about one item per cell."""
    return np.asarray(np.clip(np.ceil(np.sqrt(items)), 1, MAX_CELLS).astype(np.int64))


def _list_in_grids(
    bounds: Bounds,
    grid_of_item: Int64[np.ndarray, "items"],
    enclosing: FloatArray[np.ndarray, "grids 6"],
    sides: Int64[np.ndarray, "grids"],
    numbers: Int64[np.ndarray, "items"] | None = None,
) -> tuple[Grids, Int64[np.ndarray, "cells+1"], Int64[np.ndarray, "listed"]]:
    """List items in the cells of grids over `enclosing` bounds; `numbers` replaces the numbers of the listed items.

    Returns the grids, and on the host the start of each cell's list and the listed items.
    """
    low = enclosing[:, :2]
    cells_per_metre = sides[:, None] / (enclosing[:, 3:5] - low)
    first_cell = np.cumsum([0, *sides**2])
    # cells at both corners of an item; positions outside the grid by rounding errors belong to its border cells
    side = sides[grid_of_item, None]
    corners = [
        np.clip(((corner - low[grid_of_item]) * cells_per_metre[grid_of_item]).astype(np.int64), 0, side - 1)
        for corner in (bounds[:, :2], bounds[:, 3:5])
    ]
    columns, rows = (corners[1] - corners[0] + 1).T
    listed = np.repeat(np.arange(len(bounds)), columns * rows)
    position = np.arange(len(listed)) - np.repeat(np.cumsum(columns * rows) - columns * rows, columns * rows)
    row, column = np.divmod(position, columns[listed])
    cell = (
        first_cell[grid_of_item[listed]]
        + (corners[0][listed, 1] + row) * side[listed, 0]
        + corners[0][listed, 0]
        + column
    )
    lists = coo_array(
        (np.ones(len(listed), dtype=np.int8), (cell, listed)), shape=(int(first_cell[-1]), len(bounds))
    ).tocsr()
    starts, items = np.asarray(lists.indptr), np.asarray(lists.indices)
    grids = Grids(
        to_device(Float64, low),
        to_device(Float, cells_per_metre),
        to_device(Int32, sides),
        to_device(UInt32, first_cell[:-1]),
        to_device(UInt32, starts),
        to_device(UInt32, items if numbers is None else numbers[items]),
    )
    return grids, starts, items


def list_casters(triangles: np.ndarray, first_triangle: Int64[np.ndarray, "bodies+1"], axes: np.ndarray) -> Casters:
    """Project the triangles along the sun's direction and list them in grids.

    - triangles, first_triangle: corners; body b consists of the triangles `first_triangle[b]` to
      `first_triangle[b + 1] - 1`
    - axes: rows are the unit vectors u, v and s; s points to the sun
    """
    projected, counts = triangles @ axes.T, np.diff(first_triangle)
    bounds, body_of_triangle = _bound(projected), np.repeat(np.arange(len(counts)), counts)
    body_bounds = _enclose(bounds, first_triangle[:-1])
    bodies, _, _ = _list_in_grids(bounds, body_of_triangle, body_bounds, _choose_sides(counts / TRIANGLES_PER_CELL))
    functions = _linear_functions(projected, body_bounds[:, [0, 1, 5]][body_of_triangle])
    all_bodies = _enclose(body_bounds, np.zeros(1, dtype=np.int64))
    coarse_side = _choose_sides(np.array([len(counts)]))
    coarse, starts, body_of_item = _list_in_grids(
        body_bounds, np.zeros(len(counts), dtype=np.int64), all_bodies, coarse_side
    )
    fine = _list_in_fine_grids(body_bounds, all_bodies[0], int(coarse_side[0]), starts, body_of_item)
    matrix, top = Matrix3f64(*axes.ravel().tolist()), to_device(Float64, body_bounds[:, 5])
    return Casters(matrix, to_device(Float, functions), coarse, fine, bodies, top)


def _list_in_fine_grids(
    body_bounds: Bounds, all_bodies: np.ndarray, coarse_side: int, starts: np.ndarray, body_of_item: np.ndarray
) -> Grids:
    """List the bodies of each coarse cell in a grid over them; bodies are clipped to the coarse cell with a margin."""
    cell = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    low, extent = all_bodies[:2], (all_bodies[3:5] - all_bodies[:2]) / coarse_side
    cell_low = low + extent * np.stack([cell % coarse_side, cell // coarse_side], axis=1)
    clipped = body_bounds[body_of_item]
    clipped[:, :2] = np.maximum(clipped[:, :2], cell_low - SLACK_M)
    clipped[:, 3:5] = np.minimum(clipped[:, 3:5], cell_low + extent + SLACK_M)
    used, counts = np.flatnonzero(np.diff(starts)), np.diff(starts)
    enclosing = np.zeros((len(counts), 6))
    enclosing[:, 3:] = 1.0
    enclosing[used] = _enclose(clipped, starts[:-1][used])
    areas = np.bincount(cell, np.prod(clipped[:, 3:5] - clipped[:, :2], axis=1), len(counts))
    # cells smaller than the bodies would list each body many times
    area = np.prod(enclosing[:, 3:5] - enclosing[:, :2], axis=1)
    wanted = np.minimum(counts / BODIES_PER_CELL, area * counts / np.maximum(areas, 1e-300))
    return _list_in_grids(clipped, cell, enclosing, _choose_sides(wanted), body_of_item)[0]


def are_occluded(casters: Casters, position: Values, active: Values) -> Values:
    """Return whether a triangle occludes the sun at each position."""
    u, v, s = casters.axes @ position
    # the coarse grid lists bodies; its cell is the number of the fine grid
    coarse, fine, bodies = casters.coarse, casters.fine, casters.bodies
    cell, is_inside = coarse.find_cell(UInt32(0), *coarse.locate(UInt32(0), u, v, active), active)
    first, end = fine.list_range(cell, *fine.locate(cell, u, v, is_inside), is_inside)

    def test_body(k: Values, is_hidden: Values, is_active: Values) -> tuple[Values, Values, Values]:
        body = dr.gather(UInt32, fine.items, k, is_active)
        below_top = Float(s - dr.gather(Float64, casters.body_top, body, is_active))
        is_below = is_active & (below_top <= 0.0)
        local_u, local_v = bodies.locate(body, u, v, is_below)
        start, stop = bodies.list_range(body, local_u, local_v, is_below)

        def test_triangle(m: Values, is_hidden: Values, is_tested: Values) -> tuple[Values, Values, Values]:
            n = dr.gather(UInt32, bodies.items, m, is_tested)
            second, third, plane = (
                function.x + function.y * local_u + function.z * local_v
                for function in (dr.gather(Array4f, casters.functions, 3 * n + k, is_tested) for k in range(3))
            )
            is_hidden |= is_tested & (second >= 0.0) & (third >= 0.0) & (second + third <= 1.0) & (plane > below_top)
            return m + 1, is_hidden, is_tested & ~is_hidden & (m + 1 < stop)

        _, is_hidden, _ = dr.while_loop(
            (UInt32(start), is_hidden, is_below & (start < stop)),
            lambda m, is_hidden, is_tested: is_tested,
            test_triangle,
        )
        return k + 1, is_hidden, is_active & ~is_hidden & (k + 1 < end)

    state = (UInt32(first), Bool(False), is_inside & (first < end))
    return dr.while_loop(state, lambda k, is_hidden, is_active: is_active, test_body)[1]
