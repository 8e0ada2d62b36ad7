"""Named random substreams, and random fields of a power-law spectrum on a periodic grid."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
import scipy.fft
from jaxtyping import Float32, Float64


def substream(rng: np.random.Generator, name: str) -> np.random.Generator:
    """Derive the generator of this name from the seed of `rng`.

    It depends on that seed and the name alone, not on draws or spawns from `rng`, which stays unchanged. Raises
    TypeError for a generator that was not made from a `SeedSequence`.
    """
    seed = rng.bit_generator.seed_seq
    if not isinstance(seed, np.random.SeedSequence):
        raise TypeError(f"a generator seeded by a SeedSequence is needed, not by {type(seed).__name__}")
    digest = hashlib.sha256(name.encode()).digest()
    words = tuple(int.from_bytes(digest[i : i + 4], "little") for i in range(0, 16, 4))
    child = np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, *words), pool_size=seed.pool_size)
    return np.random.Generator(np.random.PCG64(child))


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
        # a mode of the half spectrum counts for itself and its conjugate, except in the first and the last column
        power[1:-1] *= 2.0
        return cls(amplitude, spacing_m, power)

    def field(self, rng: np.random.Generator, scale: float) -> Float32[np.ndarray, "samples samples"]:
        """Draw a Gaussian field of expected variance ``scale**2``: white noise shaped in the frequency domain.

        The variance is normalised by its expectation, so it varies from draw to draw. One thread, so the bytes do not
        depend on the number of threads.
        """
        samples, half = self.amplitude.shape
        noise = rng.standard_normal((samples, half, 2), dtype=np.float32).view(np.complex64)[..., 0]
        noise *= self.amplitude
        # irfft2 keeps the real part only of these two columns: half the power of their modes
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
