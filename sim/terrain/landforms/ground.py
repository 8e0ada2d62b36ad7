"""The grid that the landforms build on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from marsyard.sim.parameters import Parameters
from marsyard.sim.terrain.landforms.kernels import add_refined

#: Smallest side of a grid on which a landform is made.
SMALLEST_SIDE = 16


class LandformParameters(Parameters):
    """What all landforms' parameters have in common."""


@dataclass(frozen=True)
class Ground:
    """Work grids of a terrain that is being made; landforms change them in place.

    Attributes
    ----------
    height
        Control values of the heights, metres.
    tone
        Natural logarithm of albedo over its mean.
    spacing_m
        Distance between samples.
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
        """The distance after which the ground repeats."""
        return float(self.side * self.spacing_m)

    def coarser(self, feature_m: float) -> Ground:
        """An empty ground of the same extent whose samples are at most `feature_m` apart, but not denser than these.

        What is made on it is brought back by `add`; a landform without details so fine costs less there.
        """
        side = self.side
        while side > SMALLEST_SIDE and self.period_m / (side // 2) <= feature_m:
            side //= 2
        return Ground(
            np.zeros((side, side), dtype=np.float32), np.zeros((side, side), dtype=np.float32), self.period_m / side
        )

    def add(self, part: Ground, *, tone: bool = True) -> None:
        """Adds a ground made on a coarser grid; the surfaces add up exactly, for a B-spline refines exactly."""
        _add(self.height, part.height)
        if tone:
            _add(self.tone, part.tone)


def finer(coarse: Float32[np.ndarray, "coarse coarse"], side: int) -> Float32[np.ndarray, "side side"]:
    """Control values of the same surface on a grid of this side, which is the coarse one's times a power of two."""
    while coarse.shape[0] < side:
        doubled = np.zeros((2 * coarse.shape[0], 2 * coarse.shape[0]), dtype=np.float32)
        add_refined(doubled, np.ascontiguousarray(coarse))
        coarse = doubled
    return coarse


def fitted(field: Float32[np.ndarray, "own own"], side: int) -> Float32[np.ndarray, "side side"]:
    """A smooth field on a grid of this side: refined, or thinned."""
    step = max(field.shape[0] // side, 1)
    return finer(np.ascontiguousarray(field[::step, ::step]), side)


def _add(total: Float32[np.ndarray, "side side"], part: Float32[np.ndarray, "coarse coarse"]) -> None:
    if part.shape == total.shape:
        total += part
    else:
        add_refined(total, finer(part, total.shape[0] // 2))


def smooth_pair(
    period_m: float, length_across_m: float, length_along_m: float, azimuth_rad: float, rng: np.random.Generator
) -> Float32[np.ndarray, "side side 2"]:
    """Two independent smooth random fields of unit mean square together: control values on a grid of their own.

    Their spectrum is Gaussian with correlation lengths (1/e of the amplitude spectrum at wavenumber sqrt(2)/length)
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
