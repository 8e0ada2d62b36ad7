"""Heights of ground with rocks on a grid, and planes, slopes and roughness of footprints on it."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int32]

#: Deviations that a point may be off a robust plane and still count in its refinement, and what makes the median of
#: absolute values the standard deviation of a normal distribution (Rousseeuw & Leroy 1987).
INLIER_DEVIATIONS = 2.5
DEVIATION_OF_MEDIAN = 1.4826


@njit(cache=True)
def raise_by_triangles(heights: Array, west: float, south: float, spacing: float, vertices: Array, faces: Ints) -> None:
    """Raises the heights of a grid, in place, to the triangles that lie above its points.

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
def _least_squares(x: Array, y: Array, z: Array, limit: float, plane: Array) -> None:
    """Replaces a plane (value at 0, slopes) by the least-squares one of the points within `limit` of it."""
    n, mx, my, mz = 0, 0.0, 0.0, 0.0
    for i in range(x.size):
        if abs(z[i] - plane[0] - plane[1] * x[i] - plane[2] * y[i]) <= limit:
            n += 1
            mx += x[i]
            my += y[i]
            mz += z[i]
    mx, my, mz = mx / n, my / n, mz / n
    xx, yy, xy, xz, yz = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(x.size):
        if abs(z[i] - plane[0] - plane[1] * x[i] - plane[2] * y[i]) <= limit:
            dx, dy, dz = x[i] - mx, y[i] - my, z[i] - mz
            xx += dx * dx
            yy += dy * dy
            xy += dx * dy
            xz += dx * dz
            yz += dy * dz
    determinant = xx * yy - xy * xy
    if determinant > 1e-9 * (xx + yy) ** 2:
        plane[1] = (xz * yy - yz * xy) / determinant
        plane[2] = (yz * xx - xz * xy) / determinant
        plane[0] = mz - plane[1] * mx - plane[2] * my


@njit(cache=True)
def _robust_plane(x: Array, y: Array, z: Array, triples: Array, distances: Array) -> Array:
    """The least-median-of-squares plane over planes through random triples, refined: value at (0, 0) and slopes."""
    n = x.size
    order = min(n // 2 + 2, n) - 1
    best = math.inf
    plane = np.full(3, math.nan)
    least_area = 0.02 * (x.max() - x.min()) ** 2
    for trial in range(triples.shape[0]):
        i, j, k = int(triples[trial, 0] * n), int(triples[trial, 1] * n), int(triples[trial, 2] * n)
        ux, uy, uz = x[j] - x[i], y[j] - y[i], z[j] - z[i]
        vx, vy, vz = x[k] - x[i], y[k] - y[i], z[k] - z[i]
        area = ux * vy - uy * vx
        if abs(area) < least_area:
            continue
        by_x, by_y = (uz * vy - uy * vz) / area, (ux * vz - uz * vx) / area
        value = z[i] - by_x * x[i] - by_y * y[i]
        nearer = 0
        for m in range(n):
            distances[m] = abs(z[m] - value - by_x * x[m] - by_y * y[m])
            nearer += distances[m] < best
        # the median is below the best so far only if enough of the distances are
        if nearer > order:
            best = np.partition(distances, order)[order]
            plane[0], plane[1], plane[2] = value, by_x, by_y
    limit = INLIER_DEVIATIONS * DEVIATION_OF_MEDIAN * (1.0 + 5.0 / max(n - 3, 1)) * best
    _least_squares(x, y, z, limit, plane)
    return plane


@njit(cache=True)
def footprints(
    heights: Array, rows: NDArray[np.int64], columns: NDArray[np.int64], offsets: NDArray[np.int64],
    fitted: NDArray[np.int64], spacing: float, triples: Array, limit: float, slopes: Array, roughness: Array,
    exceeding: Array,
) -> None:  # fmt: skip
    """Slope, greatest distance from the plane (upwards or downwards), and area farther than `limit`, of footprints.

    Parameters
    ----------
    heights, spacing
        The grid, metres.
    rows, columns
        The grid's point in the middle of each footprint; a footprint lies within the grid.
    offsets, fitted
        Points of a footprint from its middle (rows, columns): all, and those through which planes are laid.
    triples
        Uniform numbers in [0, 1), one row a trial.
    limit
        Distance above which area is counted.
    slopes, roughness, exceeding
        Filled with the angles (radians), distances (metres) and areas (square metres).
    """
    n = fitted.shape[0]
    x, y, z, distances = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    for m in range(n):
        y[m], x[m] = fitted[m, 0] * spacing, fitted[m, 1] * spacing
    for k in range(rows.size):
        for m in range(n):
            z[m] = heights[rows[k] + fitted[m, 0], columns[k] + fitted[m, 1]]
        plane = _robust_plane(x, y, z, triples, distances)
        most, over = 0.0, 0
        for m in range(offsets.shape[0]):
            i, j = offsets[m, 0], offsets[m, 1]
            above = heights[rows[k] + i, columns[k] + j]
            away = abs(above - plane[0] - plane[1] * j * spacing - plane[2] * i * spacing)
            most = max(most, away)
            over += away > limit
        slopes[k] = math.atan(math.hypot(plane[1], plane[2]))
        roughness[k] = most
        exceeding[k] = over * spacing * spacing
