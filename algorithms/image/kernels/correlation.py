"""Compiled kernels of `marsyard.algorithms.image.correlation`, which contains the definitions and checks the inputs.

Normalised correlation uses float32 images, so that a vector register contains eight values. Sums that are subtracted
from each other are float64. Eq. 11 is that of Kim et al., "Targeted Driving Using Visual Tracking".
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Image = NDArray[np.float32]
Array = NDArray[np.float64]

#: A patch with less energy is uniform except for rounding errors; fraction of (number of pixels) x (largest value)^2.
FLAT_ENERGY = 1e-12


@njit(cache=True)
def subtract_mean(image: Image) -> tuple[Image, float]:
    """Subtract the mean of an image; also return the image's largest absolute value."""
    total, max_abs = 0.0, 0.0
    for i in range(image.shape[0]):
        row = image[i]
        for j in range(image.shape[1]):
            total += row[j]
            max_abs = max(max_abs, abs(row[j]))
    mean = total / image.size
    result = np.empty_like(image)
    for i in range(image.shape[0]):
        row = image[i]
        result_row = result[i]
        for j in range(image.shape[1]):
            result_row[j] = row[j] - mean
    return result, max_abs


@njit(cache=True)
def energy(image: Image) -> float:
    """Energy of an image: sum of squares."""
    total = 0.0
    for i in range(image.shape[0]):
        row = image[i]
        for j in range(image.shape[1]):
            value = np.float64(row[j])
            total += value * value
    return total


@njit(cache=True)
def normalize(cross: float, energy_a: float, energy_b: float, floor: float) -> float:
    """Compute Eq. 11, ``cross / sqrt(energy_a energy_b)``; 0 if an energy is at most `floor`."""
    if energy_a <= floor or energy_b <= floor:
        return 0.0
    return min(max(cross / math.sqrt(energy_a * energy_b), -1.0), 1.0)


@njit(cache=True)
def correlation_surface(template: Image, window: Image, floor: float) -> Array:
    """Compute Eq. 11 at every position where the template fits; both arguments must have a mean of zero.

    The inner loop multiplies a row of the window by one number, for vector instructions.
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
                window_row = window[i + r, c : c + columns]
                for j in range(columns):
                    cross[j] += factor * window_row[j]
        total, total_squares = 0.0, 0.0
        for c in range(m - 1):
            total += sums[c]
            total_squares += squares[c]
        for j in range(columns):
            total += sums[j + m - 1]
            total_squares += squares[j + m - 1]
            result[i, j] = normalize(cross[j], energy_a, total_squares - total * total / count, floor)
            total -= sums[j]
            total_squares -= squares[j]
        _add_row(sums, squares, window[i], -1.0)
    return result


@njit(cache=True)
def _add_row(sums: Array, squares: Array, row: Image, sign: float) -> None:
    """Add a row to column sums and sums of squares (`sign` 1), or subtract it (-1)."""
    for j in range(row.size):
        value = np.float64(row[j])
        sums[j] += sign * value
        squares[j] += sign * value * value


@njit(cache=True)
def search_near(
    template: Image, window: Image, positions: NDArray[np.int64], radius: int, floor: float
) -> tuple[NDArray[np.int64], Array]:
    """Search the best position within `radius` rows and columns of each position (row, column).

    Returns the best positions and Eq. 11 at each. Positions outside the window are clamped to its border. The template
    must have a mean of zero. The mean of the window need not be subtracted, because all sums are float64.
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
                    template_row = template[r]
                    window_row = window[i + r, j : j + m]
                    for c in range(m):
                        value = np.float64(window_row[c])
                        cross += template_row[c] * value
                        total += value
                        squares += value * value
                score = normalize(cross, energy_a, squares - total * total / count, floor)
                if score > values[k]:
                    values[k] = score
                    best[k, 0], best[k, 1] = i, j
    return best, values


@njit(cache=True)
def pseudo_normalized(cross: Array, window: Array, shape: tuple[int, int], energy_a: float, floor: float) -> Array:
    """``2 cross / (energy_a + energy of the window's patch)`` at every position where a patch of `shape` fits.

    0 where the sum of both energies is at most `floor`; clipped to [-1, 1].
    """
    n, m = shape
    sums, squares = _integral_images(window)
    result = np.empty((window.shape[0] - n + 1, window.shape[1] - m + 1))
    for i in range(result.shape[0]):
        for j in range(result.shape[1]):
            total = sums[i + n, j + m] - sums[i, j + m] - sums[i + n, j] + sums[i, j]
            total_squares = squares[i + n, j + m] - squares[i, j + m] - squares[i + n, j] + squares[i, j]
            total_energy = energy_a + max(total_squares - total * total / (n * m), 0.0)
            result[i, j] = min(max(2.0 * cross[i, j] / total_energy, -1.0), 1.0) if total_energy > floor else 0.0
    return result


@njit(cache=True)
def _integral_images(image: Array) -> tuple[Array, Array]:
    """Integral images of the image and of its squares, shapes (rows + 1, columns + 1)."""
    rows, columns = image.shape
    sums, squares = np.zeros((rows + 1, columns + 1)), np.zeros((rows + 1, columns + 1))
    column_sums, column_squares = np.zeros(columns), np.zeros(columns)
    for i in range(rows):
        row_sum, row_squares = 0.0, 0.0
        for j in range(columns):
            column_sums[j] += image[i, j]
            column_squares[j] += image[i, j] * image[i, j]
            row_sum += column_sums[j]
            row_squares += column_squares[j]
            sums[i + 1, j + 1], squares[i + 1, j + 1] = row_sum, row_squares
    return sums, squares
