"""Texture that gives out octave by octave: it changes no mean, and does not alias."""

import numpy as np
import pytest

from sim.render.kernels.texture import NOISE_VARIANCE, add_texture, gradient_noise
from sim.terrain import sites

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


def test_detail_finer_than_half_a_footprint_is_left_out() -> None:
    octaves = np.array([0.2, 0.3])
    change = np.zeros(3)
    place = np.array([[0.3], [0.4], [0.1]]) @ np.ones((1, 3))
    add_texture(*place, np.array([0.51, 0.2, np.inf]), 1.0, octaves, change)
    assert change[0] == 0.0
    assert change[1] != 0.0
    assert change[2] == 0.0
