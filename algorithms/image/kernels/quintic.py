"""Compiled evaluation of quintic splines from their coefficients, for `marsyard.algorithms.image.registration`."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True, inline="always")
def _spline_to_1(x: float) -> float:
    """Quintic B-spline at a distance x from its centre, 0 <= x <= 1."""
    square = x * x
    return 0.55 + square * (-0.5 + square * (0.25 - x / 12.0))


@njit(cache=True, inline="always")
def _spline_1_to_2(x: float) -> float:
    """Quintic B-spline for 1 <= x <= 2."""
    return 0.425 + x * (0.625 + x * (-1.75 + x * (1.25 + x * (-0.375 + x / 24.0))))


@njit(cache=True, inline="always")
def _spline_2_to_3(x: float) -> float:
    """Quintic B-spline for 2 <= x <= 3."""
    distance = 3.0 - x
    square = distance * distance
    return square * square * distance / 120.0


@njit(cache=True, inline="always")
def _all_weights(fraction: float) -> tuple[float, float, float, float, float, float]:
    """Weights of the coefficients at -2 .. 3 pixels from a pixel, for a point `fraction` pixels after that pixel."""
    return (
        _spline_2_to_3(fraction + 2.0),
        _spline_1_to_2(fraction + 1.0),
        _spline_to_1(fraction),
        _spline_to_1(1.0 - fraction),
        _spline_1_to_2(2.0 - fraction),
        _spline_2_to_3(3.0 - fraction),
    )


@njit(cache=True)
def quintic_weights(fraction: float, weights: Array) -> None:
    """Store the six weights of `_all_weights`."""
    weights[0], weights[1], weights[2], weights[3], weights[4], weights[5] = _all_weights(fraction)


@njit(cache=True, error_model="numpy")
def _compute_weights(fractions: Array, weights: Array) -> None:
    """`quintic_weights` of many points, one column per point; without branches, for vector instructions."""
    for k in range(fractions.size):
        first, second, third, fourth, fifth, sixth = _all_weights(fractions[k])
        weights[0, k], weights[1, k], weights[2, k] = first, second, third
        weights[3, k], weights[4, k], weights[5, k] = fourth, fifth, sixth


@njit(cache=True)
def sample(coefficients: Array, side: int, row: float, column: float, warp: Array, values: Array) -> bool:
    """Evaluate the spline at ``(row, column) + warp @ (y, x, y y, y x, x x)``; return False if a point is outside.

    (y, x) are the offsets of the pixels of a square of `side` pixels from its centre.
    """
    half = 0.5 * (side - 1)
    last_row, last_column = coefficients.shape[0] - 4, coefficients.shape[1] - 4
    rows, columns = np.empty(side * side, dtype=np.int64), np.empty(side * side, dtype=np.int64)
    row_fractions, column_fractions = np.empty(side * side), np.empty(side * side)
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
            row_fractions[k], column_fractions[k] = v - rows[k], u - columns[k]
    row_weights, column_weights = np.empty((6, side * side)), np.empty((6, side * side))
    _compute_weights(row_fractions, row_weights)
    _compute_weights(column_fractions, column_weights)
    for k in range(side * side):
        r, c = rows[k], columns[k]
        total = 0.0
        for a in range(6):
            coefficient_row = coefficients[r + a - 2]
            row_sum = 0.0
            for b in range(6):
                row_sum += column_weights[b, k] * coefficient_row[c + b - 2]
            total += row_weights[a, k] * row_sum
        values[k] = total
    return True


@njit(cache=True)
def sample_shifted(coefficients: Array, side: int, row: float, column: float, values: Array) -> bool:
    """Evaluate `sample` for a pure shift: all pixels have the same weights, and rows and columns are separable."""
    half = 0.5 * (side - 1)
    v, u = row - half, column - half
    if not (v >= 2.0 and u >= 2.0 and v + side <= coefficients.shape[0] - 3):
        return False
    if not u + side <= coefficients.shape[1] - 3:
        return False
    r, c = int(v), int(u)
    row_weights, column_weights = np.empty(6), np.empty(6)
    quintic_weights(v - r, row_weights)
    quintic_weights(u - c, column_weights)
    interpolated_rows = np.empty((side + 5, side))
    for i in range(side + 5):
        coefficient_row = coefficients[r + i - 2]
        interpolated_row = interpolated_rows[i]
        for j in range(side):
            total = 0.0
            for b in range(6):
                total += column_weights[b] * coefficient_row[c + j + b - 2]
            interpolated_row[j] = total
    for i in range(side):
        for j in range(side):
            total = 0.0
            for a in range(6):
                total += row_weights[a] * interpolated_rows[i + a, j]
            values[i * side + j] = total
    return True
