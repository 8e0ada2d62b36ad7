"""Tests of albedo texture: octaves finer than the pixel footprint are attenuated, and the mean albedo is unchanged."""

import numpy as np
import pytest
from scipy import ndimage

from marsyard.sim.render.kernels.photometry import MIN_CELLS, NOISE_VARIANCE, add_texture, gradient_noise
from marsyard.sim.terrain import sites

ONES = np.ones(60000)
POSITIONS = np.random.default_rng(5).uniform(-500.0, 500.0, (60000, 3))


def test_noise_has_the_specified_variance() -> None:
    noise = np.array([gradient_noise(x, y, z, 1) for x, y, z in POSITIONS])
    assert np.mean(noise**2) == pytest.approx(NOISE_VARIANCE, rel=0.02)


@pytest.mark.parametrize("footprint_m", [1e-4, 3e-3, 0.1])
def test_mean_albedo_is_unchanged_at_any_distance(footprint_m: float) -> None:
    texture = max((site.ground_texture for site in sites().values()), key=lambda texture: max(texture.amplitudes))
    octaves = np.array(texture.amplitudes)
    log_albedo = np.zeros(len(POSITIONS))
    add_texture(
        *POSITIONS.T.copy(), np.full(len(POSITIONS), footprint_m), texture.coarsest_m, octaves, ONES, log_albedo
    )
    assert np.mean(np.exp(log_albedo)) == pytest.approx(1.0, abs=0.005)


def test_detail_finer_than_a_footprint_is_removed() -> None:
    octaves = np.array([0.2, 0.3])
    log_albedo = np.zeros(3)
    position = np.array([[0.3], [0.4], [0.1]]) @ np.ones((1, 3))
    add_texture(*position, np.array([1.001 / MIN_CELLS, 0.2, np.inf]), 1.0, octaves, np.ones(3), log_albedo)
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
    sharp, attenuated, strength = np.zeros(len(positions)), np.zeros(len(positions)), np.ones(len(positions))
    add_texture(*positions.T.copy(), np.full(len(positions), 1e-6), 1.0, np.array([0.1]), strength, sharp)
    add_texture(*positions.T.copy(), np.full(len(positions), 1.0 / cell_px), 1.0, np.array([0.1]), strength, attenuated)
    # The kernel uses the attenuation of the median wavelength of the octave.
    pixel_means = ndimage.uniform_filter(sharp.reshape(side, side), samples_per_pixel, mode="nearest")
    assert np.std(attenuated) / np.std(sharp) == pytest.approx(np.std(pixel_means) / np.std(sharp), abs=0.03)
