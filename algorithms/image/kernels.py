"""Compiled normalised cross-correlation; `algorithms.image.normalized` says what it is and checks what it is given.

Images are float32, so that a vector register holds eight values; sums that are subtracted from each other are float64.
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
def centred(image: Image) -> Image:
    """The image less its mean."""
    total = 0.0
    for i in range(image.shape[0]):
        row = image[i]
        for j in range(image.shape[1]):
            total += row[j]
    mean = total / image.size
    result = np.empty_like(image)
    for i in range(image.shape[0]):
        row = image[i]
        out = result[i]
        for j in range(image.shape[1]):
            out[j] = row[j] - mean
    return result


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
def best_near(
    template: Image, window: Image, places: NDArray[np.int64], reach: int, floor: float
) -> tuple[NDArray[np.int64], Array]:
    """For each place (row, column) the best one within `reach` rows and columns of it, and Eq. 11 there.

    Places outside the window are moved to its border. Both images are given less their means.
    """
    n, m = template.shape
    last_row, last_column = window.shape[0] - n, window.shape[1] - m
    energy_a = energy(template)
    count = n * m
    best = np.empty_like(places)
    values = np.empty(places.shape[0])
    for k in range(places.shape[0]):
        row = min(max(places[k, 0], 0), last_row)
        column = min(max(places[k, 1], 0), last_column)
        values[k] = -2.0
        for i in range(max(row - reach, 0), min(row + reach, last_row) + 1):
            for j in range(max(column - reach, 0), min(column + reach, last_column) + 1):
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
