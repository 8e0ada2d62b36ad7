"""Compiled kernel of cameras' rays: the angle that each pixel takes."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from sim.render.kernels.ground import Array32
from sim.terrain.kernels import Array


@njit(cache=True, error_model="numpy")
def pixel_angles(directions: Array) -> Array32:
    """Square root of each pixel's solid angle, radians, from the unit vectors along all rays of a picture.

    A pixel's sides are half the way between its neighbours on both sides, at the border the way to the one there is.

    Parameters
    ----------
    directions
        Shape (rows, columns, 3).
    """
    rows, columns = directions.shape[:2]
    angles = np.empty((rows, columns), dtype=np.float32)
    for i in range(rows):
        above, below = max(i - 1, 0), min(i + 1, rows - 1)
        down = float(below - above)
        for j in range(columns):
            left, right = max(j - 1, 0), min(j + 1, columns - 1)
            across = float(right - left)
            ax = (directions[i, right, 0] - directions[i, left, 0]) / across
            ay = (directions[i, right, 1] - directions[i, left, 1]) / across
            az = (directions[i, right, 2] - directions[i, left, 2]) / across
            bx = (directions[below, j, 0] - directions[above, j, 0]) / down
            by = (directions[below, j, 1] - directions[above, j, 1]) / down
            bz = (directions[below, j, 2] - directions[above, j, 2]) / down
            x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            angles[i, j] = math.sqrt(math.sqrt(x * x + y * y + z * z))
    return angles
