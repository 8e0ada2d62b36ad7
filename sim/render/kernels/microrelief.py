"""Kernels of micro-relief: band-limited height noise finer than the terrain samples, which changes surface normals."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from marsyard.sim.render.kernels.structs import MicroRelief
from marsyard.sim.terrain.kernels import Array

#: Coefficient of the loss of contrast with (footprint / cell)^2, as in `marsyard.sim.render.kernels.photometry`, for
#: slopes with a median frequency of 0.61 cycles per cell: (0.61 pi)^2 / 12.
FADING = 0.306
#: Minimum cell size, in footprints, of an octave of which a pixel resolves a part.
MIN_CELLS = math.sqrt(FADING)
#: Mean squares of `relief_noise` and of its derivative along one axis.
HEIGHT_VARIANCE, SLOPE_VARIANCE = 0.0464, 0.3886
#: Components of the noise's gradients: eight unit vectors, evenly spaced in angle.
_LONG, _SHORT = math.cos(math.pi / 8.0), math.sin(math.pi / 8.0)


@njit(cache=True, inline="always")
def _lattice_gradient(i: int, j: int, seed: int) -> tuple[float, float]:
    """Select one of eight gradients by a hash of the lattice point (finaliser of MurmurHash3)."""
    h = np.uint32(i) * np.uint32(0x8DA6B343)
    h ^= np.uint32(j) * np.uint32(0xD8163841)
    h ^= np.uint32(seed) * np.uint32(0x9E3779B1)
    h ^= h >> np.uint32(16)
    h *= np.uint32(0x85EBCA6B)
    h ^= h >> np.uint32(13)
    h *= np.uint32(0xC2B2AE35)
    h ^= h >> np.uint32(16)
    first = _LONG if h & np.uint32(1) else _SHORT
    second = _SHORT if h & np.uint32(1) else _LONG
    return (-first if h & np.uint32(2) else first), (-second if h & np.uint32(4) else second)


@njit(cache=True, inline="always")
def relief_noise(x: float, y: float, seed: int) -> tuple[float, float, float]:
    """Gradient noise in the plane (Perlin 2002), of mean zero, and its derivatives along x and y."""
    fx, fy = math.floor(x), math.floor(y)
    i, j = int(fx), int(fy)
    x, y = x - fx, y - fy
    u, v = x * x * x * (x * (x * 6.0 - 15.0) + 10.0), y * y * y * (y * (y * 6.0 - 15.0) + 10.0)
    du, dv = 30.0 * x * x * (x - 1.0) * (x - 1.0), 30.0 * y * y * (y - 1.0) * (y - 1.0)
    ax, ay = _lattice_gradient(i, j, seed)
    bx, by = _lattice_gradient(i + 1, j, seed)
    cx, cy = _lattice_gradient(i, j + 1, seed)
    dx, dy = _lattice_gradient(i + 1, j + 1, seed)
    a = ax * x + ay * y
    difference_x = bx * (x - 1.0) + by * y - a
    difference_y = cx * x + cy * (y - 1.0) - a
    twist = dx * (x - 1.0) + dy * (y - 1.0) - a - difference_x - difference_y
    value = a + u * difference_x + v * difference_y + u * v * twist
    d_dx = ax + u * (bx - ax) + v * (cx - ax) + u * v * (ax - bx - cx + dx) + du * (difference_x + v * twist)
    d_dy = ay + u * (by - ay) + v * (cy - ay) + u * v * (ay - by - cy + dy) + dv * (difference_y + u * twist)
    return value, d_dx, d_dy


@njit(cache=True, error_model="numpy")
def add_relief_slopes(
    x: Array,
    y: Array,
    footprint: Array,
    relief: MicroRelief,
    slope_x: Array,
    slope_y: Array,
    resolved: Array,
    unresolved: Array,
) -> None:
    """Compute the slopes of the octaves that are resolved by the pixels, for a roughness of 1.

    An octave fades with the footprint of the pixel (`FADING`). `resolved` and `unresolved` are the variances of the
    slope along one axis: of the part that a pixel resolves, and of the remainder. Pixels without ground have an
    infinite footprint.
    """
    finest = math.inf
    for k in range(footprint.size):
        finest = min(finest, footprint[k])
        slope_x[k] = slope_y[k] = resolved[k] = unresolved[k] = 0.0
    cell, unresolved_variance = relief.coarsest, 0.0
    for octave in range(relief.heights.size):
        gain = relief.heights[octave] / cell
        variance = gain * gain * SLOPE_VARIANCE
        if cell <= MIN_CELLS * finest:
            unresolved_variance += variance
        else:
            for k in range(footprint.size):
                ratio = footprint[k] / cell
                fade = max(1.0 - FADING * ratio * ratio, 0.0)
                fade *= fade
                _value, d_dx, d_dy = relief_noise(x[k] / cell, y[k] / cell, octave)
                slope_x[k] += gain * fade * d_dx
                slope_y[k] += gain * fade * d_dy
                resolved[k] += variance * fade * fade
                unresolved[k] += variance * (1.0 - fade * fade)
        cell *= 0.5
    for k in range(footprint.size):
        unresolved[k] += unresolved_variance


@njit(cache=True, inline="always", error_model="numpy")
def smith_shadowing(cosine: float, variance: float) -> float:
    """Fraction of illuminated facets that the roughness does not shade (Smith 1967, Gaussian slopes).

    `cosine` is that of the incidence angle, `variance` that of the slope along one axis. The rational approximation of
    Walter et al. (2007, section 5.2) is at least 0.996 of the exact value.
    """
    # without branches, for vector instructions; a is infinite without roughness or at normal incidence
    a = min(cosine / math.sqrt(max(2.0 * variance * (1.0 - cosine * cosine), 1e-300)), 1.6)
    remainder = 1.0 - 1.259 * a + 0.396 * a * a
    numerator = 3.535 * a + 2.181 * a * a
    return numerator / (numerator + remainder) if a < 1.6 else 1.0
