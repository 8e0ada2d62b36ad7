"""Occlusion of the sun by triangles (shadow casters), with nested grids perpendicular to the sun's direction.

All rays to the sun are parallel. Projected along the sun's direction, a ray is a point (u, v). The coordinate s of a
triangle's plane and the barycentric weights are linear in u and v. The triangles of each body are listed in the cells
of a grid over the body's projection. The bodies are listed in the cells of a coarse grid over all bodies, and those of
each coarse cell again in the cells of a fine grid over them: most bodies may be in few coarse cells, such as the rocks
around a camera in a scene with objects at a distance of kilometres. A ray is tested only against the triangles of one
cell of each body with a projection that contains the ray.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import numpy as np
from jaxtyping import Float64 as FloatArray
from jaxtyping import Int64

from marsyard.sim.render.arrays import Values, larger, smaller, to_device, to_host, vectors_to_device
from marsyard.sim.render.device import (
    Array2f,
    Array2f64,
    Array3f64,
    Array4f,
    Bool,
    Float,
    Float64,
    Int32,
    Matrix3f64,
    UInt32,
)
from marsyard.sim.render.objects import Objects
from marsyard.sim.render.sky import Sun
from marsyard.sim.render.triangles import is_inside

#: Minimum u, v and s, then maximum u, v and s, of items.
Bounds = FloatArray[np.ndarray, "items 6"]
#: Average number of triangles per cell of a body's grid, and of bodies per cell of a fine grid; maximum number of cells
#: along a side.
TRIANGLES_PER_CELL, BODIES_PER_CELL, MAX_CELLS = 4, 4, 1024
#: Margin of all bounds, metres; larger than rounding errors.
SLACK_M = 1e-6
#: Margin of an item in a grid, in cells; larger than the rounding errors of a position in single precision.
CELL_MARGIN = 1e-3
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
        in_grid = active & (column >= 0.0) & (row >= 0.0) & (column < count) & (row < count)
        first = dr.gather(UInt32, self.first_cell, grid, in_grid)
        return first + UInt32(Int32(row) * side + Int32(column)), in_grid

    def list_range(self, grid: Values, u: Values, v: Values, active: Values) -> tuple[Values, Values]:
        """Return first and end index in `items` of the cell at a position; equal if it is outside the grid."""
        cell, in_grid = self.find_cell(grid, u, v, active)
        return dr.gather(UInt32, self.starts, cell, in_grid), dr.gather(UInt32, self.starts, cell + 1, in_grid)


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


def _project(corners: Values, axes: Values) -> tuple[list[Values], Values, Values]:
    """Project triangles along the sun: u, v, s of their three corners, and their bounds with a margin."""
    number = 3 * dr.arange(UInt32, len(corners.x) // 3)
    a, b, c = (axes @ dr.gather(Array3f64, corners, number + k) for k in range(3))
    low, high = smaller(smaller(a, b), c) - SLACK_M, larger(larger(a, b), c) + SLACK_M
    return [a, b, c], low, high


def _linear_functions(projected: list[Values], origin: Values) -> Values:
    """Compute the linear functions (`Casters`) of projected triangles, relative to origins; NaN if they are edge-on."""
    (u, v, s), (u2, v2, s2), (u3, v3, s3) = (
        projected[0] - origin,
        projected[1] - projected[0],
        projected[2] - projected[0],
    )
    double_area = u2 * v3 - u3 * v2
    inverse = dr.select(dr.abs(double_area) < MIN_DOUBLE_AREA_M2, dr.nan, 1.0 / double_area)
    second_u, second_v, third_u, third_v = (slope * inverse for slope in (v3, -u3, -v2, u2))
    plane_u, plane_v = second_u * s2 + third_u * s3, second_v * s2 + third_v * s3
    functions, number = dr.empty(Float, 12 * len(u)), 3 * dr.arange(UInt32, len(u))
    slopes = ((0.0, second_u, second_v), (0.0, third_u, third_v), (s, plane_u, plane_v))
    for k, (value, slope_u, slope_v) in enumerate(slopes):
        at_origin = value - slope_u * u - slope_v * v
        dr.scatter(functions, Array4f(at_origin, slope_u, slope_v, 0.0), number + k)
    return functions


def _enclose(bounds: Bounds, first: Int64[np.ndarray, "groups"]) -> FloatArray[np.ndarray, "groups 6"]:
    """Compute the bounds of groups of successive items, which begin at `first`; no group may be empty."""
    low, high = np.minimum.reduceat(bounds[:, :3], first), np.maximum.reduceat(bounds[:, 3:], first)
    return np.concatenate([low, high], axis=1)


def _choose_sides(items: np.ndarray) -> Int64[np.ndarray, "grids"]:
    """Choose the number of cells along a side for about one item per cell."""
    return np.asarray(np.clip(np.ceil(np.sqrt(items)), 1, MAX_CELLS).astype(np.int64))


def list_in_grids(
    low: Values,
    high: Values,
    grid: Values,
    enclosing: FloatArray[np.ndarray, "grids 6"],
    sides: Int64[np.ndarray, "grids"],
    numbers: Values,
) -> Grids:
    """List numbered items in the cells of grids over `enclosing` bounds.

    `low` and `high` are the minimum and maximum u, v of the items, and `grid` the grid of each item.
    """
    corner, extent = enclosing[:, :2], enclosing[:, 3:5] - enclosing[:, :2]
    first_cell = np.cumsum([0, *sides**2])
    cells = int(first_cell[-1])
    grids = Grids(
        to_device(Float64, corner),
        to_device(Float, sides[:, None] / extent),
        to_device(Int32, sides),
        to_device(UInt32, first_cell[:-1]),
        dr.zeros(UInt32, cells + 1),
        UInt32(0),
    )
    side, first = dr.gather(Int32, grids.side, grid), dr.gather(UInt32, grids.first_cell, grid)
    origin, per_metre = dr.gather(Array2f64, grids.low, grid), dr.gather(Array2f, grids.cells_per_metre, grid)
    first_column, first_row, last_column, last_row = (
        dr.maximum(dr.minimum(Int32(dr.floor(position)), side - 1), 0)
        for bound, margin in ((low, -CELL_MARGIN), (high, CELL_MARGIN))
        for position in (bound - origin) * per_metre + margin
    )
    columns = last_column - first_column + 1
    count = to_host(columns * (last_row - first_row + 1))
    # an entry for each cell of each item: a loop over the cells of an item would wait for the largest item
    item = to_device(UInt32, np.repeat(np.arange(count.size), count))
    entry = dr.arange(Int32, int(count.sum())) - dr.gather(Int32, to_device(Int32, np.cumsum(count) - count), item)
    width, left, top = (dr.gather(Int32, values, item) for values in (columns, first_column, first_row))
    # lanes beyond the last entry have no width, by which they must not divide
    row = entry // dr.maximum(width, 1)
    cell = dr.gather(UInt32, first, item) + UInt32(
        (top + row) * dr.gather(Int32, side, item) + left + entry - row * width
    )
    dr.scatter_add(grids.starts, UInt32(1), cell)
    starts = dr.prefix_sum(grids.starts)
    items, listed = dr.zeros(UInt32, int(count.sum())), dr.zeros(UInt32, cells + 1)
    position = dr.gather(UInt32, starts, cell) + dr.scatter_inc(listed, cell)
    dr.scatter(items, dr.gather(UInt32, numbers, item), position)
    dr.eval(items)
    return replace(grids, starts=starts, items=items)


def casters_towards(objects: Objects, sun: Sun) -> Casters | None:
    """List the triangles that can cast shadows, in grids perpendicular to the sun's direction; None without any."""
    if len(objects) == 0:
        return None
    direction = np.asarray(sun.direction, dtype=np.float64)
    first_axis = np.cross(direction, np.eye(3)[int(np.argmin(np.abs(direction)))])
    first_axis /= np.linalg.norm(first_axis)
    # rays are exactly parallel to the third axis
    axes = np.stack([first_axis, np.cross(direction, first_axis), direction])
    matrix, counts = Matrix3f64(*axes.ravel().tolist()), np.diff(objects.first_triangle)
    # products with zeros would change the zeros of a matrix of constants
    dr.make_opaque(matrix)
    projected, low, high = _project(objects.corners, matrix)
    dr.eval(projected, low, high)
    body_bounds = _enclose(np.concatenate([to_host(low), to_host(high)], axis=1), objects.first_triangle[:-1])
    body = to_device(UInt32, np.repeat(np.arange(len(counts)), counts))
    triangle_sides = _choose_sides(counts / TRIANGLES_PER_CELL)
    bodies = list_in_grids(low.xy, high.xy, body, body_bounds, triangle_sides, dr.arange(UInt32, len(body)))
    origins = vectors_to_device(Array3f64, body_bounds[:, [0, 1, 5]])
    functions = _linear_functions(projected, dr.gather(Array3f64, origins, body))
    all_bodies, coarse_side = _enclose(body_bounds, np.zeros(1, dtype=np.int64)), _choose_sides(np.array([len(counts)]))
    body_low, body_high = (vectors_to_device(Array2f64, body_bounds[:, k : k + 2]) for k in (0, 3))
    coarse = list_in_grids(body_low, body_high, UInt32(0), all_bodies, coarse_side, dr.arange(UInt32, len(counts)))
    fine = _list_in_fine_grids(body_bounds, all_bodies[0], int(coarse_side[0]), coarse)
    return Casters(matrix, functions, coarse, fine, bodies, to_device(Float64, body_bounds[:, 5]))


def _list_in_fine_grids(body_bounds: Bounds, all_bodies: np.ndarray, coarse_side: int, coarse: Grids) -> Grids:
    """List the bodies of each coarse cell in a grid over them; bodies are clipped to the coarse cell with a margin."""
    starts, bodies = to_host(coarse.starts).astype(np.int64), to_host(coarse.items)
    counts = np.diff(starts)
    cell, used = np.repeat(np.arange(len(counts)), counts), np.flatnonzero(counts)
    low, extent = all_bodies[:2], (all_bodies[3:5] - all_bodies[:2]) / coarse_side
    cell_low = low + extent * np.stack([cell % coarse_side, cell // coarse_side], axis=1)
    # twice the margin of the coarse grid, so that each listed body has an extent in its cell, also after rounding
    margin, clipped = 2.0 * CELL_MARGIN * extent + SLACK_M, body_bounds[bodies]
    clipped[:, :2] = np.maximum(clipped[:, :2], cell_low - margin)
    clipped[:, 3:5] = np.minimum(clipped[:, 3:5], cell_low + extent + margin)
    enclosing = np.zeros((len(counts), 6))
    enclosing[:, 3:] = 1.0
    enclosing[used] = _enclose(clipped, starts[:-1][used])
    areas = np.bincount(cell, np.prod(clipped[:, 3:5] - clipped[:, :2], axis=1), len(counts))
    # cells smaller than the bodies would list each body many times
    area = np.prod(enclosing[:, 3:5] - enclosing[:, :2], axis=1)
    sides = _choose_sides(np.minimum(counts / BODIES_PER_CELL, area * counts / np.maximum(areas, 1e-300)))
    item_low, item_high = (vectors_to_device(Array2f64, clipped[:, k : k + 2]) for k in (0, 3))
    return list_in_grids(item_low, item_high, to_device(UInt32, cell), enclosing, sides, to_device(UInt32, bodies))


def are_occluded(casters: Casters, position: Values, active: Values) -> Values:
    """Return whether a triangle occludes the sun at each position."""
    u, v, s = casters.axes @ position
    # the coarse grid lists bodies; its cell is the number of the fine grid
    coarse, fine, bodies = casters.coarse, casters.fine, casters.bodies
    cell, in_grid = coarse.find_cell(UInt32(0), *coarse.locate(UInt32(0), u, v, active), active)
    first, end = fine.list_range(cell, *fine.locate(cell, u, v, in_grid), in_grid)

    def test_body(entry: Values, is_hidden: Values, is_active: Values) -> tuple[Values, Values, Values]:
        body = dr.gather(UInt32, fine.items, entry, is_active)
        s_above_top = Float(s - dr.gather(Float64, casters.body_top, body, is_active))
        is_below = is_active & (s_above_top <= 0.0)
        local_u, local_v = bodies.locate(body, u, v, is_below)
        start, stop = bodies.list_range(body, local_u, local_v, is_below)

        def test_triangle(member: Values, is_hidden: Values, is_tested: Values) -> tuple[Values, Values, Values]:
            first_function = 3 * dr.gather(UInt32, bodies.items, member, is_tested)
            second, third, plane_s = (
                function.x + function.y * local_u + function.z * local_v
                for function in (dr.gather(Array4f, casters.functions, first_function + k, is_tested) for k in range(3))
            )
            is_hidden |= is_tested & is_inside(second, third, 0.0) & (plane_s > s_above_top)
            return member + 1, is_hidden, is_tested & ~is_hidden & (member + 1 < stop)

        _, is_hidden, _ = dr.while_loop(
            (UInt32(start), is_hidden, is_below & (start < stop)),
            lambda member, is_hidden, is_tested: is_tested,
            test_triangle,
        )
        return entry + 1, is_hidden, is_active & ~is_hidden & (entry + 1 < end)

    state = (UInt32(first), Bool(False), in_grid & (first < end))
    return dr.while_loop(state, lambda entry, is_hidden, is_active: is_active, test_body)[1]
