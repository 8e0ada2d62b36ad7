"""Tests of image statistics on synthetic images with known spectrum, contrast and fall-off."""

import numpy as np
import pytest

from marsyard.sim.image_statistics import SIDE, compute_image_statistics, spectral_slope


@pytest.mark.parametrize("exponent", [-1.5, -2.5])
def test_slope_of_a_power_law_is_measured(exponent: float) -> None:
    rng = np.random.default_rng(2)
    wavenumbers = np.hypot(*np.meshgrid(np.fft.fftfreq(4 * SIDE), np.fft.fftfreq(4 * SIDE)))
    wavenumbers[0, 0] = 1.0
    modes = np.fft.fft2(rng.standard_normal(wavenumbers.shape)) * wavenumbers ** (0.5 * exponent)
    field = np.fft.ifft2(modes).real[:SIDE, :SIDE]
    assert spectral_slope(100.0 + field / field.std()) == pytest.approx(exponent, abs=0.15)


def test_patchiness_is_the_ratio_of_local_contrasts() -> None:
    """One half of the image has noise of 10 %, the other half of 2 %."""
    rng = np.random.default_rng(3)
    sd = np.where(np.arange(SIDE) < SIDE // 2, 0.1, 0.02)
    statistics = compute_image_statistics(1000.0 * (1.0 + sd * rng.standard_normal((SIDE, SIDE))))
    assert statistics.local_p10 == pytest.approx(0.02, rel=0.1)
    assert statistics.local_p90 == pytest.approx(0.1, rel=0.1)
    assert statistics.patchiness == pytest.approx(statistics.local_p90 / statistics.local_p10)


def test_corner_brightness_is_relative_to_the_centre() -> None:
    """An image with linear fall-off is padded on two sides; only its central square is used."""
    offset = np.arange(512) - 255.5
    radius = np.hypot(offset[:, None], offset) / np.hypot(255.5, 255.5)
    image = np.pad(1.0 - 0.4 * radius, ((0, 0), (100, 100)))
    statistics = compute_image_statistics(image)
    # The mean relative radius is 0.93 for corner pixels (above 0.9) and 0.165 for central pixels (below 0.25).
    assert statistics.corner == pytest.approx((1.0 - 0.4 * 0.93) / (1.0 - 0.4 * 0.165), abs=0.01)
    assert 0.0 < statistics.rms < 0.2
