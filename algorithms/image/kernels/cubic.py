"""Compiled sampling of cubic splines at any places, from their coefficients, as SciPy's `map_coordinates` does it."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True)
def sample(coefficients: Array, pixels: Array, row: int, column: int, values: Array) -> None:
    """Values of the spline at `pixels` (u, v), shape (n, m, 2), of which `coefficients` begin at (row, column).

    All must lie in what the coefficients cover, the middles of its outermost pixels included; beyond those it mirrors.
    """
    rows, columns = coefficients.shape
    down, across = np.empty(4), np.empty(4)
    for i in range(pixels.shape[0]):
        for j in range(pixels.shape[1]):
            y, x = pixels[i, j, 1] - row, pixels[i, j, 0] - column
            r, c = int(y) - 1, int(x) - 1
            _weights(y - math.floor(y), down)
            _weights(x - math.floor(x), across)
            inside = r >= 0 and c >= 0 and r + 3 < rows and c + 3 < columns
            total = 0.0
            for a in range(4):
                line = coefficients[r + a if inside else _mirror_index(r + a, rows)]
                for b in range(4):
                    total += line[c + b if inside else _mirror_index(c + b, columns)] * down[a] * across[b]
            values[i, j] = total


@njit(cache=True)
def _weights(fraction: float, weights: Array) -> None:
    """The cubic B-spline's four values about a point `fraction` beyond its pixel; their sum is 1."""
    rest = 1.0 - fraction
    weights[0] = rest * rest * rest / 6.0
    weights[1] = (fraction * fraction * (fraction - 2.0) * 3.0 + 4.0) / 6.0
    weights[2] = (rest * rest * (rest - 2.0) * 3.0 + 4.0) / 6.0
    weights[3] = 1.0 - weights[0] - weights[1] - weights[2]


@njit(cache=True)
def _mirror_index(index: int, size: int) -> int:
    """The index within 0 .. size - 1 that one beyond stands for."""
    if size == 1:
        return 0
    index = abs(index) % (2 * size - 2)
    return min(index, 2 * size - 2 - index)


@njit(cache=True)
def hold(pixels: Array, visible: NDArray[np.bool_], columns: int, rows: int) -> tuple[float, float, float, float]:
    """Brings pixels (u, v), shape (n, m, 2), into the picture, those not visible to its upper left corner.

    Returns the least and largest u and v then.
    """
    left, right = math.inf, -math.inf
    top, bottom = math.inf, -math.inf
    for i in range(pixels.shape[0]):
        for j in range(pixels.shape[1]):
            u = min(max(pixels[i, j, 0], 0.0), columns - 1.0) if visible[i, j] else 0.0
            v = min(max(pixels[i, j, 1], 0.0), rows - 1.0) if visible[i, j] else 0.0
            pixels[i, j, 0], pixels[i, j, 1] = u, v
            left, right = min(left, u), max(right, u)
            top, bottom = min(top, v), max(bottom, v)
    return left, right, top, bottom
