"""Tests of image statistics on synthetic images with known spectrum, contrast and fall-off."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from benchmarks.validation.image_statistics import (
    SIDE_PX,
    compute_ground_statistics,
    compute_image_statistics,
    compute_map_statistics,
    compute_pair_statistics,
    spectral_slope,
)


@pytest.mark.parametrize("exponent", [-1.5, -2.5])
def test_slope_of_a_power_law_is_measured(exponent: float) -> None:
    rng = np.random.default_rng(2)
    wavenumbers = np.hypot(*np.meshgrid(np.fft.fftfreq(4 * SIDE_PX), np.fft.fftfreq(4 * SIDE_PX)))
    wavenumbers[0, 0] = 1.0
    modes = np.fft.fft2(rng.standard_normal(wavenumbers.shape)) * wavenumbers ** (0.5 * exponent)
    field = np.fft.ifft2(modes).real[:SIDE_PX, :SIDE_PX]
    assert spectral_slope(100.0 + field / field.std()) == pytest.approx(exponent, abs=0.15)


def test_patchiness_is_the_ratio_of_local_contrasts() -> None:
    """One half of the image has noise of 10 %, the other half of 2 %."""
    rng = np.random.default_rng(3)
    sd = np.where(np.arange(SIDE_PX) < SIDE_PX // 2, 0.1, 0.02)
    statistics = compute_image_statistics(1000.0 * (1.0 + sd * rng.standard_normal((SIDE_PX, SIDE_PX))))
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


def test_sparse_dark_spots_have_kurtosis_and_negative_skewness() -> None:
    """Gaussian noise has neither; 30 dark discs of 10 pixels radius in it have both, and a strong template."""
    rng = np.random.default_rng(4)
    noise = 1000.0 * (1.0 + 0.02 * gaussian_filter(rng.standard_normal((SIDE_PX, SIDE_PX)), 3.0, mode="wrap") * 10.0)
    spotted = noise.copy()
    y, x = np.mgrid[:SIDE_PX, :SIDE_PX]
    for row, column in rng.uniform(30.0, SIDE_PX - 30.0, (30, 2)):
        spotted[np.hypot(y - row, x - column) < 10.0] *= 0.5
    plain, spots = compute_image_statistics(noise), compute_image_statistics(spotted)
    assert max(abs(plain.kurtosis_4), abs(plain.kurtosis_8), abs(plain.skewness_8)) < 0.4
    assert min(spots.kurtosis_4, spots.kurtosis_8) > 1.5
    assert spots.skewness_8 < -1.0
    assert spots.best_template > 1.5 * plain.best_template
    assert spots.sift > 10


def test_statistics_of_ground_see_noise_and_sparse_dark_pixels() -> None:
    """Blurred noise of 5 % has this contrast and no kurtosis; 2 % of dark blocks of 3 x 3 pixels change both tails."""
    rng = np.random.default_rng(5)
    noise = gaussian_filter(rng.standard_normal((384, 384)), 0.8)
    image = 1000.0 * (1.0 + 0.05 * noise / noise.std())
    plain = compute_ground_statistics(image)
    assert plain.local_p50 == pytest.approx(0.05, rel=0.1)
    assert plain.local_p10 < plain.local_p50 < plain.local_p90
    assert abs(plain.kurtosis) < 0.2
    # 1st percentile of a normal distribution: -2.33 standard deviations
    assert plain.darkest == pytest.approx(1.0 - 2.33 * 0.05, abs=0.02)
    spotted = image.copy()
    for row, column in rng.integers(3, 380, (384 * 384 // 450, 2)):
        spotted[row : row + 3, column : column + 3] *= 0.5
    spots = compute_ground_statistics(spotted)
    assert spots.darkest == pytest.approx(0.5, abs=0.05)
    assert spots.kurtosis > 3.0
    assert spots.local_p90 > 1.5 * plain.local_p90


def test_corners_are_counted_per_megapixel() -> None:
    """A board of squares of 12 pixels has a corner at each vertex, 1 / 144 of the pixels, that all are found."""
    y, x = np.mgrid[:384, :384]
    board = 1000.0 * (1.0 + 0.3 * np.sign(np.sin(np.pi * (x + 0.5) / 12.0) * np.sin(np.pi * (y + 0.5) / 12.0)))
    # 31 x 31 inner vertices, and some corners at the border
    assert compute_ground_statistics(board).corners == pytest.approx(1e3 * 31**2 / 384**2, rel=0.15)


def _draw_texture(seed: int) -> np.ndarray:
    field = gaussian_filter(np.random.default_rng(seed).standard_normal((700, 700)), 2.0)
    return 1000.0 * (1.0 + 0.05 * field / field.std())


def test_pair_of_shifted_images_agrees_except_for_its_noise() -> None:
    """The same ground, shifted by whole pixels, correlates fully; noise of a third of the contrast lowers this."""
    ground, rng = _draw_texture(5), np.random.default_rng(6)
    first, second = ground[50:562, 50:562], ground[62:574, 80:592]
    exact = compute_pair_statistics(first, second)
    assert exact.inlier_ratio > 0.99
    assert exact.repeatability > 0.95
    assert exact.tracking_error_px < 0.05
    assert exact.decorrelation == pytest.approx(0.0, abs=0.002)
    # noise of the same spectrum, a third of the contrast, in each image: correlation 1 / (1 + 1 / 9)
    noises = [50.0 / 3.0 * (_draw_texture(seed)[:512, :512] - 1000.0) / 50.0 for seed in (7, 8)]
    noisy = compute_pair_statistics(first + noises[0], second + noises[1])
    assert noisy.decorrelation == pytest.approx(1.0 - 1.0 / (1.0 + 1.0 / 9.0), abs=0.03)
    assert noisy.tracking_error_px > 2.0 * exact.tracking_error_px
    assert noisy.repeatability < exact.repeatability
    assert compute_pair_statistics(first, 1000.0 + rng.standard_normal((512, 512))) is None


def test_image_on_its_map_is_found_and_correlates() -> None:
    """A part of the map, rotated by 10 deg, is found; noise of the same spectrum lowers the correlation."""
    mapped = _draw_texture(9)[:500, :500]
    rotation = cv2.getRotationMatrix2D((250.0, 250.0), 10.0, 1.0)
    image = cv2.warpAffine(mapped, rotation, (500, 500), flags=cv2.INTER_CUBIC)[100:400, 100:400]
    exact = compute_map_statistics(image, mapped)
    assert exact.sift > 0.5
    assert exact.orb > 0.1
    assert exact.correlation > 0.97
    assert exact.valid == pytest.approx(1.0)
    noisy = compute_map_statistics(image + 0.5 * (_draw_texture(8)[:300, :300] - 1000.0), mapped)
    # noise of half the contrast of the signal: correlation 1 / sqrt(1 + 1 / 4)
    assert noisy.correlation == pytest.approx(1.0 / np.sqrt(1.25), abs=0.05)
    assert noisy.sift < exact.sift
    assert compute_map_statistics(_draw_texture(7)[:300, :300], mapped) is None


def test_landmarks_that_the_sun_moves_correlate_less_than_others() -> None:
    """Strong blobs on the map that are missing in the image lower the correlation of the strongest templates."""
    mapped = _draw_texture(9)[:500, :500]
    y, x = np.mgrid[:500, :500]
    changed = mapped.copy()
    for row, column in np.random.default_rng(1).uniform(80.0, 420.0, (12, 2)):
        changed += 400.0 * np.exp(-0.5 * ((y - row) ** 2 + (x - column) ** 2) / 4.0**2)
    statistics = compute_map_statistics(mapped[50:450, 50:450], changed)
    assert statistics.strongest < statistics.correlation - 0.1
    equal = compute_map_statistics(changed[50:450, 50:450], changed)
    assert equal.strongest > 0.98
