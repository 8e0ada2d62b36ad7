"""Surface texture in three dimensions, without detail that a pixel cannot hold."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from sim.terrain.kernels import Array

#: Mean square of `gradient_noise` over space.
NOISE_VARIANCE = 0.0732


@njit(cache=True, inline="always")
def _mixed(i: int, j: int, k: int, seed: int) -> np.uint32:
    """A hash of a lattice point (the finaliser of MurmurHash3 over a linear combination of its coordinates)."""
    h = np.uint32(i) * np.uint32(0x8DA6B343)
    h ^= np.uint32(j) * np.uint32(0xD8163841)
    h ^= np.uint32(k) * np.uint32(0xCB1AB31F)
    h ^= np.uint32(seed) * np.uint32(0x9E3779B1)
    h ^= h >> np.uint32(16)
    h *= np.uint32(0x85EBCA6B)
    h ^= h >> np.uint32(13)
    h *= np.uint32(0xC2B2AE35)
    h ^= h >> np.uint32(16)
    return h


#: Perlin's twelve gradients, four of them twice, by the last four bits of a hash.
GRADIENTS = np.array(
    [
        [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0],
        [1.0, 0.0, 1.0], [-1.0, 0.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 0.0, -1.0],
        [0.0, 1.0, 1.0], [0.0, -1.0, 1.0], [0.0, 1.0, -1.0], [0.0, -1.0, -1.0],
        [1.0, 1.0, 0.0], [0.0, -1.0, 1.0], [-1.0, 1.0, 0.0], [0.0, -1.0, -1.0],
    ]
)  # fmt: skip


@njit(cache=True, inline="always")
def _slope(h: np.uint32, x: float, y: float, z: float) -> float:
    """The gradient of a hash times an offset. A table: which gradient comes next, no processor can predict."""
    kind = h & np.uint32(15)
    slope: float = GRADIENTS[kind, 0] * x + GRADIENTS[kind, 1] * y + GRADIENTS[kind, 2] * z
    return slope


@njit(cache=True)
def gradient_noise(x: float, y: float, z: float, seed: int) -> float:
    """Perlin's improved noise (2002): smooth, of mean zero, with waves of about one to two units."""
    fx = math.floor(x)
    fy = math.floor(y)
    fz = math.floor(z)
    i = int(fx)
    j = int(fy)
    k = int(fz)
    x -= fx
    y -= fy
    z -= fz
    u = x * x * x * (x * (x * 6.0 - 15.0) + 10.0)
    v = y * y * y * (y * (y * 6.0 - 15.0) + 10.0)
    w = z * z * z * (z * (z * 6.0 - 15.0) + 10.0)
    near = (1.0 - v) * (
        (1.0 - u) * _slope(_mixed(i, j, k, seed), x, y, z) + u * _slope(_mixed(i + 1, j, k, seed), x - 1.0, y, z)
    ) + v * (
        (1.0 - u) * _slope(_mixed(i, j + 1, k, seed), x, y - 1.0, z)
        + u * _slope(_mixed(i + 1, j + 1, k, seed), x - 1.0, y - 1.0, z)
    )
    far = (1.0 - v) * (
        (1.0 - u) * _slope(_mixed(i, j, k + 1, seed), x, y, z - 1.0)
        + u * _slope(_mixed(i + 1, j, k + 1, seed), x - 1.0, y, z - 1.0)
    ) + v * (
        (1.0 - u) * _slope(_mixed(i, j + 1, k + 1, seed), x, y - 1.0, z - 1.0)
        + u * _slope(_mixed(i + 1, j + 1, k + 1, seed), x - 1.0, y - 1.0, z - 1.0)
    )
    noise: float = (1.0 - w) * near + w * far
    return noise


@njit(cache=True)
def texture(x: float, y: float, z: float, footprint: float, coarsest: float, amplitudes: Array) -> float:
    """Natural logarithm of the albedo's relative change at a place, averaged over a pixel's footprint.

    Octave n has lattice cells of ``coarsest / 2**n``. It fades out between four and two footprints a cell: finer, it
    would alias. Half of each octave's variance is taken off, so that albedo keeps its mean whatever octaves are seen.
    """
    total = 0.0
    cell = coarsest
    for n in range(amplitudes.size):
        share = (cell / footprint - 2.0) * 0.5
        if share <= 0.0:
            break
        if amplitudes[n] != 0.0:
            share = min(share, 1.0)
            weight = share * share * (3.0 - 2.0 * share)
            amplitude = amplitudes[n] * weight
            total += amplitude * gradient_noise(x / cell, y / cell, z / cell, n) - 0.5 * NOISE_VARIANCE * amplitude**2
        cell *= 0.5
    return total
