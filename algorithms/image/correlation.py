"""Pseudo-normalised correlation of a template with every place in a window."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import fft

from marsyard.algorithms.image.kernels import correlation as kernels

#: Energy of a patch, relative to that of its brightest value, below which it is rounding and counts as flat.
FLAT_ENERGY = 1e-12


def cross_sums(template: Float[np.ndarray, "_ _"], window: Float[np.ndarray, "_ _"]) -> Float[np.ndarray, "_ _"]:
    """Sums of products of the template with the window at every place where it fits, by FFT.

    The transform is as large as the window: what wraps around falls on places where the template does not fit.
    """
    shape = (fft.next_fast_len(window.shape[0], real=True), fft.next_fast_len(window.shape[1], real=True))
    spectrum = fft.rfft2(window, shape) * np.conj(fft.rfft2(template, shape))
    products = fft.irfft2(spectrum, shape)
    return np.asarray(products[: window.shape[0] - template.shape[0] + 1, : window.shape[1] - template.shape[1] + 1])


def pseudo_normalized_correlation(
    template: Float[np.ndarray, "n m"], window: Float[np.ndarray, "rows columns"]
) -> Float[np.ndarray, "_ _"]:
    """``2 sum(A B) / (sum(A A) + sum(B B))`` with A the template and B the window's patch, each less its own mean.

    Entry (i, j) belongs to the patch whose upper left pixel is (i, j) of the window; the shape is (rows - n + 1,
    columns - m + 1). Values lie in [-1, 1], 1 for equal patches up to a constant; unlike normalised correlation it
    falls when the contrasts of the two differ. Zero where neither has contrast. (DIMES, section II.A.)
    """
    scale = max(float(np.abs(template).max()), float(np.abs(window).max()))
    a = template - template.mean(dtype=np.float64)
    b = np.ascontiguousarray(window - window.mean(dtype=np.float64))
    cross = np.ascontiguousarray(cross_sums(a, b))
    floor = FLAT_ENERGY * template.size * scale * scale
    return np.asarray(kernels.pseudo_normalized(cross, b, template.shape, float(np.sum(a * a)), floor))
