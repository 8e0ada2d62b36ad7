"""Compiled correlation; `marsyard.algorithms.image.correlation` and `.correlation` say what it is and check what they
are given.

Images of the normalised one are float32, so that a vector register holds eight values; sums that are subtracted from
each other are float64.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Image = NDArray[np.float32]
Array = NDArray[np.float64]

#: Energy of a patch, relative to that of its largest value, below which it is rounding and counts as flat.
FLAT_ENERGY = 1e-12


@njit(cache=True)
def subtract_mean(image: Image) -> tuple[Image, float]:
    """The image less its mean; and its largest absolute value before."""
    total, largest = 0.0, 0.0
    for i in range(image.shape[0]):
        row = image[i]
        for j in range(image.shape[1]):
            total += row[j]
            largest = max(largest, abs(row[j]))
    mean = total / image.size
    result = np.empty_like(image)
    for i in range(image.shape[0]):
        row = image[i]
        out = result[i]
        for j in range(image.shape[1]):
            out[j] = row[j] - mean
    return result, largest


@njit(cache=True)
def energy(image: Image) -> float:
    """Sum of squares."""
    total = 0.0
    for i in range(image.shape[0]):
        row = image[i]
        for j in range(image.shape[1]):
            value = np.float64(row[j])
            total += value * value
    return total


@njit(cache=True)
def ratio(cross: float, energy_a: float, energy_b: float, floor: float) -> float:
    """Eq. 11 from its three sums; 0 where either patch is flat."""
    if energy_a <= floor or energy_b <= floor:
        return 0.0
    return min(max(cross / math.sqrt(energy_a * energy_b), -1.0), 1.0)


@njit(cache=True)
def surface(template: Image, window: Image, floor: float) -> Array:
    """Eq. 11 at every place where the template fits; both are given less their means.

    The products run along rows of the result, so that every pass is one multiplication of a row by a number.
    """
    n, m = template.shape
    rows, columns = window.shape[0] - n + 1, window.shape[1] - m + 1
    energy_a = energy(template)
    count = n * m
    sums = np.zeros(window.shape[1])
    squares = np.zeros(window.shape[1])
    cross = np.empty(columns, dtype=np.float32)
    result = np.empty((rows, columns))
    for i in range(n - 1):
        _add_row(sums, squares, window[i], 1.0)
    for i in range(rows):
        _add_row(sums, squares, window[i + n - 1], 1.0)
        cross[:] = 0.0
        for r in range(n):
            for c in range(m):
                factor = template[r, c]
                part = window[i + r, c : c + columns]
                for j in range(columns):
                    cross[j] += factor * part[j]
        total, total_squares = 0.0, 0.0
        for c in range(m - 1):
            total += sums[c]
            total_squares += squares[c]
        for j in range(columns):
            total += sums[j + m - 1]
            total_squares += squares[j + m - 1]
            result[i, j] = ratio(cross[j], energy_a, total_squares - total * total / count, floor)
            total -= sums[j]
            total_squares -= squares[j]
        _add_row(sums, squares, window[i], -1.0)
    return result


@njit(cache=True)
def _add_row(sums: Array, squares: Array, row: Image, sign: float) -> None:
    for j in range(row.size):
        value = np.float64(row[j])
        sums[j] += sign * value
        squares[j] += sign * value * value


@njit(cache=True)
def search_near(
    template: Image, window: Image, positions: NDArray[np.int64], radius: int, floor: float
) -> tuple[NDArray[np.int64], Array]:
    """For each position (row, column) the best one within `radius` rows and columns of it, and Eq. 11 there.

    Positions outside the window are moved to its border. The template is given less its mean, the window as it is: all
    sums are float64 here.
    """
    n, m = template.shape
    last_row, last_column = window.shape[0] - n, window.shape[1] - m
    energy_a = energy(template)
    count = n * m
    best = np.empty_like(positions)
    values = np.empty(positions.shape[0])
    for k in range(positions.shape[0]):
        row = min(max(positions[k, 0], 0), last_row)
        column = min(max(positions[k, 1], 0), last_column)
        values[k] = -2.0
        for i in range(max(row - radius, 0), min(row + radius, last_row) + 1):
            for j in range(max(column - radius, 0), min(column + radius, last_column) + 1):
                cross, total, squares = 0.0, 0.0, 0.0
                for r in range(n):
                    ours = template[r]
                    theirs = window[i + r, j : j + m]
                    for c in range(m):
                        value = np.float64(theirs[c])
                        cross += ours[c] * value
                        total += value
                        squares += value * value
                score = ratio(cross, energy_a, squares - total * total / count, floor)
                if score > values[k]:
                    values[k] = score
                    best[k, 0], best[k, 1] = i, j
    return best, values


@njit(cache=True)
def pseudo_normalized(cross: Array, window: Array, side: tuple[int, int], energy_a: float, floor: float) -> Array:
    """``2 cross / (energy_a + energy of the window's patch)`` at every place where a patch of `side` fits.

    0 where the two energies together are at most `floor`; held to [-1, 1].
    """
    n, m = side
    sums, squares = _integrals(window)
    result = np.empty((window.shape[0] - n + 1, window.shape[1] - m + 1))
    for i in range(result.shape[0]):
        for j in range(result.shape[1]):
            total = sums[i + n, j + m] - sums[i, j + m] - sums[i + n, j] + sums[i, j]
            total_squares = squares[i + n, j + m] - squares[i, j + m] - squares[i + n, j] + squares[i, j]
            both = energy_a + max(total_squares - total * total / (n * m), 0.0)
            result[i, j] = min(max(2.0 * cross[i, j] / both, -1.0), 1.0) if both > floor else 0.0
    return result


@njit(cache=True)
def _integrals(image: Array) -> tuple[Array, Array]:
    """Sums of the image and of its squares over all rows above and columns before, shapes (rows + 1, columns + 1)."""
    rows, columns = image.shape
    sums, squares = np.zeros((rows + 1, columns + 1)), np.zeros((rows + 1, columns + 1))
    down, down_squares = np.zeros(columns), np.zeros(columns)
    for i in range(rows):
        along, along_squares = 0.0, 0.0
        for j in range(columns):
            down[j] += image[i, j]
            down_squares[j] += image[i, j] * image[i, j]
            along += down[j]
            along_squares += down_squares[j]
            sums[i + 1, j + 1], squares[i + 1, j + 1] = along, along_squares
    return sums, squares
