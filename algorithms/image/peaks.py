"""Peaks of correlation surfaces: position, sub-pixel offset, width, and the second-highest peak."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from marsyard.algorithms.arrays import Raster, Vector2

#: Row and column offsets of 3 x 3 pixels from the centre.
_ROW_OFFSETS, _COLUMN_OFFSETS = np.mgrid[-1.0:2.0, -1.0:2.0]
#: Fraction of a peak's height at which its width is measured.
_WIDTH_LEVEL = 0.75


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
    # closed form of the least-squares fit to 3 x 3 values
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


def peak_width(surface: Raster, peak: Peak) -> float:
    """Full width of the peak at three quarters of its height along its longest direction, in pixels.

    The width is the major axis (four standard deviations) of the ellipse with the second moments of the connected
    region above that value. Each pixel contributes the variance of its own extent, 1/12. The width is 1.15 for a region
    of one pixel, and 1.15 times the length of a ridge. Without a positive peak the surface's diagonal is returned.
    """
    if peak.value <= 0.0:
        return float(np.hypot(*surface.shape))
    labels, _ = ndimage.label(surface > _WIDTH_LEVEL * peak.value)
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
