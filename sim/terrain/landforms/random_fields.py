"""Random fields on periodic grids: smooth fields with a Gaussian spectrum, and fields with a power-law spectrum."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from jaxtyping import Complex64, Float32, Float64, Inexact
from numpy.random import Generator

from marsyard.sim.terrain.kernels import add_refined
from marsyard.sim.terrain.landforms.ground import SMALLEST_SIDE, Grid, refine

#: Maximum side of the grid of a smooth field, samples; it limits time and memory of the Fourier transform.
MAX_SMOOTH_SIDE = 2048
#: Waves per wavelength of a Gaussian low-pass filter (gain exp(-1/2) at this wavelength) at which its gain is 3e-8.
_NEGLIGIBLE_WAVES = 5.9


def draw_smooth_fields(
    period_m: float, length_across_m: float, length_along_m: float, azimuth_rad: float, rng: Generator
) -> Float32[np.ndarray, "side side 2"]:
    """Draw two independent smooth random fields; the mean of the sum of their squares is 1.

    The amplitude spectrum is Gaussian: it falls to 1/e at the wavenumber sqrt(2)/length. The correlation length differs
    along and across the direction `azimuth_rad`, counter-clockwise from x.
    The spacing is at most the shorter length, unless the grid would exceed `MAX_SMOOTH_SIDE`.
    """
    shortest = min(length_across_m, length_along_m)
    side = SMALLEST_SIDE
    while period_m / side > shortest and side < MAX_SMOOTH_SIDE:
        side *= 2
    wavenumbers = 2.0 * np.pi * np.fft.fftfreq(side, period_m / side)
    kx, ky = wavenumbers[None, :], wavenumbers[:, None]
    k_along = kx * np.cos(azimuth_rad) + ky * np.sin(azimuth_rad)
    k_across = ky * np.cos(azimuth_rad) - kx * np.sin(azimuth_rad)
    amplitude = np.exp(-0.5 * ((k_along * length_along_m) ** 2 + (k_across * length_across_m) ** 2))
    noise = rng.standard_normal((side, side, 2)) @ np.array([1.0, 1.0j])
    field = np.fft.ifft2(noise * amplitude) * side**2 / np.sqrt(2.0 * np.sum(amplitude**2))
    return np.stack([field.real, field.imag], axis=-1).astype(np.float32)


@dataclass(frozen=True)
class Spectrum:
    """Power-law spectrum on a periodic grid, for random fields.

    - amplitude: amplitude of each Fourier mode of the half spectrum (as in `numpy.fft.rfft2`)
    - column_power: sum of the squared modes along y for each wavenumber along x, including conjugate modes
    """

    amplitude: Float32[np.ndarray, "samples half"]
    spacing_m: float
    column_power: Float64[np.ndarray, "half"]

    @classmethod
    def power_law(
        cls,
        samples: int,
        spacing_m: float,
        hurst: float,
        outer_scale_m: float,
        elongation: float = 1.0,
        azimuth_rad: float = 0.0,
    ) -> Spectrum:
        """Create a power spectral density ``(k**2 + k0**2)**-(hurst + 1)`` with k0 the wavenumber of the outer scale.

        Above k0 the field is self-affine with the Hurst exponent; below it is white. Features are `elongation` times as
        long along a direction (counter-clockwise from x) as across it.
        """
        along_y = (2.0 * np.pi * scipy.fft.fftfreq(samples, spacing_m)).astype(np.float32)[:, None]
        along_x = (2.0 * np.pi * scipy.fft.rfftfreq(samples, spacing_m)).astype(np.float32)[None, :]
        stretch = np.float32(np.sqrt(elongation))
        c, s = np.float32(np.cos(azimuth_rad)), np.float32(np.sin(azimuth_rad))
        is_isotropic = elongation == 1.0
        if is_isotropic:
            # modes of opposite wavenumbers along y are equal
            along_y = along_y[: samples // 2 + 1]
            squared = along_x * along_x + along_y * along_y
        else:
            squared = ((c * along_x + s * along_y) * stretch) ** 2 + ((c * along_y - s * along_x) / stretch) ** 2
        squared += np.float32((2.0 * np.pi / outer_scale_m) ** 2)
        amplitude = np.exp(np.float32(-(hurst + 1.0) / 2.0) * np.log(squared))
        if is_isotropic:
            amplitude = np.concatenate([amplitude, amplitude[-2:0:-1]])
        amplitude[0, 0] = 0.0
        return cls(amplitude, spacing_m, _compute_column_power(amplitude))

    def apply_low_pass(self, wavelength_m: float) -> Spectrum:
        """Return the spectrum after a Gaussian low-pass filter that attenuates waves shorter than `wavelength_m`."""
        amplitude = self._filter(self.amplitude, wavelength_m)
        return Spectrum(amplitude, self.spacing_m, _compute_column_power(amplitude))

    def draw_field(self, rng: Generator, scale: float) -> Float32[np.ndarray, "samples samples"]:
        """Draw a Gaussian random field with the expected variance ``scale**2``, by filtered white noise.

        The variance of a single field differs from its expectation. The transform uses one thread, so that the result
        does not depend on the number of threads.
        """
        return self._transform(self._draw_modes(rng), scale)

    def draw_split_field(
        self, rng: Generator, scale: float, wavelength_m: float
    ) -> tuple[Float32[np.ndarray, "samples samples"], Float32[np.ndarray, "samples samples"]]:
        """Draw the field of `draw_field` as the sum of a coarse and a fine field, separated at a wavelength."""
        modes = self._draw_modes(rng)
        # modes with a gain below the rounding of single precision are omitted
        columns = 1 + int(_NEGLIGIBLE_WAVES * len(modes) * self.spacing_m / wavelength_m)
        coarse = self._transform(self._filter(modes[:, :columns], wavelength_m), scale)
        fine = self._transform(modes, scale)
        fine -= coarse
        return coarse, fine

    def _filter(
        self, modes: Inexact[np.ndarray, "samples half"], wavelength_m: float
    ) -> Inexact[np.ndarray, "samples half"]:
        """Apply a Gaussian low-pass filter with the gain exp(-1/2) at a wavelength to modes."""
        samples, columns = modes.shape
        along_y, along_x = (
            (frequencies * wavelength_m).astype(np.float32)
            for frequencies in (
                scipy.fft.fftfreq(samples, self.spacing_m),
                scipy.fft.rfftfreq(samples, self.spacing_m)[:columns],
            )
        )
        filtered = modes * np.exp(np.float32(-0.5) * along_x**2)
        filtered *= np.exp(np.float32(-0.5) * along_y**2)[:, None]
        return np.asarray(filtered)

    def _draw_modes(self, rng: Generator) -> Complex64[np.ndarray, "samples half"]:
        """Draw the Fourier modes of a field: white noise times the amplitude."""
        samples, half = self.amplitude.shape
        noise = rng.standard_normal((samples, half, 2), dtype=np.float32).view(np.complex64)[..., 0]
        noise *= self.amplitude
        # irfft2 uses only the real part of these two columns, which contains half of their power
        noise[:, 0] *= np.float32(np.sqrt(2.0))
        noise[:, -1] *= np.float32(np.sqrt(2.0))
        return noise

    def _transform(
        self, modes: Complex64[np.ndarray, "samples columns"], scale: float
    ) -> Float32[np.ndarray, "samples samples"]:
        """Transform modes to a field with the expected variance ``scale**2``; missing columns are 0."""
        samples = modes.shape[0]
        modes = scipy.fft.ifft(modes, axis=0, workers=1, overwrite_x=True)
        field = scipy.fft.irfft(modes, n=samples, axis=1, workers=1, overwrite_x=True)
        # complex noise has variance 2; irfft2 divides by samples**2
        field *= np.float32(scale * samples**2 / np.sqrt(2.0 * self.column_power.sum()))
        return np.asarray(field)

    def line_slope_rms(self, baseline_m: float) -> float:
        """Compute the expected RMS slope of a field with unit variance along a line, over a baseline.

        ``E[(z(x + L) - z(x))**2] = 2 sum P (1 - cos k L) / sum P``.
        """
        k = 2.0 * np.pi * scipy.fft.rfftfreq(self.amplitude.shape[0], self.spacing_m)
        # 1 - cos(x) = 2 sin(x / 2)**2, without cancellation
        square = np.sum(self.column_power * 4.0 * np.sin(0.5 * k * baseline_m) ** 2) / self.column_power.sum()
        return float(np.sqrt(square) / baseline_m)


@dataclass(frozen=True)
class FractalField:
    """Isotropic power-law field whose finest octave, wavelengths of two to four samples, is white noise.

    The other octaves are drawn on every second sample, and refined, which is faster than a Fourier transform at all
    samples.

    - octaves: spectrum of the field without its finest octave, on every second sample
    - finest_fraction: fraction of the variance in the finest octave
    """

    octaves: Spectrum
    finest_fraction: float

    @classmethod
    def power_law(cls, samples: int, spacing_m: float, hurst: float, outer_scale_m: float) -> FractalField:
        """Create a field with the power spectral density of `Spectrum.power_law`."""
        octaves = Spectrum.power_law(samples // 2, 2.0 * spacing_m, hurst, outer_scale_m)
        # power beyond the wavenumbers of `octaves`, from a grid of 64 x 64 cells of wavenumbers
        k = np.pi / spacing_m * (np.arange(-32, 32) + 0.5) / 32.0
        density = (k[:, None] ** 2 + k**2 + (2.0 * np.pi / outer_scale_m) ** 2) ** -(hurst + 1.0)
        is_finest = np.maximum(np.abs(k[:, None]), np.abs(k)) > 0.5 * np.pi / spacing_m
        finest = density[is_finest].sum() * (samples / 64.0) ** 2
        # A B-spline attenuates each wave by sinc(frequency * spacing)**4, on every second sample more than on all.
        gain_y, gain_x = (
            ((np.sinc(f * spacing_m) / np.sinc(2.0 * f * spacing_m)) ** 4).astype(np.float32)
            for f in (
                scipy.fft.fftfreq(samples // 2, 2.0 * spacing_m),
                scipy.fft.rfftfreq(samples // 2, 2.0 * spacing_m),
            )
        )
        sharpened = octaves.amplitude * gain_x * gain_y[:, None]
        fraction = finest / (finest + octaves.column_power.sum())
        return cls(Spectrum(sharpened, octaves.spacing_m, octaves.column_power), float(fraction))

    def draw_field(self, rng: Generator, scale: float) -> Grid:
        """Draw a random field with the expected variance ``scale**2``."""
        field = self._draw_finest(rng, scale)
        add_refined(field, self.octaves.draw_field(rng, self._octave_scale(scale)))
        return field

    def draw_split_field(self, rng: Generator, scale: float, wavelength_m: float) -> tuple[Grid, Grid]:
        """Draw the field of `draw_field` as the sum of a coarse and a fine field, separated at a wavelength."""
        fine = self._draw_finest(rng, scale)
        coarse, rest = self.octaves.draw_split_field(rng, self._octave_scale(scale), wavelength_m)
        add_refined(fine, rest)
        return refine(coarse, len(fine)), fine

    def line_slope_rms(self, baseline_m: float) -> float:
        """Compute the expected RMS slope of a field with unit variance along a line, over a baseline."""
        # values of the finest octave at the two ends are independent
        octaves = (1.0 - self.finest_fraction) * self.octaves.line_slope_rms(baseline_m) ** 2
        return float(np.sqrt(octaves + 2.0 * self.finest_fraction / baseline_m**2))

    def _octave_scale(self, scale: float) -> float:
        return scale * float(np.sqrt(1.0 - self.finest_fraction))

    def _draw_finest(self, rng: Generator, scale: float) -> Grid:
        """Draw the finest octave: white noise, uniformly distributed."""
        side = 2 * len(self.octaves.amplitude)
        noise = np.frombuffer(rng.bytes(side * side), dtype=np.int8).reshape(side, side)
        # 256 equally probable integers have the variance (256**2 - 1) / 12 and the mean -1 / 2
        deviation = scale * np.sqrt(self.finest_fraction * 12.0 / (256.0**2 - 1.0))
        field = np.multiply(noise, np.float32(deviation), dtype=np.float32)
        field += np.float32(0.5 * deviation)
        return field


def _compute_column_power(amplitude: Float32[np.ndarray, "samples half"]) -> Float64[np.ndarray, "half"]:
    power = np.einsum("ij,ij->j", amplitude, amplitude, dtype=np.float64)
    # each mode of the half spectrum represents two conjugate modes, except in the first and last column
    power[1:-1] *= 2.0
    return np.asarray(power)
