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
def centred(image: Image) -> tuple[Image, float]:
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
def best_near(
    template: Image, window: Image, places: NDArray[np.int64], reach: int, floor: float
) -> tuple[NDArray[np.int64], Array]:
    """For each place (row, column) the best one within `reach` rows and columns of it, and Eq. 11 there.

    Places outside the window are moved to its border. The template is given less its mean, the window as it is: all
    sums are float64 here.
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


@njit(cache=True)
def quintic_weights(fraction: float, weights: Array) -> None:
    """The quintic B-spline's six values about a point `fraction` beyond its pixel, from two pixels before it on."""
    for k in range(6):
        x = abs(fraction - (k - 2))
        if x < 1.0:
            square = x * x
            weights[k] = 0.55 + square * (-0.5 + square * (0.25 - x / 12.0))
        elif x < 2.0:
            weights[k] = 0.425 + x * (0.625 + x * (-1.75 + x * (1.25 + x * (-0.375 + x / 24.0))))
        else:
            rest = 3.0 - x
            square = rest * rest
            weights[k] = square * square * rest / 120.0


@njit(cache=True)
def sample(coefficients: Array, side: int, row: float, column: float, matrix: Array, values: Array) -> bool:
    """Values of the spline at ``middle + matrix @ offset`` for the square of `side` pixels; False if it leaves it."""
    half = 0.5 * (side - 1)
    down, across = np.empty(6), np.empty(6)
    last_row, last_column = coefficients.shape[0] - 4, coefficients.shape[1] - 4
    for i in range(side):
        for j in range(side):
            y, x = i - half, j - half
            v = row + matrix[0, 0] * y + matrix[0, 1] * x
            u = column + matrix[1, 0] * y + matrix[1, 1] * x
            if not (v >= 2.0 and u >= 2.0 and v <= last_row and u <= last_column):
                return False
            r, c = int(v), int(u)
            quintic_weights(v - r, down)
            quintic_weights(u - c, across)
            total = 0.0
            for a in range(6):
                line = coefficients[r + a - 2]
                part = 0.0
                for b in range(6):
                    part += across[b] * line[c + b - 2]
                total += down[a] * part
            values[i * side + j] = total
    return True


@njit(cache=True)
def sample_shifted(coefficients: Array, side: int, row: float, column: float, values: Array) -> bool:
    """`sample` without stretch: all pixels share the fraction of the shift, so that rows and columns separate."""
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
def design_rows(template: Array, unknowns: int) -> Array:
    """What a patch is explained by, one row each: the template and a constant; shift (2); stretch (4, if asked for)."""
    side = template.shape[0]
    half = 0.5 * (side - 1)
    mean = template.mean()
    rows = np.empty((unknowns, side * side))
    for i in range(side):
        for j in range(side):
            up, down = max(i - 1, 0), min(i + 1, side - 1)
            left, right = max(j - 1, 0), min(j + 1, side - 1)
            by_row = (template[down, j] - template[up, j]) / (down - up)
            by_column = (template[i, right] - template[i, left]) / (right - left)
            k = i * side + j
            rows[0, k], rows[1, k] = template[i, j] - mean, 1.0
            rows[2, k], rows[3, k] = by_row, by_column
            if unknowns == 8:
                y, x = i - half, j - half
                rows[4, k], rows[5, k] = by_row * y, by_row * x
                rows[6, k], rows[7, k] = by_column * y, by_column * x
    return rows


@njit(cache=True)
def cholesky(matrix: Array, singular: float) -> bool:
    """Replaces a matrix with ones on its diagonal by its lower factor; False where a pivot is below `singular`."""
    for i in range(len(matrix)):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= matrix[i, k] * matrix[j, k]
            if i == j:
                if not rest > singular:
                    return False
                matrix[i, i] = math.sqrt(rest)
            else:
                matrix[i, j] = rest / matrix[j, j]
    return True


@njit(cache=True)
def solve(lower: Array, right: Array) -> None:
    """Replaces the right side by the solution of ``lower lower^T x = right``."""
    size = len(right)
    for i in range(size):
        for k in range(i):
            right[i] -= lower[i, k] * right[k]
        right[i] /= lower[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            right[i] -= lower[k, i] * right[k]
        right[i] /= lower[i, i]


@njit(cache=True)
def register(
    template: Array,
    coefficients: Array,
    row: float,
    column: float,
    stretch: bool,
    limits: tuple[float, float, int],
    tolerance: float,
    singular: float,
) -> tuple[bool, float, float, float]:
    """Whether it converged, the middle's row and column and the correlation there: see `registration.registered`.

    `limits` are the largest shift, the largest entry of the stretch and the number of steps.
    """
    side = template.shape[0]
    unknowns = 8 if stretch else 4
    rows = design_rows(template, unknowns)
    scales = np.sqrt(np.sum(rows * rows, axis=1))
    failed = (False, row, column, 0.0)
    for p in range(unknowns):
        if not scales[p] > 0.0:
            return failed
        rows[p] /= scales[p]
    lower = np.empty((unknowns, unknowns))
    for p in range(unknowns):
        for q in range(p + 1):
            lower[p, q] = np.sum(rows[p] * rows[q])
    if not cholesky(lower, singular):
        return failed
    values = np.empty(side * side)
    found = np.empty(unknowns)
    matrix = np.eye(2)
    v, u, score = row, column, 0.0
    for step in range(limits[2]):
        if stretch and step > 0:
            inside = sample(coefficients, side, v, u, matrix, values)
        else:
            inside = sample_shifted(coefficients, side, v, u, values)
        if not inside:
            return failed
        values -= values.mean()
        for p in range(unknowns):
            found[p] = np.sum(rows[p] * values)
        spread = math.sqrt(np.sum(values * values))
        if not (found[0] > 0.0 and spread > 0.0):
            return failed
        score = found[0] / spread
        solve(lower, found)
        for p in range(unknowns):
            found[p] /= scales[p]
        gain = found[0]
        if not gain > 0.0:
            return failed
        turn = 0.0
        if stretch:
            # the template was stretched by 1 + e: undo it before (composition with the inverse)
            a, b, c, d = 1.0 + found[4] / gain, found[5] / gain, found[6] / gain, 1.0 + found[7] / gain
            determinant = a * d - b * c
            if abs(determinant) < 0.1:
                return failed
            turn = max(abs(a - 1.0), abs(b), abs(c), abs(d - 1.0))
            m00, m01, m10, m11 = matrix[0, 0], matrix[0, 1], matrix[1, 0], matrix[1, 1]
            matrix[0, 0] = (m00 * d - m01 * c) / determinant
            matrix[0, 1] = (m01 * a - m00 * b) / determinant
            matrix[1, 0] = (m10 * d - m11 * c) / determinant
            matrix[1, 1] = (m11 * a - m10 * b) / determinant
        dv = (matrix[0, 0] * found[2] + matrix[0, 1] * found[3]) / gain
        du = (matrix[1, 0] * found[2] + matrix[1, 1] * found[3]) / gain
        v, u = v - dv, u - du
        largest = max(abs(matrix[0, 0] - 1.0), abs(matrix[0, 1]), abs(matrix[1, 0]), abs(matrix[1, 1] - 1.0))
        if math.hypot(v - row, u - column) > limits[0] or largest > limits[1]:
            return failed
        if math.hypot(dv, du) < tolerance and turn * side < 20.0 * tolerance:
            return True, v, u, score
    return failed
