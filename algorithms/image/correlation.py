"""Normalised and pseudo-normalised correlation of a template with a window, and peaks of correlation surfaces.

Target tracking uses the normalised correlation, DIMES the pseudo-normalised correlation.
Section II.A is that of Johnson et al., "Field Testing of the MER DIMES". The tracking paper is Kim et al., "Targeted
Driving Using Visual Tracking".
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from scipy import fft, ndimage

from marsyard.algorithms.arrays import Raster, Vector2
from marsyard.algorithms.image.kernels import correlation as kernels

#: Row and column offsets of 3 x 3 pixels from the centre.
_ROW_OFFSETS, _COLUMN_OFFSETS = np.mgrid[-1.0:2.0, -1.0:2.0]


@dataclass(frozen=True)
class Peak:
    """Maximum of a surface: row, column, value, and whether it lies on the border."""

    row: int
    column: int
    value: float
    on_border: bool


def highest_peak(surface: Raster) -> Peak:
    """Find the maximum of a surface; the first one of equal values."""
    row, column = (int(i) for i in np.unravel_index(int(np.argmax(surface)), surface.shape))
    on_border = row in (0, surface.shape[0] - 1) or column in (0, surface.shape[1] - 1)
    return Peak(row, column, float(surface[row, column]), on_border)


def biquadratic_offset(surface: Raster, peak: Peak) -> Vector2:
    """Fit a quadratic by least squares to the 3 x 3 values around the peak; return its maximum's offset (row, column).

    In pixels, clipped to [-1, 1]. Zero if the peak is on the border or the quadratic has no maximum. The bias towards
    whole pixels is up to 0.09 px; `registration.register_template` has no such bias.
    """
    if peak.on_border:
        return np.zeros(2)
    z = surface[peak.row - 1 : peak.row + 2, peak.column - 1 : peak.column + 2]
    gradient = np.array([np.sum(z * _ROW_OFFSETS), np.sum(z * _COLUMN_OFFSETS)]) / 6.0
    # second derivatives of the quadratic along rows, along columns, and mixed
    rr = float(np.sum(z * (_ROW_OFFSETS**2 - 2.0 / 3.0)))
    cc = float(np.sum(z * (_COLUMN_OFFSETS**2 - 2.0 / 3.0)))
    rc = float(np.sum(z * _ROW_OFFSETS * _COLUMN_OFFSETS)) / 4.0
    determinant = rr * cc - rc * rc
    if rr >= 0.0 or determinant <= 0.0:
        return np.zeros(2)
    offset = -np.array([cc * gradient[0] - rc * gradient[1], rr * gradient[1] - rc * gradient[0]]) / determinant
    return np.asarray(np.clip(offset, -1.0, 1.0))


def peak_width(surface: Raster, peak: Peak, level: float = 0.75) -> float:
    """Full width of the peak at `level` times its height along its longest direction, in pixels.

    The width is the major axis (four standard deviations) of the ellipse with the second moments of the connected
    region above that value. Each pixel contributes the variance of its own extent, 1/12. The width is 1.15 for a region
    of one pixel, and 1.15 times the length of a ridge. Without a positive peak the surface's diagonal is returned.
    """
    if peak.value <= 0.0:
        return float(np.hypot(*surface.shape))
    labels, _ = ndimage.label(surface > level * peak.value)
    points = np.argwhere(labels == labels[peak.row, peak.column])
    deviations = points - points.mean(axis=0)
    moments = deviations.T @ deviations / len(points)
    return float(4.0 * np.sqrt(np.linalg.eigvalsh(moments)[-1] + 1.0 / 12.0))


def second_peak(surface: Raster, peak: Peak, exclusion: float) -> float:
    """Highest local maximum (of 3 x 3) farther than `exclusion` pixels from the peak; 0 if none is positive."""
    maxima = np.argwhere(surface >= ndimage.maximum_filter(surface, size=3, mode="nearest"))
    distances = np.hypot(maxima[:, 0] - peak.row, maxima[:, 1] - peak.column)
    distant_maxima = maxima[distances > exclusion]
    values = surface[distant_maxima[:, 0], distant_maxima[:, 1]]
    return float(max(values.max(initial=0.0), 0.0))


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
    scale = max(float(np.abs(template).max()), float(np.abs(window).max()))
    a = template - template.mean(dtype=np.float64)
    b = np.ascontiguousarray(window - window.mean(dtype=np.float64))
    cross = np.ascontiguousarray(cross_sums(a, b))
    min_energy = kernels.FLAT_ENERGY * template.size * scale * scale
    return np.asarray(kernels.pseudo_normalized(cross, b, template.shape, float(np.sum(a * a)), min_energy))


#: Search radius around a candidate of the coarser level, pixels: one pixel for its error and one for sampling.
SEARCH_RADIUS_PX = 2


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
