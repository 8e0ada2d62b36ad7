"""Compiled inversion of frame transfer; symbols and equations as in `marsyard.algorithms.image.frame_transfer`."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True)
def remove_frame_transfer(signal: Array, exposure: float, row_gain: float, sum_gain: float, total_gain: float) -> Array:
    """Solve ``y_R = row_gain x_R + sum_gain P_R + total_gain T`` for x, where y is the signal; return exposure * x."""
    rows, columns = signal.shape
    zero_total_sums = _solve_sums(signal, row_gain, sum_gain)
    unit_total_sums = _solve_sums(np.full((rows, 1), total_gain), row_gain, sum_gain)[:, 0]
    total = zero_total_sums[rows] / (1.0 + unit_total_sums[rows])
    exposure_signal = np.empty((rows, columns))
    for i in range(rows):
        for j in range(columns):
            sum_before = zero_total_sums[i, j] - unit_total_sums[i] * total[j]
            sum_after = zero_total_sums[i + 1, j] - unit_total_sums[i + 1] * total[j]
            exposure_signal[i, j] = exposure * (sum_after - sum_before)
    return exposure_signal


@njit(cache=True)
def _solve_sums(signal: Array, row_gain: float, sum_gain: float) -> Array:
    """Solve P_0 = 0, P_(R+1) = P_R + x_R with x_R = (y_R - sum_gain P_R) / row_gain; shape (rows + 1, columns)."""
    rows, columns = signal.shape
    gain, decay = 1.0 / row_gain, sum_gain / row_gain - 1.0
    sums = np.empty((rows + 1, columns))
    sums[0] = 0.0
    for i in range(rows):
        for j in range(columns):
            sums[i + 1, j] = gain * signal[i, j] - decay * sums[i, j]
    return sums
