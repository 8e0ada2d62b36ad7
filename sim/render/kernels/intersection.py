"""A ray against a triangle."""

from __future__ import annotations

import math

from numba import njit

from marsyard.sim.terrain.kernels import Array


@njit(cache=True, inline="always")
def hit_triangle(
    triangles: Array, n: int, x: float, y: float, z: float, dx: float, dy: float, dz: float
) -> tuple[float, float, float]:
    """Distance along a ray to a triangle's plane, and the weights of its second and third corner there.

    Moeller & Trumbore (1997). The distance is infinite where the ray runs along the plane.
    """
    ax = triangles[n, 0, 0]
    ay = triangles[n, 0, 1]
    az = triangles[n, 0, 2]
    ux = triangles[n, 1, 0] - ax
    uy = triangles[n, 1, 1] - ay
    uz = triangles[n, 1, 2] - az
    vx = triangles[n, 2, 0] - ax
    vy = triangles[n, 2, 1] - ay
    vz = triangles[n, 2, 2] - az
    px = dy * vz - dz * vy
    py = dz * vx - dx * vz
    pz = dx * vy - dy * vx
    determinant = ux * px + uy * py + uz * pz
    if abs(determinant) < 1e-18:
        return math.inf, 0.0, 0.0
    inverse = 1.0 / determinant
    sx = x - ax
    sy = y - ay
    sz = z - az
    second = (sx * px + sy * py + sz * pz) * inverse
    qx = sy * uz - sz * uy
    qy = sz * ux - sx * uz
    qz = sx * uy - sy * ux
    third = (dx * qx + dy * qy + dz * qz) * inverse
    return (vx * qx + vy * qy + vz * qz) * inverse, second, third
