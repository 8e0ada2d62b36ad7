"""Compiled geometry of a rocker-bogie suspension; `marsyard.sim.dynamics.rover` defines the model and its angles."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
#: Wheels on each side: front, middle, rear.
WHEELS_PER_SIDE = 3


@njit(cache=True)
def rotate_about_pivot(x: float, z: float, angle: float, pivot: Array) -> tuple[float, float]:
    """Rotate a point (x, z) about a pivot (x, z); a positive angle lowers points in front of the pivot."""
    sine, cosine = math.sin(angle), math.cos(angle)
    x -= pivot[0]
    z -= pivot[1]
    return pivot[0] + cosine * x + sine * z, pivot[1] + cosine * z - sine * x


@njit(cache=True)
def compute_wheel_centres(level_centres: Array, rocker_pivot: Array, bogie_pivot: Array, joints: Array) -> Array:
    """Compute the centres of the wheels in the rover frame, metres, shape (6, 3).

    - level_centres: centres on level ground (all joint angles zero), in the order of the rover's `WHEELS`
    - rocker_pivot, bogie_pivot: (x, z) of the axes on level ground
    - joints: angles of the differential, the left and the right bogie, radians
    """
    centres = np.empty((2 * WHEELS_PER_SIDE, 3))
    for wheel in range(2 * WHEELS_PER_SIDE):
        side = wheel // WHEELS_PER_SIDE
        x, z = level_centres[wheel, 0], level_centres[wheel, 2]
        if wheel % WHEELS_PER_SIDE > 0:
            x, z = rotate_about_pivot(x, z, joints[1 + side], bogie_pivot)
        x, z = rotate_about_pivot(x, z, joints[0] if side == 0 else -joints[0], rocker_pivot)
        centres[wheel, 0], centres[wheel, 1], centres[wheel, 2] = x, level_centres[wheel, 1], z
    return centres


@njit(cache=True)
def compute_tread_points(
    states: Array,
    yaw: float,
    position: Array,
    level_centres: Array,
    rocker_pivot: Array,
    bogie_pivot: Array,
    treads: Array,
) -> tuple[Array, Array, Array]:
    """Compute world x, y and z of points on the wheels' treads, each of shape (n, 6, points).

    - states: height, pitch, roll, and joints as for `compute_wheel_centres`, shape (n, 6)
    - yaw, position: rotation of the rover about the vertical, and world x and y of its origin
    - treads: points relative to the wheels' centres, shape (6, points, 3), or (1, points, 3) if common to all wheels
    """
    count, points_per_tread = states.shape[0], treads.shape[1]
    x = np.empty((count, 2 * WHEELS_PER_SIDE, points_per_tread))
    y, z = np.empty_like(x), np.empty_like(x)
    sy, cy = math.sin(yaw), math.cos(yaw)
    for n in range(count):
        # rotation by roll about x, then by -pitch about y, then by yaw about z
        sp, cp = math.sin(-states[n, 1]), math.cos(-states[n, 1])
        sr, cr = math.sin(states[n, 2]), math.cos(states[n, 2])
        centres = compute_wheel_centres(level_centres, rocker_pivot, bogie_pivot, states[n, 3:])
        for wheel in range(2 * WHEELS_PER_SIDE):
            tread = treads[wheel % treads.shape[0]]
            for k in range(points_per_tread):
                # point (a, b, c) of the tread in the rover frame
                a = centres[wheel, 0] + tread[k, 0]
                b = centres[wheel, 1] + tread[k, 1]
                c = centres[wheel, 2] + tread[k, 2]
                forward = cp * a + sp * (sr * b + cr * c)
                left = cr * b - sr * c
                x[n, wheel, k] = position[0] + cy * forward - sy * left
                y[n, wheel, k] = position[1] + sy * forward + cy * left
                z[n, wheel, k] = states[n, 0] + cp * (sr * b + cr * c) - sp * a
    return x, y, z
