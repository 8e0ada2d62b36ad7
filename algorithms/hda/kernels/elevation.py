"""Kernels of hazard detection: least-median-of-squares planes of footprints (section III).

Sections are those of Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Inlier limit in standard deviations, and ratio of standard deviation to median absolute value (normal distribution).
INLIER_DEVIATIONS = 2.5
SIGMA_PER_MEDIAN = 1.4826


@njit(cache=True)
def _fit_exact_plane(x: Array, y: Array, z: Array, i: int, j: int, k: int) -> tuple[float, float, float]:
    """Value at (0, 0) and slopes of the plane through the points i, j and k; NaN if they are collinear."""
    ux, uy, uz = x[j] - x[i], y[j] - y[i], z[j] - z[i]
    vx, vy, vz = x[k] - x[i], y[k] - y[i], z[k] - z[i]
    determinant = ux * vy - uy * vx
    # x and y are whole cells, therefore a nonzero determinant is at least 1.
    if abs(determinant) < 0.5:
        return math.nan, math.nan, math.nan
    slope_x = (uz * vy - uy * vz) / determinant
    slope_y = (ux * vz - uz * vx) / determinant
    return z[i] - slope_x * x[i] - slope_y * y[i], slope_x, slope_y


@njit(cache=True)
def _fit_least_squares_plane(x: Array, y: Array, z: Array, mask: NDArray[np.bool_]) -> tuple[float, float, float]:
    """Value at (0, 0) and slopes of the least-squares plane of the points in `mask`; NaN if they are collinear."""
    n, mean_x, mean_y, mean_z = 0, 0.0, 0.0, 0.0
    for i in range(x.size):
        if mask[i]:
            n += 1
            mean_x += x[i]
            mean_y += y[i]
            mean_z += z[i]
    if n < 3:
        return math.nan, math.nan, math.nan
    mean_x /= n
    mean_y /= n
    mean_z /= n
    sum_xx, sum_yy, sum_xy, sum_xz, sum_yz = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(x.size):
        if mask[i]:
            dx, dy, dz = x[i] - mean_x, y[i] - mean_y, z[i] - mean_z
            sum_xx += dx * dx
            sum_yy += dy * dy
            sum_xy += dx * dy
            sum_xz += dx * dz
            sum_yz += dy * dz
    determinant = sum_xx * sum_yy - sum_xy * sum_xy
    if determinant < 1e-9 * (sum_xx + sum_yy) ** 2 or determinant <= 0.0:
        return math.nan, math.nan, math.nan
    slope_x = (sum_xz * sum_yy - sum_yz * sum_xy) / determinant
    slope_y = (sum_yz * sum_xx - sum_xz * sum_xy) / determinant
    return mean_z - slope_x * mean_x - slope_y * mean_y, slope_x, slope_y


@njit(cache=True)
def robust_plane(x: Array, y: Array, z: Array, triples: Array, refine: bool) -> tuple[float, float, float]:
    """Value at (0, 0) and slopes of the least-median-of-squares plane (section III): the best plane of random triples.

    `triples` are uniform random numbers in [0, 1), one row per trial. x and y are integers (cells). The median of n
    values is their ([n / 2] + [(p + 1) / 2])-th smallest, with p = 3 unknowns (Rousseeuw & Leroy 1987). With `refine`
    the plane is fitted to the inliers by least squares.
    """
    n = x.size
    median_index = min(n // 2 + 2, n) - 1
    best = math.inf
    plane = (math.nan, math.nan, math.nan)
    distances = np.empty(n)
    for trial in range(triples.shape[0]):
        i = int(triples[trial, 0] * n)
        j = int(triples[trial, 1] * (n - 1))
        j += j >= i  # skip i, and below skip i and j: the three points differ
        k = int(triples[trial, 2] * (n - 2))
        low, high = min(i, j), max(i, j)
        k += k >= low
        k += k >= high
        value, slope_x, slope_y = _fit_exact_plane(x, y, z, i, j, k)
        if math.isnan(value):
            continue
        closer_count = 0
        for m in range(n):
            distance = abs(z[m] - value - slope_x * x[m] - slope_y * y[m])
            distances[m] = distance
            closer_count += distance < best
        # The median can only improve if enough distances are below the best median.
        if closer_count > median_index:
            best = np.partition(distances, median_index)[median_index]
            plane = (value, slope_x, slope_y)
    if not refine or math.isinf(best):
        return plane
    limit = INLIER_DEVIATIONS * SIGMA_PER_MEDIAN * (1.0 + 5.0 / max(n - 3, 1)) * best
    inliers = np.empty(n, dtype=np.bool_)
    for m in range(n):
        inliers[m] = abs(z[m] - plane[0] - plane[1] * x[m] - plane[2] * y[m]) <= limit
    refined_plane = _fit_least_squares_plane(x, y, z, inliers)
    return plane if math.isnan(refined_plane[0]) else refined_plane


@njit(cache=True)
def footprint_planes(
    elevation: Array, first_rows: NDArray[np.int64], first_columns: NDArray[np.int64], side: int, min_cells: int,
    triples: Array, refine: bool,
) -> Array:  # fmt: skip
    """Fit robust planes to squares of `side` cells that start at these rows and columns, shape (rows, columns, 3).

    Value at the square's centre, slopes per column and per row; NaN if fewer than `min_cells` cells are valid.
    """
    planes = np.full((first_rows.size, first_columns.size, 3), np.nan)
    x, y, z = np.empty(side * side), np.empty(side * side), np.empty(side * side)
    centre = (side - 1) // 2
    for a in range(first_rows.size):
        for b in range(first_columns.size):
            n = 0
            for i in range(side):
                for j in range(side):
                    value = elevation[first_rows[a] + i, first_columns[b] + j]
                    if not math.isnan(value):
                        x[n], y[n], z[n] = j - centre, i - centre, value
                        n += 1
            if n < min_cells:
                continue
            value, slope_x, slope_y = robust_plane(x[:n], y[:n], z[:n], triples, refine)
            shift = 0.5 * (side - 1) - centre
            planes[a, b, 0] = value + shift * (slope_x + slope_y)
            planes[a, b, 1] = slope_x
            planes[a, b, 2] = slope_y
    return planes


@njit(cache=True)
def evaluate_footprints(
    elevation: Array, rows: NDArray[np.int64], columns: NDArray[np.int64], offsets: NDArray[np.int64],
    fit_offsets: NDArray[np.int64], triples: Array, refine: bool,
) -> tuple[Array, Array]:  # fmt: skip
    """Fit a robust plane to each footprint; return its slope per cell and the maximum distance of a cell from it.

    `rows` and `columns` are the footprints' centres. `fit_offsets` are the cells for the plane fit, relative to the
    centre (row, column); all must have an elevation. `offsets` are the cells whose distance is checked; empty ones are
    skipped. Slopes and distances are NaN if no plane is found.
    """
    count = rows.size
    slopes, roughness = np.full(count, np.nan), np.full(count, np.nan)
    n = fit_offsets.shape[0]
    x, y, z = np.empty(n), np.empty(n), np.empty(n)
    for m in range(n):
        x[m], y[m] = fit_offsets[m, 1], fit_offsets[m, 0]
    for k in range(count):
        for m in range(n):
            z[m] = elevation[rows[k] + fit_offsets[m, 0], columns[k] + fit_offsets[m, 1]]
        value, slope_x, slope_y = robust_plane(x, y, z, triples, refine)
        max_distance = 0.0
        for m in range(offsets.shape[0]):
            i, j = rows[k] + offsets[m, 0], columns[k] + offsets[m, 1]
            if 0 <= i < elevation.shape[0] and 0 <= j < elevation.shape[1] and not math.isnan(elevation[i, j]):
                distance = abs(elevation[i, j] - value - slope_x * offsets[m, 1] - slope_y * offsets[m, 0])
                max_distance = max(max_distance, distance)
        slopes[k] = math.hypot(slope_x, slope_y)
        roughness[k] = max_distance if not math.isnan(value) else math.nan
    return slopes, roughness
