"""Kernels of gradient noise (Perlin, "Improving noise", 2002) for strips of points.

Positions have double precision; the offsets from the lattice points, and the noise, have single precision. Loops over
numbers of 32 bits process twice as many points per vector instruction. Each integer operation is therefore cast to 32
bits: numba computes with 64 bits otherwise.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from marsyard.sim.render.kernels.strips import ROW, STRIP
from marsyard.sim.render.kernels.structs import Array32
from marsyard.sim.terrain.kernels import Array

#: Odd factors of the lattice coordinates and of the seed in the hash of a lattice point.
_HASH_X, _HASH_Y, _HASH_Z, _HASH_SEED = (np.uint32(n) for n in (0x8DA6B343, 0xD8163841, 0xCB1AB31F, 0x9E3779B1))
#: Components of the gradients in the plane: eight unit vectors, evenly spaced in angle.
_LONG, _SHORT = np.float32(math.cos(math.pi / 8.0)), np.float32(math.sin(math.pi / 8.0))
_ONE, _SIX, _TEN, _FIFTEEN, _THIRTY = (np.float32(n) for n in (1.0, 6.0, 10.0, 15.0, 30.0))


class NoiseBuffers(NamedTuple):
    """Buffers of a strip of points.

    - lattice: sum of the products of lattice coordinates, seed and their factors
    - offset: offsets from the lattice point, a row per axis
    - noise: the noise, and in the plane also its derivatives along x and y, a row each
    """

    lattice: NDArray[np.uint32]
    offset: Array32
    noise: Array32


@njit(cache=True)
def allocate_noise() -> NoiseBuffers:
    """Allocate the buffers of a strip of points."""
    return NoiseBuffers(
        np.empty(STRIP, dtype=np.uint32), np.empty(3 * ROW, dtype=np.float32), np.empty(3 * ROW, dtype=np.float32)
    )


@njit(cache=True, inline="always")
def _mix(h: np.uint32) -> np.uint32:
    """Mix the bits of a hash (the finaliser of MurmurHash3)."""
    h = np.uint32(h ^ np.uint32(h >> np.uint32(16)))
    h = np.uint32(h * np.uint32(0x85EBCA6B))
    h = np.uint32(h ^ np.uint32(h >> np.uint32(13)))
    h = np.uint32(h * np.uint32(0xC2B2AE35))
    return np.uint32(h ^ np.uint32(h >> np.uint32(16)))


@njit(cache=True, inline="always")
def _product_3d(h: np.uint32, x: np.float32, y: np.float32, z: np.float32) -> np.float32:
    """Scalar product of an offset and one of Perlin's twelve gradients.

    The last four bits of a hash select one of 16 entries: four gradients have two entries. Written without a table,
    and with selections instead of branches, for vector instructions.
    """
    selector = np.uint32(h & np.uint32(15))
    first = x if selector < np.uint32(8) else y
    second = y if selector < np.uint32(4) else (x if np.uint32(selector & np.uint32(13)) == np.uint32(12) else z)
    return (-first if np.uint32(selector & np.uint32(1)) else first) + (
        -second if np.uint32(selector & np.uint32(2)) else second
    )


@njit(cache=True, inline="always")
def _gradient_2d(h: np.uint32) -> tuple[np.float32, np.float32]:
    """Select one of eight gradients in the plane by a hash."""
    first = _LONG if np.uint32(h & np.uint32(1)) else _SHORT
    second = _SHORT if np.uint32(h & np.uint32(1)) else _LONG
    return (-first if np.uint32(h & np.uint32(2)) else first), (-second if np.uint32(h & np.uint32(4)) else second)


@njit(cache=True, inline="always")
def _fade(t: np.float32) -> np.float32:
    """Compute Perlin's interpolation weight 6 t^5 - 15 t^4 + 10 t^3."""
    return t * t * t * (t * (t * _SIX - _FIFTEEN) + _TEN)


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _locate_3d(x: Array, y: Array, z: Array, cell: float, seed: int, buffers: NoiseBuffers) -> None:
    """Compute the hash sum of the lower corner of each point's lattice cell in space, and the offset from it."""
    lattice, offset, _noise = buffers
    per_metre, seed_term = 1.0 / cell, np.uint32(np.uint32(seed) * _HASH_SEED)
    for k in range(min(x.size, STRIP)):
        gx, gy, gz = x[k] * per_metre, y[k] * per_metre, z[k] * per_metre
        fx, fy, fz = np.floor(gx), np.floor(gy), np.floor(gz)
        offset[k], offset[ROW + k], offset[2 * ROW + k] = gx - fx, gy - fy, gz - fz
        plane = np.uint32(np.uint32(np.uint32(np.int32(fx)) * _HASH_X) + np.uint32(np.uint32(np.int32(fy)) * _HASH_Y))
        lattice[k] = np.uint32(plane + np.uint32(np.uint32(np.uint32(np.int32(fz)) * _HASH_Z) + seed_term))


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def noise_3d(x: Array, y: Array, z: Array, cell: float, seed: int, buffers: NoiseBuffers) -> None:
    """Compute smooth noise of mean zero in space at up to `STRIP` points; its wavelengths are one to two cells."""
    _locate_3d(x, y, z, cell, seed, buffers)
    lattice, offset, noise = buffers
    for k in range(min(x.size, STRIP)):
        x0, y0, z0, h = offset[k], offset[ROW + k], offset[2 * ROW + k], lattice[k]
        x1, y1, z1 = x0 - _ONE, y0 - _ONE, z0 - _ONE
        u, v, w = _fade(x0), _fade(y0), _fade(z0)
        hx, hy, hz = np.uint32(h + _HASH_X), np.uint32(h + _HASH_Y), np.uint32(h + _HASH_Z)
        hxy, hxz, hyz = np.uint32(hx + _HASH_Y), np.uint32(hx + _HASH_Z), np.uint32(hy + _HASH_Z)
        a, b = _product_3d(_mix(h), x0, y0, z0), _product_3d(_mix(hx), x1, y0, z0)
        c, d = _product_3d(_mix(hy), x0, y1, z0), _product_3d(_mix(hxy), x1, y1, z0)
        south, north = a + u * (b - a), c + u * (d - c)
        below = south + v * (north - south)
        a, b = _product_3d(_mix(hz), x0, y0, z1), _product_3d(_mix(hxz), x1, y0, z1)
        c, d = _product_3d(_mix(hyz), x0, y1, z1), _product_3d(_mix(np.uint32(hxy + _HASH_Z)), x1, y1, z1)
        south, north = a + u * (b - a), c + u * (d - c)
        noise[k] = below + w * (south + v * (north - south) - below)


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _locate_2d(x: Array, y: Array, cell: float, seed: int, buffers: NoiseBuffers) -> None:
    """Compute the hash sum of the lower corner of each point's lattice cell in the plane, and the offset from it."""
    lattice, offset, _noise = buffers
    per_metre, seed_term = 1.0 / cell, np.uint32(np.uint32(seed) * _HASH_SEED)
    for k in range(min(x.size, STRIP)):
        gx, gy = x[k] * per_metre, y[k] * per_metre
        fx, fy = np.floor(gx), np.floor(gy)
        offset[k], offset[ROW + k] = gx - fx, gy - fy
        plane = np.uint32(np.uint32(np.uint32(np.int32(fx)) * _HASH_X) + np.uint32(np.uint32(np.int32(fy)) * _HASH_Y))
        lattice[k] = np.uint32(plane + seed_term)


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def noise_2d(x: Array, y: Array, cell: float, seed: int, buffers: NoiseBuffers) -> None:
    """Compute noise of mean zero in the plane at up to `STRIP` points, and its derivatives along x and y, per cell."""
    _locate_2d(x, y, cell, seed, buffers)
    lattice, offset, noise = buffers
    for k in range(min(x.size, STRIP)):
        x0, y0, h = offset[k], offset[ROW + k], lattice[k]
        x1, y1 = x0 - _ONE, y0 - _ONE
        u, v, du, dv = _fade(x0), _fade(y0), _THIRTY * x0 * x0 * x1 * x1, _THIRTY * y0 * y0 * y1 * y1
        hx = np.uint32(h + _HASH_X)
        ax, ay = _gradient_2d(_mix(h))
        bx, by = _gradient_2d(_mix(hx))
        cx, cy = _gradient_2d(_mix(np.uint32(h + _HASH_Y)))
        dx, dy = _gradient_2d(_mix(np.uint32(hx + _HASH_Y)))
        a = ax * x0 + ay * y0
        difference_x = bx * x1 + by * y0 - a
        difference_y = cx * x0 + cy * y1 - a
        twist = dx * x1 + dy * y1 - a - difference_x - difference_y
        noise[k] = a + u * difference_x + v * difference_y + u * v * twist
        noise[ROW + k] = (
            ax + u * (bx - ax) + v * (cx - ax) + u * v * (ax - bx - cx + dx) + du * (difference_x + v * twist)
        )
        noise[2 * ROW + k] = (
            ay + u * (by - ay) + v * (cy - ay) + u * v * (ay - by - cy + dy) + dv * (difference_y + u * twist)
        )
