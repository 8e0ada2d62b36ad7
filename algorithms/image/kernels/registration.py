"""Compiled kernels of `marsyard.algorithms.image.registration`: quintic splines, and registration of templates."""

import math

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


#: Number of unknowns of each warp order: gain, offset and shift; also affine terms; also quadratic terms.
UNKNOWNS = (4, 8, 14)
#: Determinant of the affine part of a step below which its inverse is not computed: the step collapses the template.
_MIN_DETERMINANT = 0.1


@njit(cache=True)
def build_design_matrix(template: Array, unknowns: int) -> Array:
    """Build the design matrix, one row per pixel: template, 1, derivatives for shift (2), affine (4), quadratic (6)."""
    side = template.shape[0]
    half = 0.5 * (side - 1)
    mean = template.mean()
    matrix = np.empty((side * side, unknowns))
    for i in range(side):
        for j in range(side):
            up, down = max(i - 1, 0), min(i + 1, side - 1)
            left, right = max(j - 1, 0), min(j + 1, side - 1)
            slope_y = (template[down, j] - template[up, j]) / (down - up)
            slope_x = (template[i, right] - template[i, left]) / (right - left)
            design_row = matrix[i * side + j]
            design_row[0], design_row[1] = template[i, j] - mean, 1.0
            design_row[2], design_row[3] = slope_y, slope_x
            y, x = i - half, j - half
            if unknowns >= UNKNOWNS[1]:
                design_row[4], design_row[5] = slope_y * y, slope_y * x
                design_row[6], design_row[7] = slope_x * y, slope_x * x
            if unknowns >= UNKNOWNS[2]:
                design_row[8], design_row[9], design_row[10] = slope_y * y * y, slope_y * y * x, slope_y * x * x
                design_row[11], design_row[12], design_row[13] = slope_x * y * y, slope_x * y * x, slope_x * x * x
    return matrix


# The inner loops run over independent sums, so that vector instructions compute several of them at once.


@njit(cache=True)
def normal_matrix(matrix: Array) -> Array:
    """Compute the normal matrix ``matrix^T matrix``."""
    unknowns = matrix.shape[1]
    sums = np.zeros((unknowns, unknowns))
    for k in range(matrix.shape[0]):
        design_row = matrix[k]
        for p in range(unknowns):
            for q in range(unknowns):
                sums[p, q] += design_row[p] * design_row[q]
    return sums


@njit(cache=True)
def multiply_transposed(matrix: Array, values: Array, sums: Array) -> None:
    """Store ``matrix^T values`` in `sums`."""
    sums[:] = 0.0
    for k in range(matrix.shape[0]):
        design_row = matrix[k]
        for p in range(sums.size):
            sums[p] += design_row[p] * values[k]


@njit(cache=True)
def factorize_cholesky(matrix: Array, min_pivot: float) -> bool:
    """Replace a matrix with unit diagonal by its lower Cholesky factor; False if a pivot is below `min_pivot`."""
    for i in range(len(matrix)):
        for j in range(i + 1):
            remainder = matrix[i, j]
            for k in range(j):
                remainder -= matrix[i, k] * matrix[j, k]
            if i == j:
                if not remainder > min_pivot:
                    return False
                matrix[i, i] = math.sqrt(remainder)
            else:
                matrix[i, j] = remainder / matrix[j, j]
    return True


@njit(cache=True)
def solve(lower: Array, values: Array) -> None:
    """Replace `values` by the solution x of ``lower lower^T x = values``."""
    size = len(values)
    for i in range(size):
        for k in range(i):
            values[i] -= lower[i, k] * values[k]
        values[i] /= lower[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            values[i] -= lower[k, i] * values[k]
        values[i] /= lower[i, i]


@njit(cache=True)
def compose_with_inverse(warp: Array, change: Array) -> bool:
    """Compose a warp with the inverse of the small warp ``identity + change``, in place; False if it is near singular.

    Both arrays have shape (2, 5): coefficients of y, x, y^2, y x and x^2. Products of quadratic terms are neglected,
    because they vanish at convergence.
    """
    a, b, c, d = 1.0 + change[0, 0], change[0, 1], change[1, 0], 1.0 + change[1, 1]
    determinant = a * d - b * c
    if abs(determinant) < _MIN_DETERMINANT:
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
def warp_size(warp: Array, half: float) -> float:
    """Largest relative displacement by a warp minus the identity, for points at distance `half` from the centre."""
    max_entry: float = max(abs(warp[0, 0] - 1.0), abs(warp[0, 1]), abs(warp[1, 0]), abs(warp[1, 1] - 1.0))
    for i in range(2):
        for k in range(2, 5):
            max_entry = max(max_entry, abs(warp[i, k]) * half)
    return max_entry


@njit(cache=True)
def register(
    template: Array,
    coefficients: Array,
    row: float,
    column: float,
    order: int,
    limits: tuple[float, float, int],
    tolerance: float,
    min_pivot: float,
) -> tuple[bool, float, float, float]:
    """Register a template (see `register_template`); return convergence, row and column of its centre, correlation.

    The iteration starts with the template's centre at (`row`, `column`) of the spline `coefficients`. `order` is 0 for
    a pure shift, 1 with affine terms, 2 also with quadratic terms. `limits` are the largest shift, the largest warp
    size and the maximum number of steps.
    """
    max_shift, max_warp_size, max_steps = limits
    side = template.shape[0]
    half = 0.5 * (side - 1)
    unknowns = UNKNOWNS[order]
    matrix = build_design_matrix(template, unknowns)
    scales = np.sqrt(np.sum(matrix * matrix, axis=0))
    failure = (False, row, column, 0.0)
    for p in range(unknowns):
        if not scales[p] > 0.0:
            return failure
    matrix /= scales
    lower = normal_matrix(matrix)
    if not factorize_cholesky(lower, min_pivot):
        return failure
    values = np.empty(side * side)
    solution = np.empty(unknowns)
    warp, change = np.eye(2, 5), np.zeros((2, 5))
    v, u, score = row, column, 0.0
    for step in range(max_steps):
        if order > 0 and step > 0:
            is_inside = sample(coefficients, side, v, u, warp, values)
        else:
            is_inside = sample_shifted(coefficients, side, v, u, values)
        if not is_inside:
            return failure
        values -= values.mean()
        multiply_transposed(matrix, values, solution)
        norm = math.sqrt(np.sum(values * values))
        if not (solution[0] > 0.0 and norm > 0.0):
            return failure
        score = solution[0] / norm
        solve(lower, solution)
        for p in range(unknowns):
            solution[p] /= scales[p]
        gain = solution[0]
        if not gain > 0.0:
            return failure
        warp_change = 0.0
        if order > 0:
            # inverse compositional: the solution warps the template, so compose the warp with its inverse
            for i in range(2):
                change[i, 0], change[i, 1] = solution[4 + 2 * i] / gain, solution[5 + 2 * i] / gain
                if order > 1:
                    for k in range(3):
                        change[i, 2 + k] = solution[8 + 3 * i + k] / gain
            if not compose_with_inverse(warp, change):
                return failure
            # `warp_size` expects the complete warp, including the identity
            change[0, 0] += 1.0
            change[1, 1] += 1.0
            warp_change = warp_size(change, half)
        dv = (warp[0, 0] * solution[2] + warp[0, 1] * solution[3]) / gain
        du = (warp[1, 0] * solution[2] + warp[1, 1] * solution[3]) / gain
        v, u = v - dv, u - du
        if math.hypot(v - row, u - column) > max_shift or warp_size(warp, half) > max_warp_size:
            return failure
        # the last change of the warp moves the template's border, side / 2 from the centre, by less than ten tolerances
        if math.hypot(dv, du) < tolerance and warp_change * side < 20.0 * tolerance:
            return True, v, u, score
    return failure
