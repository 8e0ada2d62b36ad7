"""Compiled rasterisation of rocks to a grid of maximum heights."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True)
def _edge_length(start: Array, end: Array) -> float:
    return math.sqrt((start[0] - end[0]) ** 2 + (start[1] - end[1]) ** 2 + (start[2] - end[2]) ** 2)


@njit(cache=True)
def rasterize_heights(
    triangles: Array, corner_x: float, corner_y: float, cell: float, max_spacing: float, top: Array
) -> None:
    """Update `top`, the maximum height of the triangles in each cell (world, metres), shape (rows, columns).

    Points of each triangle are sampled on a regular grid of barycentric weights. Points outside the grid are ignored.

    - triangles: corners in world axes, metres, shape (n, 3, 3)
    - corner_x, corner_y, cell: centre of cell (0, 0), and side of a cell, metres; column j is at corner_x + cell * j
    - max_spacing: maximum distance between sample points, metres
    """
    rows, columns = top.shape
    for n in range(triangles.shape[0]):
        a, b, c = triangles[n, 0], triangles[n, 1], triangles[n, 2]
        longest = max(_edge_length(a, b), _edge_length(b, c), _edge_length(c, a))
        steps = max(math.ceil(longest / max_spacing), 1)
        for j in range(steps + 1):
            for i in range(steps + 1 - j):
                weight_b, weight_c = i / steps, j / steps
                weight_a = 1.0 - weight_b - weight_c
                column = round((weight_a * a[0] + weight_b * b[0] + weight_c * c[0] - corner_x) / cell)
                row = round((weight_a * a[1] + weight_b * b[1] + weight_c * c[1] - corner_y) / cell)
                if 0 <= row < rows and 0 <= column < columns:
                    height = weight_a * a[2] + weight_b * b[2] + weight_c * c[2]
                    top[row, column] = max(top[row, column], height)
