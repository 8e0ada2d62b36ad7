"""Tests of correlation, peaks, corner interest and template matching, against definitions and analytic images."""

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import ndimage

from marsyard.algorithms.image.correlation import (
    coarse_to_fine_peak,
    halve,
    normalized_correlation,
    pseudo_normalized_correlation,
)
from marsyard.algorithms.image.interest import harris_interest, structure_tensor
from marsyard.algorithms.image.peaks import Peak, biquadratic_offset, highest_peak, peak_width, second_peak
from marsyard.algorithms.image.registration import Warp, register_template, similarity_patch

#: Deformation models of the registration, each with more parameters than the one before.
WARPS: tuple[Warp, ...] = ("shift", "stretch", "bend")


def draw_natural_image(seed: int, size: int, blur: float = 1.2) -> np.ndarray:
    """Draw counts of a random texture with about 10 % contrast, blurred as by optics."""
    noise = np.random.default_rng(seed).normal(size=(size, size))
    image = ndimage.gaussian_filter(noise, blur) + 2.0 * ndimage.gaussian_filter(noise, 4.0 * blur)
    return np.asarray(1500.0 + 150.0 * image / image.std())


def correlate_pseudo_normalized(a: np.ndarray, b: np.ndarray) -> float:
    """Compute 2 sum(a b) / (sum(a^2) + sum(b^2)) of deviations from the means."""
    a, b = a - a.mean(), b - b.mean()
    return float(2.0 * np.sum(a * b) / (np.sum(a * a) + np.sum(b * b)))


def correlate_normalized(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


@pytest.mark.parametrize(
    ("correlate", "definition", "atol"),
    [
        # The squares of values of 1e3 are rounded to about 1e-16 * 1e6 = 1e-10; the deviations are 30.
        (pseudo_normalized_correlation, correlate_pseudo_normalized, 1e-10),
        # Sums of products are computed in float32: relative errors of 1e-7.
        (normalized_correlation, correlate_normalized, 1e-5),
    ],
)
@pytest.mark.parametrize("shapes", [((5, 5), (5, 5)), ((7, 9), (30, 21)), ((21, 21), (50, 61))])
def test_correlation_equals_its_definition(
    correlate: Callable[..., np.ndarray], definition: Callable[..., float], atol: float, shapes: tuple[Any, Any]
) -> None:
    """The shapes are those of the template and of the window."""
    rng = np.random.default_rng(5)
    template, window = 1000.0 + 30.0 * rng.normal(size=shapes[0]), 1500.0 + 50.0 * rng.normal(size=shapes[1])
    windows = np.lib.stride_tricks.sliding_window_view(window, shapes[0])
    expected = [[definition(template, patch) for patch in row] for row in windows]
    np.testing.assert_allclose(correlate(template, window), expected, atol=atol)


def test_uniform_patches_have_zero_correlation() -> None:
    window = draw_natural_image(2, 60)
    window[20:50, 20:50] = 800.0
    surface = normalized_correlation(window[0:21, 0:21], window)
    assert np.all(surface[20:30, 20:30] == 0.0)
    assert np.all(normalized_correlation(np.full((5, 5), 7.0), window) == 0.0)
    for value in (0.0, 1e-3, 4095.0):
        assert np.all(pseudo_normalized_correlation(np.full((7, 7), value), np.full((20, 20), value)) == 0.0)


def test_template_larger_than_window_is_rejected() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        normalized_correlation(np.zeros((9, 9)), np.zeros((20, 8)))
    with pytest.raises(ValueError, match="halved"):
        coarse_to_fine_peak(np.zeros((5, 5)), np.zeros((20, 20)), 2, 3)


def test_halved_image_contains_means_of_2x2_pixels() -> None:
    image = np.arange(35.0).reshape(5, 7)
    np.testing.assert_allclose(halve(image), [[4.0, 6.0, 8.0], [18.0, 20.0, 22.0]])


def test_coarse_to_fine_search_equals_full_search() -> None:
    # Even and odd positions: the coarse template is aligned with the coarse window in only a quarter of them.
    rng = np.random.default_rng(5)
    for trial in range(40):
        window = draw_natural_image(trial, 121)
        row, column = rng.integers(0, 100, 2)
        template = window[row : row + 21, column : column + 21] + rng.normal(0.0, 40.0, (21, 21))
        full = coarse_to_fine_peak(template, window, 0, 1)
        coarse_to_fine = coarse_to_fine_peak(template, window, 1, 6)
        assert (full.row, full.column) == (row, column)
        assert (coarse_to_fine.row, coarse_to_fine.column) == (row, column)
        assert coarse_to_fine.value == pytest.approx(full.value, abs=1e-5)
        assert coarse_to_fine.on_border == full.on_border


def render_blobs(seed: int, points: np.ndarray, width: float = 2.0) -> np.ndarray:
    """Evaluate an analytic image at points (..., 2) of (u, v): a sum of Gaussians."""
    rng = np.random.default_rng(seed)
    image = np.zeros(points.shape[:-1])
    for (u, v), height in zip(rng.uniform(-10.0, 90.0, (600, 2)), rng.normal(size=600), strict=True):
        image += height * np.exp(-((points[..., 0] - u) ** 2 + (points[..., 1] - v) ** 2) / (2.0 * width**2))
    return image


def pixel_grid(size: int) -> np.ndarray:
    """Return the coordinates (u, v) of all pixels of a square image, shape (size, size, 2)."""
    return np.stack(np.meshgrid(np.arange(float(size)), np.arange(float(size))), axis=-1)


@pytest.mark.parametrize(
    ("magnification", "roll_deg"), [(1.0, 0.0), (1.13, 0.0), (0.9, 0.0), (1.0, 30.0), (1.1, -12.0)]
)
def test_patches_are_scaled_and_rolled_about_the_point(magnification: float, roll_deg: float) -> None:
    image, centre = render_blobs(4, pixel_grid(80)), np.array([40.37, 38.81])
    patch = similarity_patch(image, centre, 21, magnification, np.deg2rad(roll_deg))
    offsets = (pixel_grid(21) - 10.0) / magnification
    # Before a clockwise roll, the content right of the centre was above and to the right.
    roll = np.deg2rad(roll_deg)
    rotation = np.array([[np.cos(roll), np.sin(roll)], [-np.sin(roll), np.cos(roll)]])
    np.testing.assert_allclose(patch, render_blobs(4, centre + offsets @ rotation.T), atol=2e-3 * image.std())


@pytest.mark.parametrize("centre", [(-0.5, 40.0), (40.0, 79.5), (-90.0, 40.0), (np.nan, 40.0)])
def test_patch_needs_a_centre_inside_the_image(centre: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match=r"the centre of a patch, .* is outside the image"):
        similarity_patch(render_blobs(4, pixel_grid(80)), np.array(centre), 21)


def test_registration_recovers_subpixel_shifts() -> None:
    image = render_blobs(6, pixel_grid(80))
    for centre in np.random.default_rng(1).uniform(35.0, 45.0, (10, 2)):
        template = 0.7 * render_blobs(6, centre + pixel_grid(21) - 10.0) + 3.0
        start = np.rint(centre[::-1]) - 10.0
        for warp in WARPS:
            result = register_template(template, image, start, warp)
            np.testing.assert_allclose(result.corner + 10.0, centre[::-1], atol=3e-3)
            assert result.score > 0.9999


def test_stretched_image_biases_match_without_stretch_model() -> None:
    image = render_blobs(7, pixel_grid(80))
    stretch = np.array([[1.04, 0.05], [-0.03, 1.1]])
    errors: dict[Warp, list[float]] = {warp: [] for warp in WARPS}
    for centre in np.random.default_rng(2).uniform(35.0, 45.0, (20, 2)):
        template = render_blobs(7, centre + (pixel_grid(21) - 10.0) @ np.linalg.inv(stretch).T)
        for warp, distances in errors.items():
            match = register_template(template, image, centre[::-1] - 10.0, warp)
            distances.append(float(np.hypot(*(match.corner + 10.0 - centre[::-1]))))
    assert np.max(errors["stretch"]) < 0.02
    assert np.max(errors["bend"]) < 0.02
    assert np.sqrt(np.mean(np.square(errors["shift"]))) > 0.05


def test_bent_image_biases_match_without_bend_model() -> None:
    """The image of a round rock is bent: 10 px from the centre, at the template border, the shift is half a pixel."""
    image, offsets = render_blobs(11, pixel_grid(80)), pixel_grid(21) - 10.0
    bent_offsets = offsets + 0.005 * np.stack([np.zeros_like(offsets[..., 0]), (offsets**2).sum(axis=-1)], axis=-1)
    errors: dict[Warp, list[float]] = {"stretch": [], "bend": []}
    for centre in np.random.default_rng(4).uniform(35.0, 45.0, (20, 2)):
        template = render_blobs(11, centre + bent_offsets)
        for warp, distances in errors.items():
            match = register_template(template, image, centre[::-1] - 10.0, warp)
            distances.append(float(match.corner[0] + 10.0 - centre[1]))
    assert np.max(np.abs(errors["bend"])) < 0.02
    assert np.mean(errors["stretch"]) > 0.2


@pytest.mark.slow
def test_registration_rejects_undetermined_shifts() -> None:
    image = render_blobs(8, pixel_grid(80))
    template = image[30:51, 30:51]
    assert register_template(np.full((21, 21), 5.0), image, np.array([30.0, 30.0]), "shift") is None
    stripes = np.broadcast_to(np.sin(0.4 * np.arange(80.0)), (80, 80)).copy()
    # The shift along the stripes is undetermined.
    assert register_template(stripes[30:51, 30:51], stripes, np.array([30.0, 30.0]), "shift") is None
    # The match is farther from the start than the limit.
    assert register_template(template, image, np.array([26.0, 27.0]), "shift") is None
    # The template is at the image border, where the spline has no neighbours.
    assert register_template(image[:21, :21], image, np.array([0.0, 0.0]), "shift") is None
    # The image contains only the negative of the template.
    assert register_template(template, -image, np.array([30.0, 30.0]), "shift") is None


@given(arrays(np.float64, (11, 13), elements=st.floats(-1e6, 1e6)), st.integers(1, 5), st.integers(1, 5))
def test_correlation_is_bounded_and_finite(window: np.ndarray, rows: int, columns: int) -> None:
    surface = pseudo_normalized_correlation(window[:rows, :columns], window)
    assert surface.shape == (12 - rows, 14 - columns)
    assert np.all(np.abs(surface) <= 1.0)


def test_subpixel_bias_is_within_limits() -> None:
    # The biquadratic fit is biased by up to 0.09 px on sharp texture (design notes).
    fractions = np.linspace(-0.5, 0.5, 6)
    for number, shift in enumerate(product(fractions[::2], fractions)):
        first, second = (render_blobs(number % 2, pixel_grid(55) - offset, 1.2) for offset in (0.0, shift[::-1]))
        template = first[12:43, 12:43]
        surface = pseudo_normalized_correlation(template, second)
        peak = highest_peak(surface)
        error = np.array([peak.row, peak.column]) + biquadratic_offset(surface, peak) - 12.0 - np.array(shift)
        assert np.abs(error).max() < 0.12


def test_biquadratic_offset_is_exact_for_a_quadric() -> None:
    rows, columns = np.mgrid[:9, :9].astype(float)
    surface = 1.0 - 0.02 * (rows - 4.3) ** 2 - 0.05 * (columns - 3.8) ** 2 + 0.01 * (rows - 4.3) * (columns - 3.8)
    np.testing.assert_allclose(biquadratic_offset(surface, highest_peak(surface)), [0.3, -0.2], atol=1e-12)


def test_biquadratic_offset_is_zero_without_maximum() -> None:
    rows, columns = np.mgrid[:9, :9].astype(float)
    saddle = (rows - 4.0) ** 2 - (columns - 4.0) ** 2
    assert np.all(biquadratic_offset(saddle, Peak(4, 4, 0.0, False)) == 0.0)
    ramp = highest_peak(rows)
    assert ramp.on_border
    assert np.all(biquadratic_offset(rows, ramp) == 0.0)


def make_gaussian(row: float, column: float, widths: tuple[float, float] = (1.5, 1.5)) -> np.ndarray:
    """Create a correlation surface with one Gaussian peak; widths: standard deviations along rows and columns."""
    y, x = np.mgrid[:41, :41]
    return np.asarray(np.exp(-((y - row) ** 2) / (2 * widths[0] ** 2) - (x - column) ** 2 / (2 * widths[1] ** 2)))


def test_peak_width_uses_the_widest_direction() -> None:
    # A Gaussian with the standard deviation s exceeds 3/4 within s sqrt(2 ln 4/3) = 0.759 s: its full width is 1.517 s,
    # in whole pixels.
    for widest in (2.0, 4.0, 6.0):
        surface = make_gaussian(20.0, 20.0, (2.0, widest))
        assert peak_width(surface, highest_peak(surface)) == pytest.approx(1.517 * widest, abs=1.0)
    spike = np.zeros((9, 9))
    spike[4, 4] = 1.0
    assert peak_width(spike, highest_peak(spike)) == pytest.approx(4.0 / np.sqrt(12.0))
    assert peak_width(np.zeros((9, 9)), Peak(0, 0, 0.0, True)) > 9.0


def test_second_peak_is_a_separate_maximum() -> None:
    single_peak = make_gaussian(20.0, 20.0, (4.0, 4.0))
    assert second_peak(single_peak, highest_peak(single_peak), 3.0) == 0.0  # the flanks of a peak are not a second peak
    two_peaks = np.maximum(single_peak, 0.7 * make_gaussian(31.0, 9.0))
    assert second_peak(two_peaks, highest_peak(two_peaks), 3.0) == pytest.approx(0.7)
    close_peaks = np.maximum(make_gaussian(20.0, 20.0), 0.9 * make_gaussian(20.0, 23.0))
    assert second_peak(close_peaks, highest_peak(close_peaks), 3.0) == 0.0
    assert second_peak(close_peaks, highest_peak(close_peaks), 2.0) == pytest.approx(0.9)


def test_interest_requires_gradients_in_both_directions() -> None:
    u, v = np.meshgrid(np.arange(64.0), np.arange(64.0))
    one_gradient, two_gradients = 10.0 * np.sin(0.3 * u), 10.0 * (np.sin(0.3 * u) + np.sin(0.3 * v))
    interest = [harris_interest(*structure_tensor(image, 21)) for image in (one_gradient, two_gradients)]
    assert interest[0][32, 32] < 0.05 * interest[1][32, 32]
    # The RMS gradient per axis is 10 * 0.3 / sqrt(2) = 2.12. Sobel's difference over two pixels attenuates it by
    # sin(0.3) / 0.3. The window of 21 pixels is one period of 20.9.
    assert interest[1][32, 32] == pytest.approx(2.12 * np.sin(0.3) / 0.3, rel=0.02)
    assert np.all(harris_interest(*structure_tensor(np.full((64, 64), 7.0), 21)) == 0.0)
