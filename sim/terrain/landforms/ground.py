"""Work grids of a terrain that is being synthesised, named random substreams, and random fields on periodic grids."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from jaxtyping import Complex64, Float32, Float64
from numpy.random import Generator

from marsyard.sim.streams import hash_words
from marsyard.sim.terrain.landforms.kernels import add_refined

SMALLEST_SIDE = 16  #: Smallest side of a grid on which a landform is made.
Grid = Float32[np.ndarray, "side side"]


@dataclass(frozen=True)
class Ground:
    """Heights and tones of a terrain, which landforms change in place.

    - height: control values, metres
    - tone: natural logarithm of albedo over its mean
    """

    height: Grid
    tone: Grid
    spacing_m: float

    @property
    def side(self) -> int:
        """Samples along each side."""
        return int(self.height.shape[0])

    @property
    def period_m(self) -> float:
        """Distance after which the ground repeats."""
        return float(self.side * self.spacing_m)

    def coarser(self, feature_m: float) -> Ground:
        """Return an empty ground of the same extent with samples at most `feature_m` apart, but not denser than these.

        A landform without finer detail costs less there; `add` brings it back.
        """
        side = self.side
        while side > SMALLEST_SIDE and self.period_m / (side // 2) <= feature_m:
            side //= 2
        height, tone = np.zeros((2, side, side), dtype=np.float32)
        return Ground(height, tone, self.period_m / side)

    def add(self, part: Ground, *, tone: bool = True) -> None:
        """Add a ground made on a coarser grid; the sum of the surfaces is exact, as refining a B-spline is."""
        for total, grid in ((self.height, part.height), (self.tone, part.tone))[: 1 + tone]:
            if grid.shape == total.shape:
                total += grid
            else:
                add_refined(total, refine(grid, total.shape[0] // 2))


def refine(coarse: Float32[np.ndarray, "coarse coarse"], side: int) -> Float32[np.ndarray, "side side"]:
    """Return control values of the same surface on a grid of this side: the coarse one's times a power of two."""
    while coarse.shape[0] < side:
        doubled = np.zeros((2 * coarse.shape[0], 2 * coarse.shape[0]), dtype=np.float32)
        add_refined(doubled, np.ascontiguousarray(coarse))
        coarse = doubled
    return coarse


def resample(field: Float32[np.ndarray, "own own"], side: int) -> Float32[np.ndarray, "side side"]:
    """Return a smooth field on a grid of this side: refined, or decimated."""
    step = max(field.shape[0] // side, 1)
    return refine(np.ascontiguousarray(field[::step, ::step]), side)


def draw_smooth_fields(
    period_m: float, length_across_m: float, length_along_m: float, azimuth_rad: float, rng: Generator
) -> Float32[np.ndarray, "side side 2"]:
    """Draw two independent smooth random fields whose squares sum to a unit mean: control values on their own grid.

    The spectrum is Gaussian with correlation lengths (1/e of the amplitude spectrum at wavenumber sqrt(2)/length)
    across and along a direction (azimuth of "along", counter-clockwise from x).
    """
    shortest = min(length_across_m, length_along_m)
    side = SMALLEST_SIDE
    while period_m / side > shortest and side < 2048:
        side *= 2
    wave = 2.0 * np.pi * np.fft.fftfreq(side, period_m / side)
    kx, ky = wave[None, :], wave[:, None]
    along = kx * np.cos(azimuth_rad) + ky * np.sin(azimuth_rad)
    across = ky * np.cos(azimuth_rad) - kx * np.sin(azimuth_rad)
    amplitude = np.exp(-0.5 * ((along * length_along_m) ** 2 + (across * length_across_m) ** 2))
    noise = rng.standard_normal((side, side, 2)) @ np.array([1.0, 1.0j])
    field = np.fft.ifft2(noise * amplitude) * side**2 / np.sqrt(2.0 * np.sum(amplitude**2))
    return np.stack([field.real, field.imag], axis=-1).astype(np.float32)


def substream(rng: Generator, name: str) -> Generator:
    """Derive the generator of this name from the seed of `rng`.

    It depends on that seed and the name alone, not on draws or spawns from `rng`, which stays unchanged. Raises
    TypeError for a generator that was not made from a `SeedSequence`.
    """
    seed = rng.bit_generator.seed_seq
    if not isinstance(seed, np.random.SeedSequence):
        raise TypeError(f"a generator seeded by a SeedSequence is needed, not by {type(seed).__name__}")
    key = (*seed.spawn_key, *hash_words(name))
    child = np.random.SeedSequence(seed.entropy, spawn_key=key, pool_size=seed.pool_size)
    return Generator(np.random.PCG64(child))


@dataclass(frozen=True)
class Spectrum:
    """A power-law spectrum on a periodic grid, from which random fields of unit expected variance are drawn.

    `amplitude` holds the modes of the half spectrum; `column_power` is the sum of their squares along y for each
    wavenumber along x, conjugate modes included.
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
        """Power spectral density ``(k**2 + k0**2)**-(hurst + 1)`` with k0 the wavenumber of the outer scale.

        Above k0 the field is self-affine with the Hurst exponent; below it is white. Features are `elongation` times as
        long along a direction (counter-clockwise from x) as across it.
        """
        along_y = (2.0 * np.pi * scipy.fft.fftfreq(samples, spacing_m)).astype(np.float32)[:, None]
        along_x = (2.0 * np.pi * scipy.fft.rfftfreq(samples, spacing_m)).astype(np.float32)[None, :]
        stretch = np.float32(np.sqrt(elongation))
        c, s = np.float32(np.cos(azimuth_rad)), np.float32(np.sin(azimuth_rad))
        squared = ((c * along_x + s * along_y) * stretch) ** 2 + ((c * along_y - s * along_x) / stretch) ** 2
        squared += np.float32((2.0 * np.pi / outer_scale_m) ** 2)
        amplitude = np.exp(np.float32(-(hurst + 1.0) / 2.0) * np.log(squared))
        amplitude[0, 0] = 0.0
        return cls(amplitude, spacing_m, _column_power(amplitude))

    def low_passed(self, wavelength_m: float) -> Spectrum:
        """Return this spectrum without waves shorter than about this length: a Gaussian filter."""
        amplitude = self.amplitude * _low_pass(self.amplitude.shape[0], self.spacing_m, wavelength_m)
        return Spectrum(amplitude, self.spacing_m, _column_power(amplitude))

    def field(self, rng: Generator, scale: float) -> Float32[np.ndarray, "samples samples"]:
        """Draw a Gaussian field of expected variance ``scale**2``: white noise shaped in the frequency domain.

        The variance is normalised by its expectation, so it varies from draw to draw. One thread, so the bytes do not
        depend on the number of threads.
        """
        return self._transform(self._modes(rng), scale)

    def split_field(
        self, rng: Generator, scale: float, wavelength_m: float
    ) -> tuple[Float32[np.ndarray, "samples samples"], Float32[np.ndarray, "samples samples"]]:
        """Draw the same field as `field`, as the sum of a coarse and a fine part, divided at a wavelength."""
        modes = self._modes(rng)
        coarse = self._transform(modes * _low_pass(self.amplitude.shape[0], self.spacing_m, wavelength_m), scale)
        fine = self._transform(modes, scale)
        fine -= coarse
        return coarse, fine

    def _modes(self, rng: Generator) -> Complex64[np.ndarray, "samples half"]:
        samples, half = self.amplitude.shape
        noise = rng.standard_normal((samples, half, 2), dtype=np.float32).view(np.complex64)[..., 0]
        noise *= self.amplitude
        # irfft2 keeps the real part only of these two columns: half the power of their modes
        noise[:, 0] *= np.float32(np.sqrt(2.0))
        noise[:, -1] *= np.float32(np.sqrt(2.0))
        return noise

    def _transform(
        self, modes: Complex64[np.ndarray, "samples half"], scale: float
    ) -> Float32[np.ndarray, "samples samples"]:
        samples = modes.shape[0]
        field = scipy.fft.irfft2(modes, s=(samples, samples), workers=1, overwrite_x=True)
        # complex noise has variance 2; irfft2 divides by samples**2
        field *= np.float32(scale * samples**2 / np.sqrt(2.0 * self.column_power.sum()))
        return np.asarray(field)

    def line_slope_rms(self, baseline_m: float) -> float:
        """Expected RMS slope over a baseline along a line of a unit-variance field.

        ``E[(z(x + L) - z(x))**2] = 2 sum P (1 - cos k L) / sum P``.
        """
        k = 2.0 * np.pi * scipy.fft.rfftfreq(self.amplitude.shape[0], self.spacing_m)
        # 1 - cos without cancellation
        square = np.sum(self.column_power * 4.0 * np.sin(0.5 * k * baseline_m) ** 2) / self.column_power.sum()
        return float(np.sqrt(square) / baseline_m)


def _column_power(amplitude: Float32[np.ndarray, "samples half"]) -> Float64[np.ndarray, "half"]:
    power = np.einsum("ij,ij->j", amplitude, amplitude, dtype=np.float64)
    # a mode of the half spectrum counts for itself and its conjugate, except in the first and the last column
    power[1:-1] *= 2.0
    return np.asarray(power)


def _low_pass(samples: int, spacing_m: float, wavelength_m: float) -> Float32[np.ndarray, "samples half"]:
    """Gaussian filter that keeps exp(-1/2) of the amplitude at a wavelength."""
    along_y = scipy.fft.fftfreq(samples, spacing_m).astype(np.float32) * np.float32(wavelength_m)
    along_x = scipy.fft.rfftfreq(samples, spacing_m).astype(np.float32) * np.float32(wavelength_m)
    exponent = np.float32(-0.5) * (along_y[:, None] ** 2 + along_x[None, :] ** 2)
    return np.asarray(np.exp(exponent))
