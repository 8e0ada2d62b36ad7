"""Compiled kernel of pinhole views: metres from OpenGL's depths."""

from __future__ import annotations

import numpy as np
from numba import njit

from marsyard.sim.render.kernels.structs import Array32


@njit(cache=True, error_model="numpy")
def metres(drawn: Array32, near: float, far: float) -> Array32:
    """Depth along a view's axis, 0 where nothing was drawn, from OpenGL's, whose lowest row is the first: turned over.

    Parameters
    ----------
    drawn
        From 0 to 1, shape (rows, columns); 1 where nothing is.
    near, far
        Depths that are 0 and 1, metres.
    """
    rows, columns = drawn.shape
    depth = np.empty((rows, columns), dtype=np.float32)
    # single precision from the first to the last
    minus_two, one, nothing = np.float32(-2.0), np.float32(1.0), np.float32(0.0)
    span, both, product = np.float32(far - near), np.float32(far + near), np.float32(2.0 * near * far)
    for i in range(rows):
        line, above = drawn[rows - 1 - i], depth[i]
        for j in range(columns):
            value = product / ((minus_two * line[j] + one) * span + both)
            above[j] = nothing if line[j] == one else value
    return depth
