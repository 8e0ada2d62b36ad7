"""Correlation of a template with a window: normalised (target tracking) and pseudo-normalised (DIMES).

Section II.A is that of Johnson et al., "Field Testing of the MER DIMES". The tracking paper is Kim et al., "Targeted
Driving Using Visual Tracking".
"""

import cv2
import numpy as np
from jaxtyping import Float
from scipy import fft

from marsyard.algorithms.arrays import Raster
from marsyard.algorithms.image.kernels import correlation as kernels
from marsyard.algorithms.image.peaks import Peak

#: Search radius around a candidate of the coarser level, pixels: one pixel for its error and one for sampling.
SEARCH_RADIUS_PX = 2


def cross_sums(template: Float[np.ndarray, "_ _"], window: Float[np.ndarray, "_ _"]) -> Float[np.ndarray, "_ _"]:
    """Cross-correlate without normalisation, by FFT: sums of products at every position where the template fits.

    The transform has the window's size: wrap-around affects only positions where the template does not fit.
    """
    shape = (fft.next_fast_len(window.shape[0], real=True), fft.next_fast_len(window.shape[1], real=True))
    spectrum = fft.rfft2(window, shape) * np.conj(fft.rfft2(template, shape))
    products = fft.irfft2(spectrum, shape)
    return np.asarray(products[: window.shape[0] - template.shape[0] + 1, : window.shape[1] - template.shape[1] + 1])


def pseudo_normalized_correlation(template: Float[np.ndarray, "n m"], window: Raster) -> Float[np.ndarray, "_ _"]:
    """Pseudo-normalised correlation ``2 sum(A B) / (sum(A A) + sum(B B))`` (II.A).

    A is the template and B a patch of the window, each minus its mean. Entry (i, j) belongs to the patch with its upper
    left pixel at (i, j) of the window; the shape is (rows - n + 1, columns - m + 1). Values lie in [-1, 1] and decrease
    with a contrast difference, unlike normalised correlation. Zero if both patches are uniform.
    """
    max_abs = max(float(np.abs(template).max()), float(np.abs(window).max()))
    a = template - template.mean(dtype=np.float64)
    b = np.ascontiguousarray(window - window.mean(dtype=np.float64))
    cross = np.ascontiguousarray(cross_sums(a, b))
    min_energy = _flat_energy(template, max_abs)
    return np.asarray(kernels.pseudo_normalized(cross, b, template.shape, float(np.sum(a * a)), min_energy))


def normalized_correlation(template: Float[np.ndarray, "n m"], window: Raster) -> Float[np.ndarray, "_ _"]:
    """Normalised correlation ``sum(A B) / sqrt(sum(A A) sum(B B))`` (tracking paper, Eq. 11).

    A is the template and B a patch of the window, each minus its mean. Entry (i, j) belongs to the patch with its upper
    left pixel at (i, j); the shape is (rows - n + 1, columns - m + 1). Values lie in [-1, 1]; zero if A or B is
    uniform. Errors are about 1e-5, because products are summed in float32. Raises ValueError if the template is larger
    than the window.
    """
    _check_fit(template, window)
    a, max_abs_a = kernels.subtract_mean(np.ascontiguousarray(template, dtype=np.float32))
    b, max_abs_b = kernels.subtract_mean(np.ascontiguousarray(window, dtype=np.float32))
    return np.asarray(kernels.correlation_surface(a, b, _flat_energy(template, max(max_abs_a, max_abs_b))))


def coarse_to_fine_peak(template: Float[np.ndarray, "n m"], window: Raster, levels: int, candidates: int) -> Peak:
    """Find the maximum of `normalized_correlation` by a coarse-to-fine search (tracking paper, section 4.3.2).

    Template and window are halved `levels` times. The best local maxima of the coarsest correlation, at most
    `candidates`, are refined level by level (Rosenfeld & Vanderbrug 1977). The best maximum at full resolution is
    returned. With 0 levels the search is exhaustive. Raises ValueError if the template is larger than the window, or
    too small to be halved.
    """
    if min(template.shape) >> levels < 2:
        raise ValueError(f"a template of {template.shape} pixels cannot be halved {levels} times: fewer than 2 remain")
    _check_fit(template, window)
    pyramid = [(template, window)]
    for _ in range(levels):
        pyramid.append((halve(pyramid[-1][0]), halve(pyramid[-1][1])))
    surface = normalized_correlation(*pyramid[-1])
    maxima = np.argwhere(surface >= cv2.dilate(surface, np.ones((3, 3), np.uint8)))
    values = surface[maxima[:, 0], maxima[:, 1]]
    order = np.argsort(-values, kind="stable")[: candidates if levels else 1]
    positions, values = maxima[order], values[order]
    for level_template, level_window in reversed(pyramid[:-1]):
        a, max_abs = kernels.subtract_mean(np.ascontiguousarray(level_template, dtype=np.float32))
        b = np.ascontiguousarray(level_window, dtype=np.float32)
        min_energy = _flat_energy(level_template, max_abs)
        positions, values = kernels.search_near(a, b, 2 * positions, SEARCH_RADIUS_PX, min_energy)
    best = int(np.argmax(values))
    row, column = (int(i) for i in positions[best])
    last_corner = (window.shape[0] - template.shape[0], window.shape[1] - template.shape[1])
    return Peak(row, column, float(values[best]), row in (0, last_corner[0]) or column in (0, last_corner[1]))


def halve(image: Raster) -> Float[np.ndarray, "_ _"]:
    """Reduce an image to means of 2 x 2 pixels; an odd last row or column is dropped."""
    rows, columns = image.shape[0] // 2, image.shape[1] // 2
    cropped = np.ascontiguousarray(image[: 2 * rows, : 2 * columns])
    return np.asarray(cv2.resize(cropped, (columns, rows), interpolation=cv2.INTER_AREA))


def _check_fit(template: Float[np.ndarray, "_ _"], window: Float[np.ndarray, "_ _"]) -> None:
    """Raise ValueError if the template is larger than the window."""
    if template.shape[0] > window.shape[0] or template.shape[1] > window.shape[1]:
        raise ValueError(f"a template of {template.shape} pixels does not fit into a window of {window.shape}")


def _flat_energy(template: Float[np.ndarray, "_ _"], max_abs: float) -> float:
    """Energy (sum of squares) below which a patch is uniform except for rounding errors, for values up to `max_abs`."""
    return kernels.FLAT_ENERGY * template.size * max_abs * max_abs
