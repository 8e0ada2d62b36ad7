"""Compiled geometry of a rocker-bogie suspension; `marsyard.sim.dynamics.rover` has the model and names every angle."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
#: Wheels on each side: front, middle, rear.
ON_A_SIDE = 3


@njit(cache=True)
def turned(x: float, z: float, angle: float, about: Array) -> tuple[float, float]:
    """A place (x, z) turned about another: a positive angle lowers what is in front."""
    sine, cosine = math.sin(angle), math.cos(angle)
    x -= about[0]
    z -= about[1]
    return about[0] + cosine * x + sine * z, about[1] + cosine * z - sine * x


@njit(cache=True)
def wheel_centres(rest: Array, rocker_pivot: Array, bogie_pivot: Array, joints: Array) -> Array:
    """Centres of the wheels in the rover frame.

    Parameters
    ----------
    rest
        The same on level ground, shape (6, 3): left front, middle, rear, right front, middle, rear.
    rocker_pivot, bogie_pivot
        (x, z) of the axes on level ground.
    joints
        Angles of the differential, the left and the right bogie.
    """
    centres = np.empty((2 * ON_A_SIDE, 3))
    for wheel in range(2 * ON_A_SIDE):
        side = wheel // ON_A_SIDE
        x, z = rest[wheel, 0], rest[wheel, 2]
        if wheel % ON_A_SIDE > 0:
            x, z = turned(x, z, joints[1 + side], bogie_pivot)
        x, z = turned(x, z, joints[0] if side == 0 else -joints[0], rocker_pivot)
        centres[wheel, 0], centres[wheel, 1], centres[wheel, 2] = x, rest[wheel, 1], z
    return centres


@njit(cache=True)
def tread_places(
    unknown: Array,
    yaw: float,
    place: Array,
    rest: Array,
    rocker_pivot: Array,
    bogie_pivot: Array,
    treads: Array,
) -> tuple[Array, Array, Array]:
    """World x, y and z of places of the wheels' treads, each of shape (n, 6, places).

    Parameters
    ----------
    unknown
        Heights, pitches, rolls, and joints as for `wheel_centres`, shape (n, 6).
    yaw, place
        Turn of the rover about the vertical, and world x and y of its origin.
    rest, rocker_pivot, bogie_pivot
        As for `wheel_centres`.
    treads
        Places on the treads from the wheels' centres, shape (6, places, 3), or (1, places, 3) for all wheels alike.
    """
    count, on_tread = unknown.shape[0], treads.shape[1]
    x = np.empty((count, 2 * ON_A_SIDE, on_tread))
    y, z = np.empty_like(x), np.empty_like(x)
    sy, cy = math.sin(yaw), math.cos(yaw)
    for n in range(count):
        # turned by roll about x, then by -pitch about y, then by yaw about z
        sp, cp = math.sin(-unknown[n, 1]), math.cos(-unknown[n, 1])
        sr, cr = math.sin(unknown[n, 2]), math.cos(unknown[n, 2])
        centres = wheel_centres(rest, rocker_pivot, bogie_pivot, unknown[n, 3:])
        for wheel in range(2 * ON_A_SIDE):
            tread = treads[wheel % treads.shape[0]]
            for k in range(on_tread):
                a = centres[wheel, 0] + tread[k, 0]
                b = centres[wheel, 1] + tread[k, 1]
                c = centres[wheel, 2] + tread[k, 2]
                forward = cp * a + sp * (sr * b + cr * c)
                left = cr * b - sr * c
                x[n, wheel, k] = place[0] + cy * forward - sy * left
                y[n, wheel, k] = place[1] + sy * forward + cy * left
                z[n, wheel, k] = unknown[n, 0] + cp * (sr * b + cr * c) - sp * a
    return x, y, z
