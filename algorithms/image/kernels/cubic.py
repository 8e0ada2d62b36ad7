"""Compiled evaluation of cubic splines from their coefficients, equal to SciPy's `map_coordinates`; used by DIMES."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True)
def sample(coefficients: Array, pixels: Array, row: int, column: int, values: Array) -> None:
    """Store the spline at `pixels` (u, v), shape (n, m, 2), in `values`; the first coefficient is at (row, column).

    All pixels must lie within the centres of the outermost coefficients; the spline is mirrored at these centres.
    """
    rows, columns = coefficients.shape
    weights_v, weights_u = np.empty(4), np.empty(4)
    for i in range(pixels.shape[0]):
        for j in range(pixels.shape[1]):
            y, x = pixels[i, j, 1] - row, pixels[i, j, 0] - column
            r, c = int(y) - 1, int(x) - 1
            _compute_weights(y - math.floor(y), weights_v)
            _compute_weights(x - math.floor(x), weights_u)
            is_inside = r >= 0 and c >= 0 and r + 3 < rows and c + 3 < columns
            total = 0.0
            for a in range(4):
                coefficient_row = coefficients[r + a if is_inside else _mirror_index(r + a, rows)]
                for b in range(4):
                    k = c + b if is_inside else _mirror_index(c + b, columns)
                    total += coefficient_row[k] * weights_v[a] * weights_u[b]
            values[i, j] = total


@njit(cache=True)
def _compute_weights(fraction: float, weights: Array) -> None:
    """Store the cubic B-spline weights of four coefficients; the point is `fraction` pixels after the second one."""
    complement = 1.0 - fraction
    weights[0] = complement * complement * complement / 6.0
    weights[1] = (fraction * fraction * (fraction - 2.0) * 3.0 + 4.0) / 6.0
    weights[2] = (complement * complement * (complement - 2.0) * 3.0 + 4.0) / 6.0
    weights[3] = 1.0 - weights[0] - weights[1] - weights[2]


@njit(cache=True)
def _mirror_index(index: int, size: int) -> int:
    """Mirror an index outside 0 .. size - 1 into that range."""
    if size == 1:
        return 0
    index = abs(index) % (2 * size - 2)
    return min(index, 2 * size - 2 - index)


@njit(cache=True)
def clamp(pixels: Array, visible: NDArray[np.bool_], columns: int, rows: int) -> tuple[float, float, float, float]:
    """Clamp pixels (u, v), shape (n, m, 2), to the image in place; invisible pixels become its upper left pixel.

    Returns the bounding box of the clamped pixels (left, right, top, bottom).
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
