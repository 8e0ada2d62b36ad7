"""Bodies of triangles that follow each other: spheres around them, and the triangles of some of them."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from marsyard.sim.terrain.kernels import Array

Longs = NDArray[np.int64]


@njit(cache=True)
def body_spheres(triangles: Array, first: Longs) -> Array:
    """Middle of each body's bounding box, and the distance of its farthest corner from there.

    Parameters
    ----------
    triangles
        Shape (triangles, 3 corners, 3).
    first
        First triangle of each body, and the number of triangles at the end.
    """
    bodies = first.size - 1
    spheres = np.empty((bodies, 4))
    for body in range(bodies):
        for axis in range(3):
            low = math.inf
            high = -math.inf
            for n in range(first[body], first[body + 1]):
                for corner in range(3):
                    low = min(low, triangles[n, corner, axis])
                    high = max(high, triangles[n, corner, axis])
            spheres[body, axis] = 0.5 * (low + high)
        farthest = 0.0
        for n in range(first[body], first[body + 1]):
            for corner in range(3):
                x = triangles[n, corner, 0] - spheres[body, 0]
                y = triangles[n, corner, 1] - spheres[body, 1]
                z = triangles[n, corner, 2] - spheres[body, 2]
                farthest = max(farthest, x * x + y * y + z * z)
        spheres[body, 3] = math.sqrt(farthest)
    return spheres


@njit(cache=True)
def triangles_of(kept: NDArray[np.bool_], first: Longs) -> Longs:
    """Numbers of the triangles of the bodies that are kept, in order."""
    count = 0
    for body in range(kept.size):
        if kept[body]:
            count += first[body + 1] - first[body]
    numbers = np.empty(count, dtype=np.int64)
    place = 0
    for body in range(kept.size):
        if kept[body]:
            for n in range(first[body], first[body + 1]):
                numbers[place] = n
                place += 1
    return numbers


@njit(cache=True)
def facing(triangles: Array, numbers: Longs, x: float, y: float, z: float) -> Longs:
    """Those of some triangles, by their numbers, whose outer side a place is on."""
    kept = np.empty(numbers.size, dtype=np.int64)
    count = 0
    for n in numbers:
        ax, ay, az = triangles[n, 0, 0], triangles[n, 0, 1], triangles[n, 0, 2]
        ux, uy, uz = triangles[n, 1, 0] - ax, triangles[n, 1, 1] - ay, triangles[n, 1, 2] - az
        vx, vy, vz = triangles[n, 2, 0] - ax, triangles[n, 2, 1] - ay, triangles[n, 2, 2] - az
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        kept[count] = n
        count += nx * (x - ax) + ny * (y - ay) + nz * (z - az) > 0.0
    return kept[:count]
