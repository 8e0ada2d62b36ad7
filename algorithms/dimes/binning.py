"""Sizes of the binned images of DIMES and its baselines, and averages over blocks of pixels."""

import cv2
import numpy as np
from jaxtyping import Float

from marsyard.algorithms.arrays import Raster


def bin_factors(shape: tuple[int, int], binned_size: tuple[int, int]) -> tuple[int, int]:
    """Software binning factors (columns, rows) from a delivered image of `shape` to `binned_size` (columns, rows).

    Raises ValueError if the delivered size is not a multiple of the binned size.
    """
    rows, columns = shape
    if columns % binned_size[0] or rows % binned_size[1]:
        binned = f"{binned_size[0]} x {binned_size[1]}"
        raise ValueError(f"an image of {columns} x {rows} pixels cannot be binned to {binned} pixels")
    return columns // binned_size[0], rows // binned_size[1]


def check_binning(binned_size: tuple[int, int], delivered_size: tuple[int, int]) -> None:
    """Raise ValueError if DIMES cannot bin a delivered image to this size; both are (columns, rows)."""
    if delivered_size[0] % binned_size[0] or delivered_size[1] % binned_size[1]:
        raise ValueError(
            f"dimes.binned_size {list(binned_size)} does not divide the delivered image of {delivered_size[0]} x "
            f"{delivered_size[1]} pixels; allowed: sizes that do, such as {list(binned_size_for(*delivered_size))}"
        )


def binned_size_for(columns: int, rows: int) -> tuple[int, int]:
    """Return a binned size for DIMES: square bins, and the smallest possible width of at least 256 columns."""
    candidates = range(1, max(columns // 256, 1) + 1)
    factors = [factor for factor in candidates if columns % factor == 0 and rows % factor == 0]
    return columns // factors[-1], rows // factors[-1]


def bin_mean(image: Raster, columns: int, rows: int) -> Float[np.ndarray, "binned_rows binned_columns"]:
    """Average blocks of `columns` x `rows` pixels; the image size must be a multiple of the block size."""
    size = (image.shape[1] // columns, image.shape[0] // rows)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
