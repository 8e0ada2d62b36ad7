"""The work grids of a terrain that is being synthesised."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from marsyard.sim.terrain.landforms.kernels import add_refined

#: Smallest side of a grid on which a landform is made.
SMALLEST_SIDE = 16


@dataclass(frozen=True)
class Ground:
    """Heights and tones of a terrain, which landforms change in place.

    - height: control values, metres
    - tone: natural logarithm of albedo over its mean
    """

    height: Float32[np.ndarray, "side side"]
    tone: Float32[np.ndarray, "side side"]
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
                add_refined(total, refined(grid, total.shape[0] // 2))


def refined(coarse: Float32[np.ndarray, "coarse coarse"], side: int) -> Float32[np.ndarray, "side side"]:
    """Control values of the same surface on a grid of this side: the coarse one's times a power of two."""
    while coarse.shape[0] < side:
        doubled = np.zeros((2 * coarse.shape[0], 2 * coarse.shape[0]), dtype=np.float32)
        add_refined(doubled, np.ascontiguousarray(coarse))
        coarse = doubled
    return coarse


def resampled(field: Float32[np.ndarray, "own own"], side: int) -> Float32[np.ndarray, "side side"]:
    """A smooth field on a grid of this side: refined, or decimated."""
    step = max(field.shape[0] // side, 1)
    return refined(np.ascontiguousarray(field[::step, ::step]), side)


def smooth_pair(
    period_m: float, length_across_m: float, length_along_m: float, azimuth_rad: float, rng: np.random.Generator
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
