"""Kernel that rasterizes rocks to a grid of maximum heights."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True)
def _edge_length(first: Array, second: Array) -> float:
    return math.sqrt((first[0] - second[0]) ** 2 + (first[1] - second[1]) ** 2 + (first[2] - second[2]) ** 2)


@njit(cache=True)
def rasterize_heights(
    triangles: Array, corner_x: float, corner_y: float, cell: float, max_spacing: float, top: Array
) -> None:
    """Raise `top` (height of each cell, world, metres) to the highest point of the triangles in each cell.

    Points are sampled on each triangle along both of its sides, at most `max_spacing` apart. The centre of cell
    (row, column) is at corner + cell * (column, row). Points outside the grid are ignored.
    """
    rows, columns = top.shape
    for n in range(triangles.shape[0]):
        a, b, c = triangles[n, 0], triangles[n, 1], triangles[n, 2]
        longest = max(_edge_length(a, b), _edge_length(b, c), _edge_length(c, a))
        steps = max(math.ceil(longest / max_spacing), 1)
        for j in range(steps + 1):
            for i in range(steps + 1 - j):
                second, third = i / steps, j / steps
                first = 1.0 - second - third
                column = round((first * a[0] + second * b[0] + third * c[0] - corner_x) / cell)
                row = round((first * a[1] + second * b[1] + third * c[1] - corner_y) / cell)
                if 0 <= row < rows and 0 <= column < columns:
                    height = first * a[2] + second * b[2] + third * c[2]
                    top[row, column] = max(top[row, column], height)
