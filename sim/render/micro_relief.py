"""Micro-relief: octaves of height noise finer than the terrain's samples, which change the normals of the ground.

A pixel resolves a part of the slopes. The remainder is roughness, whose facets shade each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import drjit as dr
import numpy as np
from jaxtyping import Float as FloatArray
from jaxtyping import Float32
from jaxtyping import Float64 as Float64Array
from scipy.special import gamma, kv

from marsyard.sim.render.arrays import Values, larger, smaller, to_device
from marsyard.sim.render.device import Float, Float64, UInt32
from marsyard.sim.render.noise import noise_in_plane
from marsyard.sim.render.periodic_grid import PeriodicGrid
from marsyard.sim.render.texture import MIN_SLOPE_CELLS, SLOPE_FADING, Octaves, fade_octave
from marsyard.sim.terrain.surface import ROUGHNESS, TEXTURE

#: Mean squares of `noise_in_plane` and of its derivative along one axis.
HEIGHT_VARIANCE, SLOPE_VARIANCE = 0.0464, 0.3886
#: Median frequency of the power of `noise_in_plane`, cycles per cell; size of the finest cells of relief, metres.
WAVES_PER_CELL, FINEST_M = 0.61, 0.001


@dataclass(frozen=True)
class MicroRelief:
    """Octaves of height noise on the ground, and maps of their strength. Without octaves `heights` is empty.

    - coarsest: cell size of the coarsest octave, metres; the cell size is halved with each octave
    - heights: height amplitude of each octave, metres, coarsest first
    - factors: factors of these heights, and of the ground's albedo texture, on a periodic grid: the first two channels
      of `marsyard.sim.terrain.surface.Surface.factors`
    - per_metre: samples of that grid per metre
    """

    coarsest: float
    heights: FloatArray[np.ndarray, "octaves"]
    factors: Float32[np.ndarray, "side side channels"]
    per_metre: float


@dataclass(frozen=True, eq=False)
class RoughGround:
    """Micro-relief on the device.

    - octaves: octaves of the heights
    - variance_from: variance of the slope along one axis of each octave and all finer ones; 0 at the end
    - roughness, texture: factors of the heights, and of the texture's amplitudes
    """

    octaves: Octaves
    variance_from: Values
    roughness: PeriodicGrid
    texture: PeriodicGrid

    @classmethod
    def of(cls, relief: MicroRelief) -> RoughGround | None:
        """Copy micro-relief to the device; None without octaves."""
        if len(relief.heights) == 0:
            return None
        roughness, texture = (PeriodicGrid.of(relief.factors[..., k], relief.per_metre) for k in (ROUGHNESS, TEXTURE))
        gains = relief.heights / (relief.coarsest * 0.5 ** np.arange(len(relief.heights)))
        variance_from = SLOPE_VARIANCE * np.cumsum([0.0, *gains[::-1] ** 2])[::-1]
        octaves = Octaves.of(relief.coarsest, relief.heights)
        return cls(octaves, to_device(Float, variance_from), roughness, texture)


@dataclass(eq=False)
class Slopes:
    """Slopes along x and y of the octaves that a pixel resolves; variances of the slope along one axis.

    `resolved` is the variance of the part that a pixel resolves, `unresolved` that of the remainder.
    """

    x: Values
    y: Values
    resolved: Values
    unresolved: Values


def relief_slopes(ground: RoughGround, position: Values, footprint: Values) -> Slopes:
    """Compute the slopes of micro-relief at positions, for a roughness of 1.

    An octave fades with the footprint of the pixel (`SLOPE_FADING`).
    """
    octaves, min_cell = ground.octaves, Float64(MIN_SLOPE_CELLS * footprint)

    def add_octave(octave: Values, cell: Values, total: Slopes) -> tuple[Values, Values, Slopes]:
        gain = dr.gather(Float, octaves.amplitudes, dr.minimum(octave, octaves.count)) / Float(cell)
        fade, variance = fade_octave(footprint, cell, SLOPE_FADING), gain * gain * SLOPE_VARIANCE
        _, slope_x, slope_y = noise_in_plane(list(position)[:2], cell, octave)
        total = Slopes(
            total.x + gain * fade * slope_x,
            total.y + gain * fade * slope_y,
            total.resolved + variance * fade * fade,
            total.unresolved + variance * (1.0 - fade * fade),
        )
        return octave + 1, 0.5 * cell, total

    octave, _, total = dr.while_loop(
        (UInt32(0), Float64(octaves.coarsest), Slopes(*(Float(0.0) for _ in range(4)))),
        lambda octave, cell, total: (octave < octaves.count) & (cell > min_cell),
        add_octave,
    )
    total.unresolved += dr.gather(Float, ground.variance_from, octave)
    return total


def smith_shadowing(cosine: Values, variance: Values) -> Values:
    """Fraction of illuminated facets that the roughness does not shade (Smith 1967, Gaussian slopes).

    `cosine` is that of the incidence angle, `variance` that of the slope along one axis. The rational approximation of
    Walter et al. (2007, section 5.2) is at least 0.996 of the exact value.
    """
    # a is large without roughness or at normal incidence
    a = smaller(cosine / dr.sqrt(larger(2.0 * variance * (1.0 - cosine * cosine), 1e-30)), 1.6)
    numerator = 3.535 * a + 2.181 * a * a
    return dr.select(a < 1.6, numerator / (numerator + 1.0 - 1.259 * a + 0.396 * a * a), 1.0)


@cache
def octave_heights(
    hurst: float, slope_rad: float, baseline_m: float, outer_scale_m: float, spacing_m: float
) -> tuple[float, Float64Array[np.ndarray, "octaves"]]:
    """Compute the cell size of the coarsest octave and the amplitude of each octave of height noise, metres.

    The ground's power spectral density is ``(k**2 + k0**2)**-(H + 1)`` (`landforms.random_fields.Spectrum`) with the
    Hurst exponent H and the wavenumber k0 of the outer scale. Its correlation function c is Matérn's. Its variance
    follows from the slope over the baseline L: ``(tan(slope) L)**2 = 2 variance (1 - c(L))``. An octave from
    k1 = k / sqrt(2) to k2 = k sqrt(2) around the wavenumber k has the fraction
    ``(1 + (k1 / k0)**2)**-H - (1 + (k2 / k0)**2)**-H`` of this variance.
    """
    k0 = 2.0 * np.pi / outer_scale_m
    scaled_lag = k0 * baseline_m
    correlation = 2.0 ** (1.0 - hurst) / gamma(hurst) * scaled_lag**hurst * kv(hurst, scaled_lag)
    variance = (np.tan(slope_rad) * baseline_m) ** 2 / (2.0 * (1.0 - correlation))
    # the median frequency of the coarsest octave is the Nyquist frequency of the samples
    coarsest = WAVES_PER_CELL * 2.0 * spacing_m
    octaves = max(int(np.log2(coarsest / FINEST_M)) + 1, 0)
    wavenumber = 2.0 * np.pi * WAVES_PER_CELL / (coarsest * 0.5 ** np.arange(octaves))
    fraction_above_k1, fraction_above_k2 = (
        (1.0 + (wavenumber * factor / k0) ** 2) ** -hurst for factor in (np.sqrt(0.5), np.sqrt(2.0))
    )
    heights = np.sqrt(variance * (fraction_above_k1 - fraction_above_k2) / HEIGHT_VARIANCE)
    heights.setflags(write=False)
    return coarsest, heights
