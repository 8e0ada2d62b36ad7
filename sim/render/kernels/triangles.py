"""Triangles: a ray against them, those that face a place, and spheres around bodies of them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from marsyard.sim.render.kernels.structs import Longs, Ray
from marsyard.sim.terrain.kernels import Array


class TriangleHit(NamedTuple):
    """Distance along a ray, number of the triangle, -1 for none, and weights of its second and third corner there."""

    distance: float
    triangle: int
    second: float
    third: float


@njit(cache=True, inline="always")
def hit_triangle(triangles: Array, n: int, ray: Ray) -> tuple[float, float, float]:
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
    px = ray.dy * vz - ray.dz * vy
    py = ray.dz * vx - ray.dx * vz
    pz = ray.dx * vy - ray.dy * vx
    determinant = ux * px + uy * py + uz * pz
    if abs(determinant) < 1e-18:
        return math.inf, 0.0, 0.0
    inverse = 1.0 / determinant
    sx = ray.x - ax
    sy = ray.y - ay
    sz = ray.z - az
    second = (sx * px + sy * py + sz * pz) * inverse
    qx = sy * uz - sz * uy
    qy = sz * ux - sx * uz
    qz = sx * uy - sy * ux
    third = (ray.dx * qx + ray.dy * qy + ray.dz * qz) * inverse
    return (vx * qx + vy * qy + vz * qz) * inverse, second, third


@njit(cache=True, inline="always")
def nearer_hit(best: TriangleHit, triangles: Array, n: int, ray: Ray, slack: float) -> TriangleHit:
    """The n-th triangle's hit where the ray meets it nearer than the best so far, else the best; slack of its edges."""
    t, second, third = hit_triangle(triangles, n, ray)
    inside = second >= -slack and third >= -slack and second + third <= 1.0 + slack
    return TriangleHit(t, n, second, third) if 0.0 < t < best.distance and inside else best


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
def select_facing(triangles: Array, numbers: Longs, x: float, y: float, z: float) -> Longs:
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
