"""Peaks of a correlation surface: where, how wide, and how far above the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import ndimage

_ROW, _COLUMN = np.mgrid[-1.0:2.0, -1.0:2.0]


@dataclass(frozen=True)
class Peak:
    """The highest value of a surface: its row and column in whole pixels, and whether that is on the border."""

    row: int
    column: int
    value: float
    on_border: bool


def highest_peak(surface: Float[np.ndarray, "rows columns"]) -> Peak:
    """The highest value of the surface; the first of equals."""
    row, column = (int(i) for i in np.unravel_index(int(np.argmax(surface)), surface.shape))
    on_border = row in (0, surface.shape[0] - 1) or column in (0, surface.shape[1] - 1)
    return Peak(row, column, float(surface[row, column]), on_border)


def biquadratic_offset(surface: Float[np.ndarray, "rows columns"], peak: Peak) -> Float[np.ndarray, "2"]:
    """Offset (row, column) of the top of the quadric through the 3 x 3 values about the peak, by least squares.

    In pixels, held to [-1, 1]; zero on the border and where the quadric has no maximum. Its bias towards whole pixels
    reaches several hundredths of a pixel; see `marsyard.algorithms.image.alignment` for what removes it.
    """
    if peak.on_border:
        return np.zeros(2)
    z = surface[peak.row - 1 : peak.row + 2, peak.column - 1 : peak.column + 2]
    gradient = np.array([np.sum(z * _ROW), np.sum(z * _COLUMN)]) / 6.0
    rr = float(np.sum(z * (_ROW**2 - 2.0 / 3.0)))
    cc = float(np.sum(z * (_COLUMN**2 - 2.0 / 3.0)))
    rc = float(np.sum(z * _ROW * _COLUMN)) / 4.0
    determinant = rr * cc - rc * rc
    if rr >= 0.0 or determinant <= 0.0:
        return np.zeros(2)
    offset = -np.array([cc * gradient[0] - rc * gradient[1], rr * gradient[1] - rc * gradient[0]]) / determinant
    return np.asarray(np.clip(offset, -1.0, 1.0))


def peak_width(surface: Float[np.ndarray, "rows columns"], peak: Peak, level: float = 0.75) -> float:
    """Full width of the peak at `level` times its height along its longest direction, in pixels.

    Of the connected region about the peak that is above that, the major axis of the ellipse with the same second
    moments. A sharp peak of one pixel has 1.15; a ridge has its length. The surface's diagonal where there is no peak.
    """
    if peak.value <= 0.0:
        return float(np.hypot(*surface.shape))
    labels, _ = ndimage.label(surface > level * peak.value)
    points = np.argwhere(labels == labels[peak.row, peak.column])
    deviations = points - points.mean(axis=0)
    moments = deviations.T @ deviations / len(points)
    return float(4.0 * np.sqrt(np.linalg.eigvalsh(moments)[-1] + 1.0 / 12.0))


def second_peak(surface: Float[np.ndarray, "rows columns"], peak: Peak, exclusion: float) -> float:
    """The highest local maximum (of 3 x 3) further than `exclusion` pixels from the peak; 0 if none is positive."""
    maxima = np.argwhere(surface >= ndimage.maximum_filter(surface, size=3, mode="nearest"))
    distances = np.hypot(maxima[:, 0] - peak.row, maxima[:, 1] - peak.column)
    others = maxima[distances > exclusion]
    values = surface[others[:, 0], others[:, 1]]
    return float(max(values.max(initial=0.0), 0.0))
