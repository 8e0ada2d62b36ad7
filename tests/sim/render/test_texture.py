"""Tests of albedo texture: octaves finer than the pixel footprint are attenuated, and the mean albedo is unchanged."""

import numpy as np
import pytest
from scipy import ndimage

from marsyard.sim.render.kernels.noise import allocate_noise, noise_3d
from marsyard.sim.render.kernels.photometry import MIN_CELLS, NOISE_VARIANCE, add_texture
from marsyard.sim.render.kernels.strips import STRIP
from marsyard.sim.terrain import sites

POSITIONS = np.random.default_rng(5).uniform(-500.0, 500.0, (60000, 3))


def _log_albedo(positions: np.ndarray, footprint_m: np.ndarray, coarsest_m: float, octaves: np.ndarray) -> np.ndarray:
    """Compute the logarithm of the relative albedo at positions, shape (n, 3).

    The kernel processes a strip of at most `STRIP` positions in one call.
    """
    log_albedo, buffers = np.zeros(len(positions)), allocate_noise()
    for first in range(0, len(positions), STRIP):
        strip = slice(first, first + STRIP)
        x, y, z = positions[strip].T.copy()
        add_texture((x, y, z), footprint_m[strip], (coarsest_m, octaves), np.ones(x.size), buffers, log_albedo[strip])
    return log_albedo


def test_noise_has_the_specified_variance() -> None:
    noise, buffers = np.empty(len(POSITIONS)), allocate_noise()
    for first in range(0, len(POSITIONS), STRIP):
        x, y, z = POSITIONS[first : first + STRIP].T.copy()
        noise_3d(x, y, z, 1.0, 1, buffers)
        noise[first : first + x.size] = buffers.noise[: x.size]
    assert np.mean(noise) == pytest.approx(0.0, abs=0.005)
    assert np.mean(noise**2) == pytest.approx(NOISE_VARIANCE, rel=0.02)


@pytest.mark.parametrize("footprint_m", [1e-4, 3e-3, 0.1])
def test_mean_albedo_is_unchanged_at_any_distance(footprint_m: float) -> None:
    texture = max((site.ground_texture for site in sites().values()), key=lambda texture: max(texture.amplitudes))
    octaves = np.array(texture.amplitudes)
    log_albedo = _log_albedo(POSITIONS, np.full(len(POSITIONS), footprint_m), texture.coarsest_m, octaves)
    assert np.mean(np.exp(log_albedo)) == pytest.approx(1.0, abs=0.005)


def test_detail_finer_than_a_footprint_is_removed() -> None:
    positions, footprint_m = np.tile([0.3, 0.4, 0.1], (3, 1)), np.array([1.001 / MIN_CELLS, 0.2, np.inf])
    log_albedo = _log_albedo(positions, footprint_m, 1.0, np.array([0.2, 0.3]))
    assert log_albedo[0] == 0.0
    assert log_albedo[1] != 0.0
    assert log_albedo[2] == 0.0


@pytest.mark.parametrize("cell_px", [4, 3, 2])
def test_octave_is_attenuated_as_by_averaging_over_a_pixel(cell_px: float) -> None:
    """The RMS on a plane through the noise is that of the average over ten samples per pixel in each direction."""
    samples_per_pixel, side = 10, 400
    rng = np.random.default_rng(7)
    plane_axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    y, x = np.mgrid[:side, :side].reshape(2, -1) / samples_per_pixel / cell_px
    positions = 50.0 + x[:, None] * plane_axes[0] + y[:, None] * plane_axes[1]
    sharp, attenuated = (
        _log_albedo(positions, np.full(len(positions), footprint_m), 1.0, np.array([0.1]))
        for footprint_m in (1e-6, 1.0 / cell_px)
    )
    # The kernel uses the attenuation of the median wavelength of the octave.
    pixel_means = ndimage.uniform_filter(sharp.reshape(side, side), samples_per_pixel, mode="nearest")
    assert np.std(attenuated) / np.std(sharp) == pytest.approx(np.std(pixel_means) / np.std(sharp), abs=0.03)
