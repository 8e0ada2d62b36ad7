"""Rays against the triangles of things that stand on the ground."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim.terrain.kernels import Array

Ints = NDArray[np.int32]
Longs = NDArray[np.int64]
#: What `sim.render.objects.Objects.arrays` gives: triangles, normals, body of each triangle, first triangle of each
#: body, spheres around bodies, albedos, grid (x, y, cell size, highest top), cells along x, first item of each cell,
#: items.
ObjectArrays = tuple[Array, Array, Ints, Longs, Array, Array, Array, int, Longs, Ints]


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


@njit(cache=True)
def objects_hide_sun(things: ObjectArrays, x: float, y: float, z: float, sun: Array, clearance: float) -> bool:
    """Whether a thing stands between a place and the sun; what is nearer than `clearance` does not count."""
    triangles, _normals, _body, first, spheres, _albedo, grid, cells_x, cell_start, items = things
    if spheres.shape[0] == 0 or z >= grid[3] or sun[2] <= 0.0:
        return False
    across = math.hypot(sun[0], sun[1])
    reach = (grid[3] - z) * across / sun[2]
    size = grid[2]
    cells_y = (cell_start.shape[0] - 1) // cells_x
    steps = int(reach / size) + 2
    step_x = 0.0 if across == 0.0 else sun[0] / across * size
    step_y = 0.0 if across == 0.0 else sun[1] / across * size
    for k in range(steps):
        j = math.floor((x + k * step_x - grid[0]) / size)
        i = math.floor((y + k * step_y - grid[1]) / size)
        if i < 0 or j < 0 or i >= cells_y or j >= cells_x:
            continue
        cell = i * cells_x + j
        for at in range(cell_start[cell], cell_start[cell + 1]):
            body = items[at]
            cx = spheres[body, 0] - x
            cy = spheres[body, 1] - y
            cz = spheres[body, 2] - z
            along = cx * sun[0] + cy * sun[1] + cz * sun[2]
            radius = spheres[body, 3]
            if along < -radius or cx * cx + cy * cy + cz * cz - along * along > radius * radius:
                continue
            for n in range(first[body], first[body + 1]):
                t, second, third = hit_triangle(triangles, n, x, y, z, sun[0], sun[1], sun[2])
                if t > clearance and t < math.inf and second >= 0.0 and third >= 0.0 and second + third <= 1.0:
                    return True
    return False
