"""Surface texture in three dimensions, without detail that a pixel cannot hold."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from marsyard.sim.terrain.kernels import Array

#: Mean square of `gradient_noise` over space.
NOISE_VARIANCE = 0.0732
#: Optics and pixel blur a picture as a Gaussian of half a pixel does: contrast is 0.29 at Nyquist's frequency, as flown
#: cameras have it. Noise whose cells are c footprints wide, of 0.53 waves a cell in the median, keeps
#: ``exp(-2 (0.53 pi 0.5 / c)^2)`` of its amplitude; ``(1 - FADING / c^2)^2`` is that to 0.04 down to 1.25 footprints a
#: cell, less below, where sampling would alias, and ends where it is 0.
FADING = 9.0 / 16.0
#: Footprints a cell at which an octave is gone.
CELLS_LEAST = 0.75


@njit(cache=True)
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


@njit(cache=True)
def _slope(h: np.uint32, x: float, y: float, z: float) -> float:
    """One of Perlin's twelve gradients, four of them twice, by the last four bits of a hash, times an offset.

    Written without a table, and with choices in place of branches: vector instructions choose, but do not branch.
    """
    kind = h & np.uint32(15)
    first = x if kind < np.uint32(8) else y
    second = y if kind < np.uint32(4) else (x if kind & np.uint32(13) == np.uint32(12) else z)
    return (-first if kind & np.uint32(1) else first) + (-second if kind & np.uint32(2) else second)


@njit(cache=True, inline="always")
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


@njit(cache=True, error_model="numpy")
def _add_octave(
    x: Array, y: Array, z: Array, footprint: Array, cell: float, amplitude: float, octave: int, change: Array
) -> None:
    """Adds one octave of `add_texture`."""
    for k in range(x.size):
        ratio = footprint[k] / cell
        share = max(1.0 - FADING * ratio * ratio, 0.0)
        seen = amplitude * (share * share)
        noise = gradient_noise(x[k] / cell, y[k] / cell, z[k] / cell, octave)
        change[k] += seen * noise - 0.5 * NOISE_VARIANCE * seen**2


@njit(cache=True)
def add_texture(
    x: Array, y: Array, z: Array, footprint: Array, coarsest: float, amplitudes: Array, change: Array
) -> None:
    """Adds the natural logarithm of the albedo's relative change at some places, averaged over pixels' footprints.

    Octave n has lattice cells of ``coarsest / 2**n``. It fades out as optics and pixels blur it (`FADING`), as slowly
    as detail comes out when a real camera nears a surface; faster, trackers see the texture change from picture to
    picture. Half of each octave's variance is taken off, so that albedo keeps its mean whatever octaves are seen.

    Parameters
    ----------
    x, y, z
        The places, metres.
    footprint
        Of each place's pixel, metres; infinite where no texture is wanted.
    coarsest, amplitudes
        The coarsest cell, and the amplitudes of octaves.
    change
        Changed in place.
    """
    finest = math.inf
    for k in range(footprint.size):
        finest = min(finest, footprint[k])
    cell = coarsest
    for octave in range(amplitudes.size):
        if cell <= CELLS_LEAST * finest:
            break
        if amplitudes[octave] != 0.0:
            _add_octave(x, y, z, footprint, cell, amplitudes[octave], octave, change)
        cell *= 0.5
