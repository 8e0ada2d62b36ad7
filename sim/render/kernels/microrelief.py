"""Kernels of micro-relief: band-limited height noise finer than the terrain samples, which changes surface normals."""

from __future__ import annotations

import math

from numba import njit

from marsyard.sim.render.kernels.noise import NoiseBuffers, noise_2d
from marsyard.sim.render.kernels.strips import ROW, STRIP
from marsyard.sim.render.kernels.structs import Array32, MicroRelief
from marsyard.sim.render.kernels.sun import find_grid_cell
from marsyard.sim.terrain.kernels import Array

#: Coefficient of the loss of contrast with (footprint / cell)^2, as in `marsyard.sim.render.kernels.photometry`, for
#: slopes with a median frequency of 0.61 cycles per cell: (0.61 pi)^2 / 12.
FADING = 0.306
#: Minimum cell size, in footprints, of an octave of which a pixel resolves a part.
MIN_CELLS = math.sqrt(FADING)
#: Mean squares of `noise_2d` and of its derivative along one axis.
HEIGHT_VARIANCE, SLOPE_VARIANCE = 0.0464, 0.3886


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def add_relief_slopes(
    x: Array,
    y: Array,
    footprint: Array,
    relief: MicroRelief,
    buffers: NoiseBuffers,
    slope_x: Array,
    slope_y: Array,
    resolved: Array,
    unresolved: Array,
) -> None:
    """Compute the slopes of the octaves that up to `STRIP` pixels resolve, for a roughness of 1.

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
            noise_2d(x, y, cell, octave, buffers)
            _add_octave(buffers.noise, footprint, cell, gain, slope_x, slope_y, resolved, unresolved)
        cell *= 0.5
    for k in range(footprint.size):
        unresolved[k] += unresolved_variance


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _add_octave(
    noise: Array32,
    footprint: Array,
    cell: float,
    gain: float,
    slope_x: Array,
    slope_y: Array,
    resolved: Array,
    unresolved: Array,
) -> None:
    """Add one octave of `add_relief_slopes`."""
    variance = gain * gain * SLOPE_VARIANCE
    for k in range(min(footprint.size, STRIP)):
        ratio = footprint[k] / cell
        fade = max(1.0 - FADING * ratio * ratio, 0.0)
        fade *= fade
        slope_x[k] += gain * fade * noise[ROW + k]
        slope_y[k] += gain * fade * noise[2 * ROW + k]
        resolved[k] += variance * fade * fade
        unresolved[k] += variance * (1.0 - fade * fade)


@njit(cache=True, inline="always", error_model="numpy")
def interpolate_factors(relief: MicroRelief, x: float, y: float) -> tuple[float, float]:
    """Interpolate the factors of relief and texture bilinearly at a position."""
    factors = relief.factors
    (i0, i1), (j0, j1), fx, fy = find_grid_cell(factors.shape[0], relief.per_metre, x, y)
    south_roughness = (1.0 - fx) * factors[i0, j0, 0] + fx * factors[i0, j1, 0]
    north_roughness = (1.0 - fx) * factors[i1, j0, 0] + fx * factors[i1, j1, 0]
    south_texture = (1.0 - fx) * factors[i0, j0, 1] + fx * factors[i0, j1, 1]
    north_texture = (1.0 - fx) * factors[i1, j0, 1] + fx * factors[i1, j1, 1]
    return (1.0 - fy) * south_roughness + fy * north_roughness, (1.0 - fy) * south_texture + fy * north_texture


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
