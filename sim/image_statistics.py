"""Statistics of terrain images to compare rendered images with real ones; the camera need not be calibrated."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

#: Side of the resized images, pixels, as in DIMES; and side of the blocks for the local contrast.
SIDE, BLOCK = 256, 16
#: Frequency range of the fit to the power spectrum, cycles per image.
MIN_FREQUENCY, MAX_FREQUENCY = 4, 63


class ImageStatistics(NamedTuple):
    """Statistics of an image's central square, area-averaged to `SIDE` x `SIDE` pixels.

    - rms: standard deviation divided by the mean
    - slope: exponent of the radially averaged power spectrum from `MIN_FREQUENCY` to `MAX_FREQUENCY`, Hann window
    - local_p10, local_p50, local_p90: percentiles over all blocks of (standard deviation / mean of a block)
    - patchiness: local_p90 / local_p10
    - corner: mean at distances above 0.9 half diagonals from the centre, divided by the mean below 0.25
    """

    rms: float
    slope: float
    local_p10: float
    local_p50: float
    local_p90: float
    patchiness: float
    corner: float


def compute_image_statistics(image: Float[np.ndarray, "rows columns"]) -> ImageStatistics:
    """Compute the statistics of an image in any unit proportional to radiance."""
    rows, columns = image.shape
    side = min(rows, columns)
    top, left = (rows - side) // 2, (columns - side) // 2
    square = np.asarray(image[top : top + side, left : left + side], dtype=np.float64)
    small = cv2.resize(square, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
    p10, p50, p90 = local_contrast(small)
    offset = np.arange(SIDE) - 0.5 * (SIDE - 1)
    radius = np.hypot(offset[:, None], offset) / np.hypot(offset[0], offset[0])
    corner = float(small[radius > 0.9].mean() / small[radius < 0.25].mean())
    rms = float(small.std() / small.mean())
    return ImageStatistics(rms, spectral_slope(small), p10, p50, p90, p90 / p10, corner)


def local_contrast(image: Float[np.ndarray, "rows columns"]) -> tuple[float, float, float]:
    """Compute the 10th, 50th and 90th percentiles over all blocks of (standard deviation / mean of a block).

    The image is resized to `SIDE` x `SIDE` pixels first. The result is NaN if all blocks are black.
    """
    small = cv2.resize(np.asarray(image, dtype=np.float64), (SIDE, SIDE), interpolation=cv2.INTER_AREA)
    blocks = small.reshape(SIDE // BLOCK, BLOCK, SIDE // BLOCK, BLOCK)
    deviation, mean = blocks.std(axis=(1, 3)), blocks.mean(axis=(1, 3))
    if not np.any(mean > 0.0):
        return (np.nan, np.nan, np.nan)
    p10, p50, p90 = np.percentile(deviation[mean > 0.0] / mean[mean > 0.0], [10.0, 50.0, 90.0])
    return float(p10), float(p50), float(p90)


def spectral_slope(image: Float[np.ndarray, "side side"]) -> float:
    """Fit the exponent of the radially averaged power spectrum of a square image."""
    side = len(image)
    window = np.hanning(side)
    relative = image / image.mean() - 1.0
    power = np.abs(np.fft.fft2(relative * window[:, None] * window)) ** 2
    frequency = np.fft.fftfreq(side, 1.0 / side)
    ring_number = np.hypot(frequency[:, None], frequency).astype(int).ravel()
    radial_mean = np.bincount(ring_number, power.ravel()) / np.bincount(ring_number)
    fit_range = np.arange(MIN_FREQUENCY, MAX_FREQUENCY + 1)
    return float(np.polyfit(np.log(fit_range), np.log(radial_mean[fit_range]), 1)[0])
