"""Tests of correlation, subpixel refinement, peak measures and corner interest, against loops and closed forms."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from marsyard.algorithms.image.correlation import pseudo_normalized_correlation
from marsyard.algorithms.image.interest import harris_interest, structure_tensor
from marsyard.algorithms.image.peaks import Peak, biquadratic_offset, highest_peak, peak_width, second_peak


def correlate_directly(template: np.ndarray, window: np.ndarray) -> np.ndarray:
    """Correlate with a loop over all positions: 2 sum(a b) / (sum(a^2) + sum(b^2)), where a and b have the mean 0."""
    rows, columns = template.shape
    a = template - template.mean()
    result = np.zeros((window.shape[0] - rows + 1, window.shape[1] - columns + 1))
    for row, column in np.ndindex(*result.shape):
        b = window[row : row + rows, column : column + columns]
        b = b - b.mean()
        result[row, column] = 2.0 * np.sum(a * b) / (np.sum(a * a) + np.sum(b * b))
    return result


@pytest.mark.parametrize(
    ("template_shape", "window_shape"), [((5, 5), (12, 12)), ((7, 9), (30, 21)), ((31, 31), (71, 71)), ((5, 5), (5, 5))]
)
def test_correlation_equals_its_definition(template_shape: tuple[int, int], window_shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(template_shape[0] * window_shape[0])
    template, window = 1000.0 + rng.normal(size=template_shape), 1500.0 + 3.0 * rng.normal(size=window_shape)
    # The squares of values of 1e3 are rounded to about 1e-16 * 1e6 = 1e-10; the deviations are 1.
    np.testing.assert_allclose(
        pseudo_normalized_correlation(template, window), correlate_directly(template, window), atol=1e-10
    )


@pytest.mark.parametrize("value", [0.0, 1e-3, 4095.0])
def test_uniform_patches_have_zero_correlation(value: float) -> None:
    assert np.all(pseudo_normalized_correlation(np.full((7, 7), value), np.full((20, 20), value)) == 0.0)


@given(arrays(np.float64, (11, 13), elements=st.floats(-1e6, 1e6)), st.integers(1, 5), st.integers(1, 5))
def test_correlation_is_bounded_and_finite(window: np.ndarray, rows: int, columns: int) -> None:
    surface = pseudo_normalized_correlation(window[:rows, :columns], window)
    assert surface.shape == (12 - rows, 14 - columns)
    assert np.all(np.abs(surface) <= 1.0)


def render_blobs(seed: int, shift: tuple[float, float] = (0.0, 0.0), size: int = 55, width: float = 1.2) -> np.ndarray:
    """Evaluate an analytic image: a sum of Gaussians, shifted by `shift` (row, column)."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:size, :size].astype(float)
    image = np.zeros((size, size))
    for y, x, height in zip(*rng.uniform(-5.0, size + 5.0, (2, 500)), rng.normal(size=500), strict=True):
        image += height * np.exp(-((rows - y - shift[0]) ** 2 + (columns - x - shift[1]) ** 2) / (2.0 * width**2))
    return image


def test_subpixel_bias_is_within_limits() -> None:
    # The biquadratic fit is biased by up to 0.09 px on sharp texture (design notes).
    fractions = np.linspace(-0.5, 0.5, 6)
    for number, shift in enumerate(product(fractions[::2], fractions)):
        template = render_blobs(number % 2)[12:43, 12:43]
        surface = pseudo_normalized_correlation(template, render_blobs(number % 2, shift))
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
