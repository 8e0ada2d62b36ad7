"""Terrain from a seed: a fractal ground with impact craters and albedo variation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import scipy.fft
from jaxtyping import Float32, Float64
from pydantic import BaseModel, ConfigDict, Field

from sim.terrain.kernels import stamp_craters
from sim.terrain.surface import ALBEDO, HEIGHT, Surface

Positive = Annotated[float, Field(gt=0.0)]


class TerrainParameters(BaseModel):
    """What a synthetic terrain depends on, besides its seed. Lengths in metres."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    samples: Annotated[int, Field(ge=64, le=8192, description="samples along each side, a power of two")] = 4096
    spacing_m: Annotated[float, Field(gt=0.0, le=100.0, description="distance between samples, m")] = 1.5
    hurst: Annotated[float, Field(gt=0.0, lt=1.0, description="Hurst exponent of the heights")] = 0.8
    rms_slope_deg: Annotated[
        float, Field(ge=0.0, le=30.0, description="RMS slope along a line over the slope baseline, deg")
    ] = 2.0
    slope_baseline_m: Annotated[Positive, Field(description="baseline of the RMS slope, m")] = 30.0
    outer_scale_m: Annotated[Positive, Field(description="wavelength above which relief stops growing, m")] = 3000.0
    craters_per_km2: Annotated[
        float, Field(ge=0.0, le=2000.0, description="craters per square kilometre above the smallest diameter")
    ] = 60.0
    crater_exponent: Annotated[Positive, Field(description="exponent of the cumulative size-frequency power law")] = 2.0
    crater_diameter_min_m: Annotated[Positive, Field(description="smallest crater diameter, m")] = 12.0
    crater_diameter_max_m: Annotated[Positive, Field(description="largest crater diameter, m")] = 600.0
    albedo: Annotated[float, Field(gt=0.0, lt=1.0, description="mean albedo")] = 0.2
    albedo_contrast: Annotated[
        float, Field(ge=0.0, le=1.0, description="RMS of the logarithm of albedo over all scales")
    ] = 0.12
    albedo_hurst: Annotated[
        float,
        Field(ge=-0.5, lt=1.0, description="Hurst exponent of the albedo; 0: equal contrast in each octave"),
    ] = 0.0


#: Rim height as a share of the depth below the surrounding ground: simple craters have about 0.04 D of rim at
#: depth/diameter 0.2 from the rim crest (Pike 1977), so 0.04 / 0.16.
RIM_FRACTION = 0.25
EJECTA_REACH_RADII = 3.0
#: Depth below the surroundings over diameter, from degraded to fresh (rim to floor about 0.05 to 0.2).
DEPTH_OVER_DIAMETER = (0.04, 0.16)
#: Height over which the rim of a fresh and of a degraded crater is rounded, as a share of its depth.
SHARPEST_RIM, ROUNDEST_RIM = 0.2, 1.0


def synthesise(parameters: TerrainParameters, rng: np.random.Generator) -> Surface:
    """The terrain of these parameters drawn from this stream; the same stream gives the same bytes."""
    height_rng, crater_rng, albedo_rng = rng.spawn(3)
    heights = _relief(parameters, height_rng)
    stamp_craters(heights, parameters.spacing_m, draw_craters(parameters, crater_rng), RIM_FRACTION, EJECTA_REACH_RADII)
    samples = np.empty((parameters.samples, parameters.samples, 2), dtype=np.float32)
    samples[..., HEIGHT] = heights
    samples[..., ALBEDO] = _albedo(parameters, albedo_rng)
    return Surface.from_samples(samples, parameters.spacing_m)


def draw_craters(parameters: TerrainParameters, rng: np.random.Generator) -> Float64[np.ndarray, "craters 5"]:
    """Craters with rows (x, y, radius, depth, softness), metres and a share, the largest first.

    Their number is Poisson; diameters follow the truncated power law ``N(>D) ~ D**-exponent``; depth over
    diameter is uniform between degraded and fresh, and the rim the rounder the more degraded the crater.
    """
    smallest, largest = parameters.crater_diameter_min_m, parameters.crater_diameter_max_m
    if largest <= smallest:
        raise ValueError(
            f"crater_diameter_max_m is {largest:g}; it must be larger than crater_diameter_min_m, {smallest:g}"
        )
    period = parameters.samples * parameters.spacing_m
    count = int(rng.poisson(parameters.craters_per_km2 * (period / 1000.0) ** 2))
    exponent = parameters.crater_exponent
    share_above = rng.uniform((largest / smallest) ** -exponent, 1.0, count)
    diameter = np.sort(smallest * share_above ** (-1.0 / exponent))[::-1]
    freshness = rng.uniform(0.0, 1.0, count)
    degraded, fresh = DEPTH_OVER_DIAMETER
    depth = diameter * (degraded + (fresh - degraded) * freshness)
    softness = ROUNDEST_RIM * (1.0 - freshness) + SHARPEST_RIM * freshness
    place = rng.uniform(0.0, period, (count, 2))
    return np.column_stack([place, diameter / 2.0, depth, softness])


def _relief(parameters: TerrainParameters, rng: np.random.Generator) -> Float32[np.ndarray, "rows columns"]:
    spectrum = Spectrum.power_law(parameters.samples, parameters.spacing_m, parameters.hurst, parameters.outer_scale_m)
    wanted = np.tan(np.radians(parameters.rms_slope_deg))
    return spectrum.field(rng, scale=wanted / spectrum.line_slope_rms(parameters.slope_baseline_m))


def _albedo(parameters: TerrainParameters, rng: np.random.Generator) -> Float32[np.ndarray, "rows columns"]:
    """Log-normal albedo whose mean is the stated one."""
    contrast = parameters.albedo_contrast
    spectrum = Spectrum.power_law(
        parameters.samples, parameters.spacing_m, parameters.albedo_hurst, parameters.outer_scale_m
    )
    field = spectrum.field(rng, scale=contrast)
    np.exp(field, out=field)
    field *= np.float32(parameters.albedo * np.exp(-0.5 * contrast**2))
    np.minimum(field, np.float32(1.0), out=field)
    return field


@dataclass(frozen=True)
class Spectrum:
    """A power-law spectrum on a periodic grid, from which random fields of unit expected variance are drawn.

    Attributes
    ----------
    amplitude
        Amplitude of each mode of the half spectrum, shape (samples, samples // 2 + 1).
    spacing_m
        Distance between the grid's samples.
    column_power
        Sum of the squared amplitudes along y for each wavenumber along x, counting the conjugate modes.
    """

    amplitude: Float32[np.ndarray, "samples half"]
    spacing_m: float
    column_power: Float64[np.ndarray, "half"]

    @classmethod
    def power_law(cls, samples: int, spacing_m: float, hurst: float, outer_scale_m: float) -> Spectrum:
        """Power spectral density ``(k**2 + k0**2)**-(hurst + 1)`` with k0 the wavenumber of the outer scale.

        Above k0 the field is self-affine with the Hurst exponent; below it is white.
        """
        along_y = (2.0 * np.pi * scipy.fft.fftfreq(samples, spacing_m)).astype(np.float32)
        along_x = (2.0 * np.pi * scipy.fft.rfftfreq(samples, spacing_m)).astype(np.float32)
        squared = along_y[:, None] ** 2 + along_x[None, :] ** 2 + np.float32((2.0 * np.pi / outer_scale_m) ** 2)
        amplitude = np.exp(np.float32(-(hurst + 1.0) / 2.0) * np.log(squared))
        amplitude[0, 0] = 0.0
        power = np.einsum("ij,ij->j", amplitude, amplitude, dtype=np.float64)
        # A mode of the half spectrum stands for itself and its conjugate, except in the first and the last column.
        power[1:-1] *= 2.0
        return cls(amplitude, spacing_m, power)

    def field(self, rng: np.random.Generator, scale: float) -> Float32[np.ndarray, "samples samples"]:
        """A Gaussian field whose expected variance is ``scale**2``.

        White noise in the frequency domain is shaped and transformed; the variance is normalised by its expectation, so
        that terrains differ as draws do. One thread, so that the bytes do not depend on how many there are.
        """
        samples, half = self.amplitude.shape
        noise = rng.standard_normal((samples, half, 2), dtype=np.float32).view(np.complex64)[..., 0]
        noise *= self.amplitude
        # irfft2 keeps only the real part of what these two columns give: half the power of their modes
        noise[:, 0] *= np.float32(np.sqrt(2.0))
        noise[:, -1] *= np.float32(np.sqrt(2.0))
        field: Float32[np.ndarray, "samples samples"] = scipy.fft.irfft2(
            noise, s=(samples, samples), workers=1, overwrite_x=True
        )
        # complex noise has variance 2; irfft2 divides by samples**2
        field *= np.float32(scale * samples**2 / np.sqrt(2.0 * self.column_power.sum()))
        return field

    def line_slope_rms(self, baseline_m: float) -> float:
        """Expected RMS slope over a baseline along a line of a unit-variance field.

        ``E[(z(x + L) - z(x))**2] = 2 sum P (1 - cos k L) / sum P``.
        """
        k = 2.0 * np.pi * scipy.fft.rfftfreq(self.amplitude.shape[0], self.spacing_m)
        # 1 - cos without cancellation
        square = np.sum(self.column_power * 4.0 * np.sin(0.5 * k * baseline_m) ** 2) / self.column_power.sum()
        return float(np.sqrt(square) / baseline_m)
