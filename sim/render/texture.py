"""Octaves of noise, which fade with the footprints of the pixels, and the albedo texture that they form.

The texture of ground and objects is finer than the terrain's samples and the triangles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import numpy as np
from jaxtyping import Float as FloatArray

from marsyard.sim.render.arrays import Values, larger, to_device
from marsyard.sim.render.device import Float, Float64, UInt32
from marsyard.sim.render.noise import noise_in_space
from marsyard.sim.terrain.sites import SiteCover
from marsyard.sim.terrain.surface import Surface

#: Mean square of `noise_in_space`.
NOISE_VARIANCE = 0.0732
#: A pixel averages over its area: a wave of f cycles per footprint keeps the fraction sinc(f) of its amplitude. (The
#: detector model applies the blur of the optics.) Noise with cells of c footprints has a median frequency of 0.53
#: cycles per cell, its slopes of 0.61; ``(1 - FADING / c^2)^2`` approximates its sinc to 0.02 down to the Nyquist
#: frequency. FADING is (0.53 pi)^2 / 12, from the series sinc(f) = 1 - (pi f)^2 / 6. Waves above the Nyquist frequency
#: alias, as in a real camera.
FADING, SLOPE_FADING = 0.231, 0.306
#: Cell size, in footprints, at which an octave of texture, or of slopes, vanishes.
MIN_CELLS, MIN_SLOPE_CELLS = math.sqrt(FADING), math.sqrt(SLOPE_FADING)


@dataclass(frozen=True, eq=False)
class Octaves:
    """Octaves of noise: cell size of the coarsest, metres, halved with each octave; amplitudes, coarsest first."""

    coarsest: Values
    amplitudes: Values
    count: Values

    @classmethod
    def of(cls, coarsest_m: float, amplitudes: FloatArray[np.ndarray, "octaves"] | tuple[float, ...]) -> Octaves:
        """Copy octaves to the device."""
        # Dr.Jit cannot gather from an empty array
        padded = np.array([*amplitudes, 0.0])
        return cls(Float64(coarsest_m), to_device(Float, padded), UInt32(len(padded) - 1))


def fade_octave(footprint: Values, cell: Values, fading: float) -> Values:
    """Compute the fraction of an octave's amplitude that remains in the mean over a pixel's footprint."""
    ratio = footprint / Float(cell)
    fade = larger(1.0 - fading * ratio * ratio, 0.0)
    return fade * fade


def log_relative_albedo(
    ground: Octaves, objects: Octaves, on_object: Values, position: Values, footprint: Values, strength: Values
) -> Values:
    """Compute the logarithm of the relative albedo, averaged over the pixels' footprints.

    Each octave fades by the average over the pixel, so that detail appears gradually as a camera approaches the surface
    (`FADING`). Half of each octave's variance is subtracted (mean of a log-normal variable): the mean albedo does not
    depend on the number of visible octaves. Pixels with an infinite footprint have no texture. `strength` is a factor
    of the amplitudes.
    """
    count = dr.select(on_object, objects.count, ground.count)
    min_cell = Float64(MIN_CELLS * footprint)

    def add_octave(octave: Values, cell: Values, total: Values) -> tuple[Values, Values, Values]:
        amplitude = dr.select(
            on_object,
            dr.gather(Float, objects.amplitudes, dr.minimum(octave, objects.count)),
            dr.gather(Float, ground.amplitudes, dr.minimum(octave, ground.count)),
        )
        gain = strength * amplitude * fade_octave(footprint, cell, FADING)
        noise = noise_in_space(list(position), cell, octave)
        return octave + 1, 0.5 * cell, total + gain * noise - 0.5 * NOISE_VARIANCE * gain * gain

    first = dr.select(on_object, objects.coarsest, ground.coarsest)
    return dr.while_loop(
        (UInt32(0), first, Float(0.0)), lambda octave, cell, total: (octave < count) & (cell > min_cell), add_octave
    )[2]


@dataclass(frozen=True, eq=False)
class Cover:
    """Sand over bedrock on the device (`marsyard.sim.terrain.sites.SiteCover`); the border is a logarithm of albedo."""

    border: Values
    contrast: Values
    softness: Values

    @classmethod
    def of(cls, cover: SiteCover, ground: Surface) -> Cover:
        """Copy to the device."""
        border = ground.log_albedo_moments[0] + cover.border
        return cls(Float(border), Float(cover.contrast), Float(cover.softness))

    def brighten(self, log_albedo: Values) -> Values:
        """Compute the increase of the logarithm of the ground's albedo."""
        return self.contrast * (1.0 + dr.tanh((log_albedo - self.border) / self.softness))


@dataclass(frozen=True)
class Texture:
    """Albedo variation finer than the terrain's samples: octaves of three-dimensional noise, evaluated per pixel.

    - coarsest_m: size of the coarsest octave's cells; each further octave is half as large
    - amplitudes: amplitude of each octave in the natural logarithm of albedo, coarsest first
    """

    coarsest_m: float = 1.0
    amplitudes: tuple[float, ...] = ()

    @property
    def octaves(self) -> Octaves:
        """The octaves on the device."""
        return Octaves.of(self.coarsest_m, self.amplitudes)
