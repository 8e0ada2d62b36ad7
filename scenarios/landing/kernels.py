"""Kernels: heights of rocks on a grid, robust planes, slope and roughness of footprints."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int32]

#: Smaller deviations count by their square, which makes the plane of least absolute deviations unique.
SMOOTHED_M = 1e-4
#: Change of the plane at convergence, and maximum number of iterations.
CONVERGED_M, MAX_ITERATIONS = 1e-5, 60


@njit(cache=True)
def raise_by_triangles(heights: Array, west: float, south: float, spacing: float, vertices: Array, faces: Ints) -> None:
    """Raise the heights of a grid, in place, to the triangles above its points.

    Row i of `heights` lies at y = south + i spacing, column j at x = west + j spacing.
    """
    rows, columns = heights.shape
    for k in range(faces.shape[0]):
        a, b, c = vertices[faces[k, 0]], vertices[faces[k, 1]], vertices[faces[k, 2]]
        ux, uy, vx, vy = b[0] - a[0], b[1] - a[1], c[0] - a[0], c[1] - a[1]
        area = ux * vy - uy * vx
        if area <= 0.0:  # seen from below, or edge on
            continue
        first = max(math.ceil((min(a[0], b[0], c[0]) - west) / spacing), 0)
        last = min(math.floor((max(a[0], b[0], c[0]) - west) / spacing), columns - 1)
        lowest = max(math.ceil((min(a[1], b[1], c[1]) - south) / spacing), 0)
        highest = min(math.floor((max(a[1], b[1], c[1]) - south) / spacing), rows - 1)
        for i in range(lowest, highest + 1):
            y = south + i * spacing - a[1]
            for j in range(first, last + 1):
                x = west + j * spacing - a[0]
                s = (x * vy - y * vx) / area
                t = (ux * y - uy * x) / area
                if s >= 0.0 and t >= 0.0 and s + t <= 1.0:
                    z = a[2] + s * (b[2] - a[2]) + t * (c[2] - a[2])
                    heights[i, j] = max(heights[i, j], z)


@njit(cache=True)
def _weighted_plane(x: Array, y: Array, z: Array, weights: Array, plane: Array) -> None:
    """Weighted least-squares plane, written to `plane`: value at 0 and slopes."""
    total, mx, my, mz = 0.0, 0.0, 0.0, 0.0
    for i in range(x.size):
        total += weights[i]
        mx += weights[i] * x[i]
        my += weights[i] * y[i]
        mz += weights[i] * z[i]
    mx, my, mz = mx / total, my / total, mz / total
    xx, yy, xy, xz, yz = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(x.size):
        dx, dy, dz = x[i] - mx, y[i] - my, z[i] - mz
        xx += weights[i] * dx * dx
        yy += weights[i] * dy * dy
        xy += weights[i] * dx * dy
        xz += weights[i] * dx * dz
        yz += weights[i] * dy * dz
    determinant = xx * yy - xy * xy
    plane[1] = (xz * yy - yz * xy) / determinant
    plane[2] = (yz * xx - xz * xy) / determinant
    plane[0] = mz - plane[1] * mx - plane[2] * my


@njit(cache=True)
def _least_absolute_plane(x: Array, y: Array, z: Array, weights: Array) -> Array:
    """Plane of least absolute deviations by iteratively reweighted least squares: value at (0, 0) and slopes."""
    plane, before = np.empty(3), np.empty(3)
    weights[:] = 1.0
    _weighted_plane(x, y, z, weights, plane)
    extent = max(np.abs(x).max(), np.abs(y).max())
    for _ in range(MAX_ITERATIONS):
        before[:] = plane
        for i in range(x.size):
            weights[i] = 1.0 / max(abs(z[i] - plane[0] - plane[1] * x[i] - plane[2] * y[i]), SMOOTHED_M)
        _weighted_plane(x, y, z, weights, plane)
        change = abs(plane[0] - before[0]) + extent * (abs(plane[1] - before[1]) + abs(plane[2] - before[2]))
        if change < CONVERGED_M:
            break
    return plane


class Disc(NamedTuple):
    """Points of a footprint about its middle (rows, columns): all, and those that fit planes."""

    offsets: NDArray[np.int64]
    fitted: NDArray[np.int64]


@njit(cache=True)
def footprints(
    heights: Array, spacing: float, middles: NDArray[np.int64], disc: Disc, limit: float
) -> tuple[Array, Array, Array]:
    """Slope (rad), maximum absolute distance from the plane (m), and area farther than `limit` (m2), of footprints.

    `middles` are grid points (row, column); footprints must lie within the grid.
    """
    offsets, fitted = disc.offsets, disc.fitted
    slopes, roughness, exceeding = np.empty(len(middles)), np.empty(len(middles)), np.empty(len(middles))
    n = fitted.shape[0]
    x, y, z, weights = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    for m in range(n):
        y[m], x[m] = fitted[m, 0] * spacing, fitted[m, 1] * spacing
    for k in range(len(middles)):
        row, column = middles[k, 0], middles[k, 1]
        for m in range(n):
            z[m] = heights[row + fitted[m, 0], column + fitted[m, 1]]
        plane = _least_absolute_plane(x, y, z, weights)
        max_distance, over = 0.0, 0
        for m in range(offsets.shape[0]):
            i, j = offsets[m, 0], offsets[m, 1]
            away = abs(heights[row + i, column + j] - plane[0] - plane[1] * j * spacing - plane[2] * i * spacing)
            max_distance = max(max_distance, away)
            over += away > limit
        slopes[k] = math.atan(math.hypot(plane[1], plane[2]))
        roughness[k] = max_distance
        exceeding[k] = over * spacing * spacing
    return slopes, roughness, exceeding
