"""Texture that gives out octave by octave: it changes no mean, and does not alias."""

import numpy as np
import pytest
from scipy import ndimage

from marsyard.sim.render.kernels.photometry import MIN_CELLS, NOISE_VARIANCE, add_texture, gradient_noise
from marsyard.sim.terrain import sites

PLACES = np.random.default_rng(5).uniform(-500.0, 500.0, (60000, 3))


def test_variance_of_noise() -> None:
    noise = np.array([gradient_noise(x, y, z, 1) for x, y, z in PLACES])
    assert np.mean(noise**2) == pytest.approx(NOISE_VARIANCE, rel=0.02)


@pytest.mark.parametrize("footprint_m", [1e-4, 3e-3, 0.1])
def test_mean_albedo_is_kept_at_any_distance(footprint_m: float) -> None:
    strongest = max((site.ground_texture for site in sites().values()), key=lambda one: max(one.amplitudes))
    octaves = np.array(strongest.amplitudes)
    log = np.zeros(len(PLACES))
    add_texture(*PLACES.T.copy(), np.full(len(PLACES), footprint_m), strongest.coarsest_m, octaves, log)
    assert np.mean(np.exp(log)) == pytest.approx(1.0, abs=0.005)


def test_detail_finer_than_a_footprint_is_left_out() -> None:
    octaves = np.array([0.2, 0.3])
    change = np.zeros(3)
    place = np.array([[0.3], [0.4], [0.1]]) @ np.ones((1, 3))
    add_texture(*place, np.array([1.001 / MIN_CELLS, 0.2, np.inf]), 1.0, octaves, change)
    assert change[0] == 0.0
    assert change[1] != 0.0
    assert change[2] == 0.0


@pytest.mark.parametrize("cell_px", [4, 3, 2])
def test_an_octave_fades_as_a_gaussian_of_half_a_pixel_blurs_it(cell_px: float) -> None:
    """A plane through the noise, ten samples a pixel, blurred, against what a pixel's footprint leaves of it."""
    fine, side = 10, 400
    rng = np.random.default_rng(7)
    turned = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    y, x = np.mgrid[:side, :side].reshape(2, -1) / fine / cell_px
    places = 50.0 + x[:, None] * turned[0] + y[:, None] * turned[1]
    sharp, seen = np.zeros(len(places)), np.zeros(len(places))
    add_texture(*places.T.copy(), np.full(len(places), 1e-6), 1.0, np.array([0.1]), sharp)
    add_texture(*places.T.copy(), np.full(len(places), 1.0 / cell_px), 1.0, np.array([0.1]), seen)
    # by 0.036 at three pixels a cell: the median wave stands for all, of which the longer are blurred less
    blurred = ndimage.gaussian_filter(sharp.reshape(side, side), 0.5 * fine, mode="nearest")
    assert np.std(seen) / np.std(sharp) == pytest.approx(np.std(blurred) / np.std(sharp), abs=0.05)
