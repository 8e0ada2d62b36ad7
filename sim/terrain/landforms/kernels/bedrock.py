"""Compiled shapes of bedrock: cracks, polygonal slabs and exposed strata."""

import math

import numpy as np
from numba import njit

from marsyard.sim.terrain.kernels import Array
from marsyard.sim.terrain.landforms.kernels.shapes import Grid


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
    count = points.shape[0]
    # positions of the points, with a margin of one square for the periodic border
    positions = np.empty((count + 2, count + 2, 2))
    for row in range(-1, count + 1):
        for column in range(-1, count + 1):
            x, y = points[row % count, column % count]
            positions[row + 1, column + 1, 0], positions[row + 1, column + 1, 1] = column + x, row + y
    for i in range(height.shape[0]):
        y = i * spacing / cell
        row = int(y)
        for j in range(height.shape[0]):
            x = j * spacing / cell
            column = int(x)
            nearest2, nearest_x, nearest_y = 1e9, 0.0, 0.0
            second2, second_x, second_y = 1e9, 0.0, 0.0
            for di in range(3):
                for dj in range(3):
                    dx = positions[row + di, column + dj, 0] - x
                    dy = positions[row + di, column + dj, 1] - y
                    distance2 = dx * dx + dy * dy
                    if distance2 < nearest2:
                        second2, second_x, second_y = nearest2, nearest_x, nearest_y
                        nearest2, nearest_x, nearest_y = distance2, dx, dy
                    elif distance2 < second2:
                        second2, second_x, second_y = distance2, dx, dy
            separation = math.sqrt((second_x - nearest_x) ** 2 + (second_y - nearest_y) ** 2)
            border = 0.5 * (second2 - nearest2) / max(separation, 1e-6) * cell
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
    - slabs: height at the point, slopes along x and y, and logarithm of albedo of each cell, shape (count, count, 4)
    - cell: side of a square, metres
    - joint: distance from the border over which a slab rises from the ground, metres
    """
    count = points.shape[0]
    for i in range(height.shape[0]):
        y = i * spacing / cell
        row = int(y)
        for j in range(height.shape[0]):
            x = j * spacing / cell
            column = int(x)
            nearest2, nearest_x, nearest_y, nearest_row, nearest_column = 1e9, 0.0, 0.0, 0, 0
            second2, second_x, second_y = 1e9, 0.0, 0.0
            for di in range(-1, 2):
                for dj in range(-1, 2):
                    n, m = (row + di) % count, (column + dj) % count
                    dx, dy = column + dj + points[n, m, 0] - x, row + di + points[n, m, 1] - y
                    distance2 = dx * dx + dy * dy
                    if distance2 < nearest2:
                        second2, second_x, second_y = nearest2, nearest_x, nearest_y
                        nearest2, nearest_x, nearest_y, nearest_row, nearest_column = distance2, dx, dy, n, m
                    elif distance2 < second2:
                        second2, second_x, second_y = distance2, dx, dy
            slab_height, slope_x, slope_y, contrast = slabs[nearest_row, nearest_column]
            if slab_height > 0.0:
                separation = math.sqrt((second_x - nearest_x) ** 2 + (second_y - nearest_y) ** 2)
                border = 0.5 * (second2 - nearest2) / max(separation, 1e-6) * cell
                t = min(border / joint, 1.0)
                rise = t * t * (3.0 - 2.0 * t)
                top = slab_height - cell * (slope_x * nearest_x + slope_y * nearest_y)
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
