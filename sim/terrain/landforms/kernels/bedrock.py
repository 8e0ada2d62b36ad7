"""Compiled shapes of bedrock: cracks, polygonal slabs and exposed strata."""

import math

import numpy as np
from numba import njit

from marsyard.sim.terrain.kernels import Array
from marsyard.sim.terrain.landforms.kernels.shapes import Grid


@njit(cache=True)
def _locate_points(points: Array) -> Array:
    """Positions of the points of a periodic grid in units of its squares, with a margin of one square.

    `points` contains the position of each point within its square, from 0 to 1, shape (count, count, 2).
    """
    count = points.shape[0]
    positions = np.empty((count + 2, count + 2, 2))
    for row in range(-1, count + 1):
        for column in range(-1, count + 1):
            x, y = points[row % count, column % count]
            positions[row + 1, column + 1, 0], positions[row + 1, column + 1, 1] = column + x, row + y
    return positions


@njit(cache=True)
def _find_cell(positions: Array, x: float, y: float) -> tuple[int, int, float, float, float]:
    """Find the Voronoi cell at x, y: row and column of its point in `positions`, offset of the point, and border.

    `positions` are those of `_locate_points`. Lengths are in units of its squares. The border is the distance to it.
    """
    row, column = int(y), int(x)
    nearest2, nearest_x, nearest_y, nearest_row, nearest_column = 1e9, 0.0, 0.0, 0, 0
    second2, second_x, second_y = 1e9, 0.0, 0.0
    for n in range(row, row + 3):
        for m in range(column, column + 3):
            dx, dy = positions[n, m, 0] - x, positions[n, m, 1] - y
            distance2 = dx * dx + dy * dy
            if distance2 < nearest2:
                second2, second_x, second_y = nearest2, nearest_x, nearest_y
                nearest2, nearest_x, nearest_y, nearest_row, nearest_column = distance2, dx, dy, n, m
            elif distance2 < second2:
                second2, second_x, second_y = distance2, dx, dy
    separation = math.sqrt((second_x - nearest_x) ** 2 + (second_y - nearest_y) ** 2)
    border = 0.5 * (second2 - nearest2) / max(separation, 1e-6)
    return nearest_row, nearest_column, nearest_x, nearest_y, border


@njit(cache=True)
def add_cracks(
    height: Grid,
    log_albedo: Grid,
    spacing: float,
    points: Array,
    cell: float,
    width: float,
    depth: float,
    contrast: float,
) -> None:
    """Add polygonal cracks along the borders of Voronoi cells, with one point in each square of a periodic grid.

    - points: position of each point within its square, from 0 to 1, shape (count, count, 2)
    - cell: side of a square, metres
    - width, depth: half width over which a crack fades, and depth at its middle, metres
    - contrast: change of the logarithm of albedo at the middle of a crack
    """
    positions = _locate_points(points)
    for i in range(height.shape[0]):
        for j in range(height.shape[0]):
            border = _find_cell(positions, j * spacing / cell, i * spacing / cell)[4] * cell
            if border < width:
                strength = 1.0 - border / width
                height[i, j] -= depth * strength
                log_albedo[i, j] += contrast * strength


@njit(cache=True)
def add_slabs(
    height: Grid, log_albedo: Grid, spacing: float, points: Array, slabs: Array, cell: float, joint: float
) -> None:
    """Add tilted slabs: Voronoi cells with one point in each square of a periodic grid, rounded towards the joints.

    - points: position of each point within its square, from 0 to 1, shape (count, count, 2)
    - slabs: height at the point (0: no slab), slopes along x and y, and logarithm of albedo of each cell, shape
      (count, count, 4)
    - cell: side of a square, metres
    - joint: distance from the border over which a slab rises from the ground, metres
    """
    count = points.shape[0]
    positions = _locate_points(points)
    # a position belongs to the cell of a point in its square, or in a square next to it
    has_slabs = np.zeros((count, count), dtype=np.bool_)
    for row in range(count):
        for column in range(count):
            for di in range(-1, 2):
                for dj in range(-1, 2):
                    has_slabs[row, column] |= slabs[(row + di) % count, (column + dj) % count, 0] > 0.0
    for i in range(height.shape[0]):
        y = i * spacing / cell
        for j in range(height.shape[0]):
            x = j * spacing / cell
            if not has_slabs[int(y), int(x)]:
                continue
            row, column, offset_x, offset_y, border = _find_cell(positions, x, y)
            slab_height, slope_x, slope_y, contrast = slabs[(row - 1) % count, (column - 1) % count]
            if slab_height > 0.0:
                t = min(border * cell / joint, 1.0)
                rise = t * t * (3.0 - 2.0 * t)
                top = slab_height - cell * (slope_x * offset_x + slope_y * offset_y)
                height[i, j] += rise * max(top, 0.0)
                log_albedo[i, j] += rise * contrast


@njit(cache=True)
def expose_strata(height: Grid, log_albedo: Grid, lowest: float, step: float, strata: Array) -> None:
    """Replace heights, and add to the logarithm of albedo, by linear interpolation in a table.

    Row k of `strata` contains the new height and the change of the logarithm of albedo of ground at the height
    ``lowest + k step``; the table covers all heights.
    """
    last = strata.shape[0] - 2
    for i in range(height.shape[0]):
        for j in range(height.shape[1]):
            position = (height[i, j] - lowest) / step
            k = min(int(position), last)
            fraction = position - k
            height[i, j] = strata[k, 0] + fraction * (strata[k + 1, 0] - strata[k, 0])
            log_albedo[i, j] += strata[k, 1] + fraction * (strata[k + 1, 1] - strata[k, 1])
