"""Numba kernels of `relief`: heights of rocks on a grid, robust planes, slope and roughness of footprints."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int32]

#: Limit of the Huber loss, m: quadratic below, linear above, so that the cost function is differentiable.
HUBER_LIMIT_M = 1e-4
#: Maximum change of the plane at convergence, m, and maximum number of iterations.
MAX_PLANE_CHANGE_M, MAX_ITERATIONS = 1e-5, 60


@njit(cache=True)
def raise_by_triangles(heights: Array, west: float, south: float, spacing: float, vertices: Array, faces: Ints) -> None:
    """Raise the heights of grid points, in place, to the triangles above them.

    Row i of `heights` is at y = south + i spacing, column j at x = west + j spacing.
    """
    rows, columns = heights.shape
    for k in range(faces.shape[0]):
        a, b, c = vertices[faces[k, 0]], vertices[faces[k, 1]], vertices[faces[k, 2]]
        # edges u = b - a and v = c - a in the horizontal plane, and twice the area
        ux, uy, vx, vy = b[0] - a[0], b[1] - a[1], c[0] - a[0], c[1] - a[1]
        area = ux * vy - uy * vx
        if area <= 0.0:  # triangle faces down, or is vertical
            continue
        first_column = max(math.ceil((min(a[0], b[0], c[0]) - west) / spacing), 0)
        last_column = min(math.floor((max(a[0], b[0], c[0]) - west) / spacing), columns - 1)
        first_row = max(math.ceil((min(a[1], b[1], c[1]) - south) / spacing), 0)
        last_row = min(math.floor((max(a[1], b[1], c[1]) - south) / spacing), rows - 1)
        for i in range(first_row, last_row + 1):
            y = south + i * spacing - a[1]
            for j in range(first_column, last_column + 1):
                x = west + j * spacing - a[0]
                # the point is a + s u + t v
                s = (x * vy - y * vx) / area
                t = (ux * y - uy * x) / area
                if s >= 0.0 and t >= 0.0 and s + t <= 1.0:
                    z = a[2] + s * (b[2] - a[2]) + t * (c[2] - a[2])
                    heights[i, j] = max(heights[i, j], z)


@njit(cache=True)
def _fit_weighted_plane(x: Array, y: Array, z: Array, weights: Array, plane: Array) -> None:
    """Fit a plane by weighted least squares; write its value at the origin and its slopes to `plane`."""
    total, mean_x, mean_y, mean_z = 0.0, 0.0, 0.0, 0.0
    for i in range(x.size):
        total += weights[i]
        mean_x += weights[i] * x[i]
        mean_y += weights[i] * y[i]
        mean_z += weights[i] * z[i]
    mean_x, mean_y, mean_z = mean_x / total, mean_y / total, mean_z / total
    # second moments about the weighted means
    xx, yy, xy, xz, yz = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(x.size):
        dx, dy, dz = x[i] - mean_x, y[i] - mean_y, z[i] - mean_z
        xx += weights[i] * dx * dx
        yy += weights[i] * dy * dy
        xy += weights[i] * dx * dy
        xz += weights[i] * dx * dz
        yz += weights[i] * dy * dz
    determinant = xx * yy - xy * xy
    plane[1] = (xz * yy - yz * xy) / determinant
    plane[2] = (yz * xx - xz * xy) / determinant
    plane[0] = mean_z - plane[1] * mean_x - plane[2] * mean_y


@njit(cache=True)
def _fit_least_absolute_plane(x: Array, y: Array, z: Array, weights: Array) -> Array:
    """Fit a plane of least absolute deviations by iteratively reweighted least squares: value at (0, 0) and slopes.

    `weights` is memory for the weights of the points; its values are overwritten.
    """
    plane, previous = np.empty(3), np.empty(3)
    weights[:] = 1.0
    _fit_weighted_plane(x, y, z, weights, plane)
    extent = max(np.abs(x).max(), np.abs(y).max())
    for _ in range(MAX_ITERATIONS):
        previous[:] = plane
        for i in range(x.size):
            weights[i] = 1.0 / max(abs(z[i] - plane[0] - plane[1] * x[i] - plane[2] * y[i]), HUBER_LIMIT_M)
        _fit_weighted_plane(x, y, z, weights, plane)
        change = abs(plane[0] - previous[0]) + extent * (abs(plane[1] - previous[1]) + abs(plane[2] - previous[2]))
        if change < MAX_PLANE_CHANGE_M:
            break
    return plane


class Disc(NamedTuple):
    """Points of a disc relative to its centre (rows, columns): all points, and those used to fit planes."""

    offsets: NDArray[np.int64]
    fit_offsets: NDArray[np.int64]


@njit(cache=True)
def measure_footprints(
    heights: Array, spacing: float, centres: NDArray[np.int64], disc: Disc, limit: float
) -> tuple[Array, Array, Array]:
    """Compute slope (rad), maximum distance from the plane (m), and area beyond the limit (m2) of footprints.

    The area contains the points farther than `limit` (m) from the plane. `centres` are grid points (row, column);
    footprints must lie within the grid.
    """
    offsets, fit_offsets = disc.offsets, disc.fit_offsets
    slopes, roughness, areas = np.empty(len(centres)), np.empty(len(centres)), np.empty(len(centres))
    n = fit_offsets.shape[0]
    x, y, z, weights = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    for m in range(n):
        y[m], x[m] = fit_offsets[m, 0] * spacing, fit_offsets[m, 1] * spacing
    for k in range(len(centres)):
        row, column = centres[k, 0], centres[k, 1]
        for m in range(n):
            z[m] = heights[row + fit_offsets[m, 0], column + fit_offsets[m, 1]]
        plane = _fit_least_absolute_plane(x, y, z, weights)
        max_distance, count = 0.0, 0
        for m in range(offsets.shape[0]):
            i, j = offsets[m, 0], offsets[m, 1]
            distance = abs(heights[row + i, column + j] - plane[0] - plane[1] * j * spacing - plane[2] * i * spacing)
            max_distance = max(max_distance, distance)
            count += distance > limit
        slopes[k] = math.atan(math.hypot(plane[1], plane[2]))
        roughness[k] = max_distance
        areas[k] = count * spacing * spacing
    return slopes, roughness, areas
