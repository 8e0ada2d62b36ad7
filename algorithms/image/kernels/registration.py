"""Compiled registration; `marsyard.algorithms.image.registration` says what it is and checks what it is given."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from marsyard.algorithms.image.kernels.quintic import sample, sample_shifted

Array = NDArray[np.float64]

#: Unknowns of each order of warp: gain and offset, shift, stretch, bend.
UNKNOWNS = (4, 8, 14)


@njit(cache=True)
def design(template: Array, unknowns: int) -> Array:
    """What each pixel is explained by, one row each: template and constant, shift (2), stretch (4), bend (6)."""
    side = template.shape[0]
    half = 0.5 * (side - 1)
    mean = template.mean()
    rows = np.empty((side * side, unknowns))
    for i in range(side):
        for j in range(side):
            up, down = max(i - 1, 0), min(i + 1, side - 1)
            left, right = max(j - 1, 0), min(j + 1, side - 1)
            by_row = (template[down, j] - template[up, j]) / (down - up)
            by_column = (template[i, right] - template[i, left]) / (right - left)
            of_pixel = rows[i * side + j]
            of_pixel[0], of_pixel[1] = template[i, j] - mean, 1.0
            of_pixel[2], of_pixel[3] = by_row, by_column
            y, x = i - half, j - half
            if unknowns >= 8:
                of_pixel[4], of_pixel[5] = by_row * y, by_row * x
                of_pixel[6], of_pixel[7] = by_column * y, by_column * x
            if unknowns >= 14:
                of_pixel[8], of_pixel[9], of_pixel[10] = by_row * y * y, by_row * y * x, by_row * x * x
                of_pixel[11], of_pixel[12], of_pixel[13] = by_column * y * y, by_column * y * x, by_column * x * x
    return rows


# Sums are taken side by side, each over the pixels in their order: vector instructions add up several at once.


@njit(cache=True)
def products(rows: Array) -> Array:
    """``rows^T rows``."""
    unknowns = rows.shape[1]
    sums = np.zeros((unknowns, unknowns))
    for k in range(rows.shape[0]):
        of_pixel = rows[k]
        for p in range(unknowns):
            for q in range(unknowns):
                sums[p, q] += of_pixel[p] * of_pixel[q]
    return sums


@njit(cache=True)
def project(rows: Array, values: Array, sums: Array) -> None:
    """``rows^T values``."""
    sums[:] = 0.0
    for k in range(rows.shape[0]):
        of_pixel = rows[k]
        for p in range(sums.size):
            sums[p] += of_pixel[p] * values[k]


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
def unwarp(warp: Array, change: Array) -> bool:
    """Composes a warp with the inverse of a small one; False where there is none.

    Both are of shape (2, 5): what multiplies y, x, y^2, y x and x^2. Of the bends, products with one another are left
    out: they vanish as the change does.
    """
    a, b, c, d = 1.0 + change[0, 0], change[0, 1], change[1, 0], 1.0 + change[1, 1]
    determinant = a * d - b * c
    if abs(determinant) < 0.1:
        return False
    m00, m01, m10, m11 = warp[0, 0], warp[0, 1], warp[1, 0], warp[1, 1]
    warp[0, 0] = (m00 * d - m01 * c) / determinant
    warp[0, 1] = (m01 * a - m00 * b) / determinant
    warp[1, 0] = (m10 * d - m11 * c) / determinant
    warp[1, 1] = (m11 * a - m10 * b) / determinant
    for k in range(2, 5):
        warp[0, k] -= warp[0, 0] * change[0, k] + warp[0, 1] * change[1, k]
        warp[1, k] -= warp[1, 0] * change[0, k] + warp[1, 1] * change[1, k]
    return True


@njit(cache=True)
def strength(warp: Array, half: float) -> float:
    """Largest fraction by which a warp, less the identity, displaces what is `half` away from the middle."""
    largest: float = max(abs(warp[0, 0] - 1.0), abs(warp[0, 1]), abs(warp[1, 0]), abs(warp[1, 1] - 1.0))
    for i in range(2):
        for k in range(2, 5):
            largest = max(largest, abs(warp[i, k]) * half)
    return largest


@njit(cache=True)
def register(
    template: Array,
    coefficients: Array,
    row: float,
    column: float,
    order: int,
    limits: tuple[float, float, int],
    tolerance: float,
    singular: float,
) -> tuple[bool, float, float, float]:
    """Whether it converged, the middle's row and column and the correlation there: see `registration.registered`.

    `order` is 0 for shift alone, 1 with stretch, 2 with bend too. `limits` are the largest shift, the largest strength
    of the warp and the number of steps.
    """
    side = template.shape[0]
    half = 0.5 * (side - 1)
    unknowns = UNKNOWNS[order]
    rows = design(template, unknowns)
    scales = np.sqrt(np.sum(rows * rows, axis=0))
    failed = (False, row, column, 0.0)
    for p in range(unknowns):
        if not scales[p] > 0.0:
            return failed
    rows /= scales
    lower = products(rows)
    if not cholesky(lower, singular):
        return failed
    values = np.empty(side * side)
    solution = np.empty(unknowns)
    warp, change = np.eye(2, 5), np.zeros((2, 5))
    v, u, score = row, column, 0.0
    for step in range(limits[2]):
        if order > 0 and step > 0:
            inside = sample(coefficients, side, v, u, warp, values)
        else:
            inside = sample_shifted(coefficients, side, v, u, values)
        if not inside:
            return failed
        values -= values.mean()
        project(rows, values, solution)
        spread = math.sqrt(np.sum(values * values))
        if not (solution[0] > 0.0 and spread > 0.0):
            return failed
        score = solution[0] / spread
        solve(lower, solution)
        for p in range(unknowns):
            solution[p] /= scales[p]
        gain = solution[0]
        if not gain > 0.0:
            return failed
        warp_change = 0.0
        if order > 0:
            # the template was warped by this: undo it before (composition with the inverse)
            for i in range(2):
                change[i, 0], change[i, 1] = solution[4 + 2 * i] / gain, solution[5 + 2 * i] / gain
                if order > 1:
                    for k in range(3):
                        change[i, 2 + k] = solution[8 + 3 * i + k] / gain
            if not unwarp(warp, change):
                return failed
            change[0, 0] += 1.0
            change[1, 1] += 1.0
            warp_change = strength(change, half)
        dv = (warp[0, 0] * solution[2] + warp[0, 1] * solution[3]) / gain
        du = (warp[1, 0] * solution[2] + warp[1, 1] * solution[3]) / gain
        v, u = v - dv, u - du
        if math.hypot(v - row, u - column) > limits[0] or strength(warp, half) > limits[1]:
            return failed
        if math.hypot(dv, du) < tolerance and warp_change * side < 20.0 * tolerance:
            return True, v, u, score
    return failed
