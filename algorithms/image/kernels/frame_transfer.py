"""Compiled inversion of the frame transfer; see `marsyard.algorithms.image.frame_transfer`."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True)
def remove_frame_transfer(signal: Array, exposure: float, row_gain: float, before: float, of_total: float) -> Array:
    """Return the signal of the exposure alone, where ``y_R = row_gain x_R + before P_R + of_total T`` is `signal`."""
    rows, columns = signal.shape
    for_no_total = _sums(signal, row_gain, before)
    per_total = _sums(np.full((rows, 1), of_total), row_gain, before)[:, 0]
    total = for_no_total[rows] / (1.0 + per_total[rows])
    exposed = np.empty((rows, columns))
    for i in range(rows):
        for j in range(columns):
            until = for_no_total[i, j] - per_total[i] * total[j]
            after = for_no_total[i + 1, j] - per_total[i + 1] * total[j]
            exposed[i, j] = exposure * (after - until)
    return exposed


@njit(cache=True)
def _sums(signal: Array, row_gain: float, before: float) -> Array:
    """P_0 = 0, P_(R+1) = P_R + x_R with x_R = (y_R - before P_R) / row_gain, shape (rows + 1, columns)."""
    rows, columns = signal.shape
    gain, decay = 1.0 / row_gain, before / row_gain - 1.0
    sums = np.empty((rows + 1, columns))
    sums[0] = 0.0
    for i in range(rows):
        for j in range(columns):
            sums[i + 1, j] = gain * signal[i, j] - decay * sums[i, j]
    return sums
