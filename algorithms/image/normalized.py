"""Normalised cross-correlation: at every place of a window, or coarse to fine at the promising ones only."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, Int

from marsyard.algorithms.image.kernels import correlation as kernels
from marsyard.algorithms.image.peak import Peak

#: Places searched about a candidate of the level above, pixels: it is right to one pixel, and one more for sampling.
REACH_PX = 2


def normalized_correlation(
    template: Float[np.ndarray, "n m"], window: Float[np.ndarray, "rows columns"]
) -> Float[np.ndarray, "_ _"]:
    """``sum(A B) / sqrt(sum(A A) sum(B B))`` with A the template and B the window's patch, each less its own mean.

    Entry (i, j) belongs to the patch whose upper left pixel is (i, j) of the window; the shape is (rows - n + 1,
    columns - m + 1). Values lie in [-1, 1]; zero where either has no contrast. Right to about 1e-5: sums of products
    are float32. (Tracking paper, Eq. 11.)

    Raises
    ------
    ValueError
        If the template is larger than the window.
    """
    _check_fit(template, window)
    a, bright_a = kernels.centred(np.ascontiguousarray(template, dtype=np.float32))
    b, bright_b = kernels.centred(np.ascontiguousarray(window, dtype=np.float32))
    return np.asarray(kernels.surface(a, b, _flat(template, max(bright_a, bright_b))))


def coarse_to_fine_peak(
    template: Float[np.ndarray, "n m"], window: Float[np.ndarray, "rows columns"], levels: int, candidates: int
) -> Peak:
    """The highest peak of `normalized_correlation`, searched at a lower resolution first.

    Template and window are halved `levels` times by averaging 2 x 2 pixels. The smallest are correlated at every place;
    the best local maxima, at most `candidates`, are followed through the levels up to the full resolution, where the
    best of them wins. With no levels it is the full search. (Rosenfeld & Vanderbrug 1977; tracking paper, 4.3.2.)

    Raises
    ------
    ValueError
        If the template is larger than the window, or nothing is left of it after halving.
    """
    if min(template.shape) >> levels < 2:
        raise ValueError(f"a template of {template.shape} pixels cannot be halved {levels} times: 2 must be left")
    _check_fit(template, window)
    pyramid = [(template, window)]
    for _ in range(levels):
        pyramid.append((halved(pyramid[-1][0]), halved(pyramid[-1][1])))
    places, values = _local_maxima(normalized_correlation(*pyramid[-1]), candidates if levels else 1)
    for small, large in reversed(pyramid[:-1]):
        a, bright = kernels.centred(np.ascontiguousarray(small, dtype=np.float32))
        b = np.ascontiguousarray(large, dtype=np.float32)
        places, values = kernels.best_near(a, b, 2 * places, REACH_PX, _flat(small, bright))
    best = int(np.argmax(values))
    row, column = (int(i) for i in places[best])
    last = (window.shape[0] - template.shape[0], window.shape[1] - template.shape[1])
    return Peak(row, column, float(values[best]), row in (0, last[0]) or column in (0, last[1]))


def halved(image: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "_ _"]:
    """Means of 2 x 2 pixels; an odd last row or column is left out."""
    rows, columns = image.shape[0] // 2, image.shape[1] // 2
    even = np.ascontiguousarray(image[: 2 * rows, : 2 * columns])
    return np.asarray(cv2.resize(even, (columns, rows), interpolation=cv2.INTER_AREA))


def _check_fit(template: Float[np.ndarray, "_ _"], window: Float[np.ndarray, "_ _"]) -> None:
    if template.shape[0] > window.shape[0] or template.shape[1] > window.shape[1]:
        raise ValueError(f"a template of {template.shape} pixels does not fit into a window of {window.shape}")


def _flat(template: Float[np.ndarray, "_ _"], largest: float) -> float:
    """The energy below which a patch counts as flat, for values up to `largest`."""
    return kernels.FLAT_ENERGY * template.size * largest * largest


def _local_maxima(
    surface: Float[np.ndarray, "rows columns"], count: int
) -> tuple[Int[np.ndarray, "places 2"], Float[np.ndarray, " places"]]:
    """Row and column of the highest local maxima (of 3 x 3), at most `count`, the highest first."""
    maxima = np.argwhere(surface >= cv2.dilate(surface, np.ones((3, 3), np.uint8)))
    values = surface[maxima[:, 0], maxima[:, 1]]
    order = np.argsort(-values, kind="stable")[:count]
    return maxima[order], values[order]
