"""Statistics of pictures of ground that need no calibration, to compare rendered pictures with flown ones."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

#: Side of the compared pictures, pixels: that at which DIMES works. Side of the blocks of local contrast.
SIDE, BLOCK = 256, 16
#: Range of the fit of the power spectrum, cycles per picture.
LOWEST, HIGHEST = 4, 63


class ImageStatistics(NamedTuple):
    """Statistics of a picture's central square, area-averaged to `SIDE` pixels.

    - rms: standard deviation divided by the mean
    - slope: exponent of the radially averaged power spectrum between `LOWEST` and `HIGHEST`, with a Hann window
    - local_p10, local_p50, local_p90: percentiles over blocks of a block's standard deviation divided by its mean
    - patchiness: local_p90 / local_p10
    - corner: mean beyond 0.9 of the half diagonal, divided by the mean within 0.25 of it
    """

    rms: float
    slope: float
    local_p10: float
    local_p50: float
    local_p90: float
    patchiness: float
    corner: float


def image_statistics(picture: Float[np.ndarray, "rows columns"]) -> ImageStatistics:
    """Compute the statistics of a picture in any unit proportional to radiance."""
    rows, columns = picture.shape
    side = min(rows, columns)
    top, left = (rows - side) // 2, (columns - side) // 2
    square = np.asarray(picture[top : top + side, left : left + side], dtype=np.float64)
    small = cv2.resize(square, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
    p10, p50, p90 = local_contrast(small)
    offset = np.arange(SIDE) - 0.5 * (SIDE - 1)
    radius = np.hypot(offset[:, None], offset) / np.hypot(offset[0], offset[0])
    corner = float(small[radius > 0.9].mean() / small[radius < 0.25].mean())
    rms = float(small.std() / small.mean())
    return ImageStatistics(rms, spectral_slope(small), p10, p50, p90, p90 / p10, corner)


def local_contrast(picture: Float[np.ndarray, "rows columns"]) -> tuple[float, float, float]:
    """Compute the 10, 50 and 90 % percentiles of a block's standard deviation divided by its mean.

    The picture is resized to `SIDE` x `SIDE` pixels; NaN if all blocks are black.
    """
    small = cv2.resize(np.asarray(picture, dtype=np.float64), (SIDE, SIDE), interpolation=cv2.INTER_AREA)
    blocks = small.reshape(SIDE // BLOCK, BLOCK, SIDE // BLOCK, BLOCK)
    deviation, mean = blocks.std(axis=(1, 3)), blocks.mean(axis=(1, 3))
    if not np.any(mean > 0.0):
        return (np.nan, np.nan, np.nan)
    p10, p50, p90 = np.percentile(deviation[mean > 0.0] / mean[mean > 0.0], [10.0, 50.0, 90.0])
    return float(p10), float(p50), float(p90)


def spectral_slope(picture: Float[np.ndarray, "side side"]) -> float:
    """Exponent of the radially averaged power spectrum of a square picture."""
    side = len(picture)
    window = np.hanning(side)
    relative = picture / picture.mean() - 1.0
    power = np.abs(np.fft.fft2(relative * window[:, None] * window)) ** 2
    frequency = np.fft.fftfreq(side, 1.0 / side)
    ring = np.hypot(frequency[:, None], frequency).astype(int).ravel()
    radial = np.bincount(ring, power.ravel()) / np.bincount(ring)
    k = np.arange(LOWEST, HIGHEST + 1)
    return float(np.polyfit(np.log(k), np.log(radial[k]), 1)[0])
