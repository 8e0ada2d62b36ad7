"""Compiled kernels of cameras' rays: the angle that each pixel takes, their middle, and how wide they are."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from marsyard.sim.render.kernels.structs import Array32
from marsyard.sim.terrain.kernels import Array


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


@njit(cache=True)
def summed(directions: Array32) -> tuple[float, float, float]:
    """Sum of vectors, shape (n, 3)."""
    x, y, z = 0.0, 0.0, 0.0
    for n in range(directions.shape[0]):
        x += directions[n, 0]
        y += directions[n, 1]
        z += directions[n, 2]
    return x, y, z


@njit(cache=True)
def least_along(directions: Array32, axis: Array) -> float:
    """Least component along an axis of vectors, shape (n, 3)."""
    least = math.inf
    for n in range(directions.shape[0]):
        least = min(least, directions[n, 0] * axis[0] + directions[n, 1] * axis[1] + directions[n, 2] * axis[2])
    return least


@njit(cache=True, error_model="numpy")
def extent(directions: Array, view: Array) -> float:
    """Greatest distance from the middle of a view's picture, across or down, at a focal length of 1.

    Parameters
    ----------
    directions
        Rays of the pixels shown, shape (rows, columns, 3).
    view
        Right, down and forward of the view, one row each.
    """
    most = 0.0
    for i in range(directions.shape[0]):
        for j in range(directions.shape[1]):
            x, y, z = directions[i, j, 0], directions[i, j, 1], directions[i, j, 2]
            right = view[0, 0] * x + view[0, 1] * y + view[0, 2] * z
            down = view[1, 0] * x + view[1, 1] * y + view[1, 2] * z
            forward = view[2, 0] * x + view[2, 1] * y + view[2, 2] * z
            most = max(most, abs(right / forward), abs(down / forward))
    return most
