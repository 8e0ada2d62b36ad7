"""Features spread evenly over the first picture (section II.A)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt16

from marsyard.algorithms.hda.options import HdaOptions
from marsyard.algorithms.hda.pyramid import reach_px
from marsyard.algorithms.image.interest import structure_tensor


def eigenvalue_test(
    image: Float[np.ndarray, "rows columns"], support: int, min_eigenvalue: float
) -> Float[np.ndarray, "rows columns"]:
    """P of Eq. 2 where both eigenvalues of the structure tensor exceed the least one, minus infinity elsewhere.

    P is (a - l)(c - l) - b b with a > l (Benedetti & Perona 1998): the product of what the eigenvalues exceed l by. The
    tensor is the mean, not the sum, over `support` x `support` pixels (Eq. 1 divided by their number).
    """
    a, c, b = structure_tensor(image, support)
    p = (a - min_eigenvalue) * (c - min_eigenvalue) - b * b
    return np.asarray(np.where((p > 0.0) & (a > min_eigenvalue), p, -np.inf), dtype=np.float32)


def select_features(counts: UInt16[np.ndarray, "rows columns"], options: HdaOptions) -> Float[np.ndarray, "n 2"]:
    """Pixels (u, v) of the best feature in each block that has one, block by block along rows.

    Features keep from the picture's border what their template needs at every level of the pyramid.
    """
    interest = eigenvalue_test(counts.astype(np.float32), 2 * options.template_half_px + 1, options.min_eigenvalue)
    border = reach_px(options)
    interest[:border] = interest[-border:] = -np.inf
    interest[:, :border] = interest[:, -border:] = -np.inf
    blocks = _blocks(interest, options.block_px)
    best = blocks.reshape(*blocks.shape[:2], -1).argmax(axis=-1)
    row, column = (i * options.block_px for i in np.indices(best.shape))
    row, column = row + best // options.block_px, column + best % options.block_px
    found = np.isfinite(blocks.max(axis=(2, 3)))
    return np.column_stack([column[found], row[found]]).astype(np.float64)


def _blocks(values: Float[np.ndarray, "rows columns"], side: int) -> Float[np.ndarray, "m n side side"]:
    """The array cut into squares, indexed by square and place in it; filled up with minus infinity."""
    rows, columns = values.shape
    filled = np.pad(values, ((0, -rows % side), (0, -columns % side)), constant_values=-np.inf)
    cut = filled.reshape(filled.shape[0] // side, side, filled.shape[1] // side, side)
    return np.ascontiguousarray(cut.swapaxes(1, 2))
