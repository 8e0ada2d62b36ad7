"""Compiled sampling of quintic splines, from their coefficients."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True, inline="always")
def _inner(x: float) -> float:
    """The quintic B-spline up to 1 from its middle."""
    square = x * x
    return 0.55 + square * (-0.5 + square * (0.25 - x / 12.0))


@njit(cache=True, inline="always")
def _middle(x: float) -> float:
    """The same from 1 to 2."""
    return 0.425 + x * (0.625 + x * (-1.75 + x * (1.25 + x * (-0.375 + x / 24.0))))


@njit(cache=True, inline="always")
def _outer(x: float) -> float:
    """The same from 2 to 3."""
    rest = 3.0 - x
    square = rest * rest
    return square * square * rest / 120.0


@njit(cache=True, inline="always")
def _six(fraction: float) -> tuple[float, float, float, float, float, float]:
    """The quintic B-spline's values about a point `fraction` beyond its pixel, from two pixels before it on."""
    return (
        _outer(fraction + 2.0),
        _middle(fraction + 1.0),
        _inner(fraction),
        _inner(1.0 - fraction),
        _middle(2.0 - fraction),
        _outer(3.0 - fraction),
    )


@njit(cache=True)
def quintic_weights(fraction: float, weights: Array) -> None:
    """The six values of a point."""
    weights[0], weights[1], weights[2], weights[3], weights[4], weights[5] = _six(fraction)


@njit(cache=True, error_model="numpy")
def _weights_of_all(fractions: Array, weights: Array) -> None:
    """`quintic_weights` of many points, those of a point in a column; without branches, for vector instructions."""
    for k in range(fractions.size):
        first, second, third, fourth, fifth, sixth = _six(fractions[k])
        weights[0, k], weights[1, k], weights[2, k] = first, second, third
        weights[3, k], weights[4, k], weights[5, k] = fourth, fifth, sixth


@njit(cache=True)
def sample(coefficients: Array, side: int, row: float, column: float, warp: Array, values: Array) -> bool:
    """Values of the spline at ``middle + warp @ (y, x, yy, yx, xx)`` of a square's offsets; False if it leaves it."""
    half = 0.5 * (side - 1)
    last_row, last_column = coefficients.shape[0] - 4, coefficients.shape[1] - 4
    rows, columns = np.empty(side * side, dtype=np.int64), np.empty(side * side, dtype=np.int64)
    below, beyond = np.empty(side * side), np.empty(side * side)
    for i in range(side):
        for j in range(side):
            y, x = i - half, j - half
            yy, yx, xx = y * y, y * x, x * x
            v = row + warp[0, 0] * y + warp[0, 1] * x + warp[0, 2] * yy + warp[0, 3] * yx + warp[0, 4] * xx
            u = column + warp[1, 0] * y + warp[1, 1] * x + warp[1, 2] * yy + warp[1, 3] * yx + warp[1, 4] * xx
            if not (v >= 2.0 and u >= 2.0 and v <= last_row and u <= last_column):
                return False
            k = i * side + j
            rows[k], columns[k] = int(v), int(u)
            below[k], beyond[k] = v - rows[k], u - columns[k]
    down, across = np.empty((6, side * side)), np.empty((6, side * side))
    _weights_of_all(below, down)
    _weights_of_all(beyond, across)
    for k in range(side * side):
        r, c = rows[k], columns[k]
        total = 0.0
        for a in range(6):
            line = coefficients[r + a - 2]
            part = 0.0
            for b in range(6):
                part += across[b, k] * line[c + b - 2]
            total += down[a, k] * part
        values[k] = total
    return True


@njit(cache=True)
def sample_shifted(coefficients: Array, side: int, row: float, column: float, values: Array) -> bool:
    """`sample` of a shift alone: all pixels share the fraction of the shift, so that rows and columns separate."""
    half = 0.5 * (side - 1)
    v, u = row - half, column - half
    if not (v >= 2.0 and u >= 2.0 and v + side <= coefficients.shape[0] - 3):
        return False
    if not u + side <= coefficients.shape[1] - 3:
        return False
    r, c = int(v), int(u)
    down, across = np.empty(6), np.empty(6)
    quintic_weights(v - r, down)
    quintic_weights(u - c, across)
    lines = np.empty((side + 5, side))
    for i in range(side + 5):
        line = coefficients[r + i - 2]
        out = lines[i]
        for j in range(side):
            total = 0.0
            for b in range(6):
                total += across[b] * line[c + j + b - 2]
            out[j] = total
    for i in range(side):
        for j in range(side):
            total = 0.0
            for a in range(6):
                total += down[a] * lines[i + a, j]
            values[i * side + j] = total
    return True


@njit(cache=True)
def sample_with_derivatives(
    coefficients: Array, row: int, column: int, down: Array, across: Array, output: Array
) -> None:
    """A patch of the spline with its upper left pixel at (row, column) and a fraction, and its two derivatives.

    `down` and `across` are the six taps along rows and columns, first of values, then of slopes, shape (2, 6), from two
    pixels before it on. `output`, shape (3, rows, columns), gets values, derivatives by row and derivatives by column.
    """
    _, height, width = output.shape
    values, slopes = np.empty(width + 5), np.empty(width + 5)
    for i in range(height):
        for j in range(width + 5):
            value, slope = 0.0, 0.0
            for k in range(6):
                coefficient = coefficients[row + i + k - 2, column + j - 2]
                value += down[0, k] * coefficient
                slope += down[1, k] * coefficient
            values[j], slopes[j] = value, slope
        for j in range(width):
            value, by_row, by_column = 0.0, 0.0, 0.0
            for k in range(6):
                value += across[0, k] * values[j + k]
                by_row += across[0, k] * slopes[j + k]
                by_column += across[1, k] * values[j + k]
            output[0, i, j], output[1, i, j], output[2, i, j] = value, by_row, by_column
