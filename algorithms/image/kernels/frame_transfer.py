"""Compiled inversion of frame transfer; symbols and equations as in `marsyard.algorithms.image.frame_transfer`."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True)
def remove_frame_transfer(signal: Array, exposure: float, row_gain: float, sum_gain: float, total_gain: float) -> Array:
    """Solve ``y_R = row_gain x_R + sum_gain P_R + total_gain T`` for x, where y is the signal; return exposure * x.

    P_R is the sum of x over the rows before R, and T the sum over all rows of a column. The solution is linear in T:
    P is `sums_without_total`, the solution for T = 0, minus T times `sums_per_total`, the decrease of P for T = 1.
    The last row, P_M = T, determines T.
    """
    rows, columns = signal.shape
    sums_without_total = _solve_sums(signal, row_gain, sum_gain)
    sums_per_total = _solve_sums(np.full((rows, 1), total_gain), row_gain, sum_gain)[:, 0]
    total = sums_without_total[rows] / (1.0 + sums_per_total[rows])
    exposure_signal = np.empty((rows, columns))
    for i in range(rows):
        for j in range(columns):
            sum_before = sums_without_total[i, j] - sums_per_total[i] * total[j]
            sum_after = sums_without_total[i + 1, j] - sums_per_total[i + 1] * total[j]
            exposure_signal[i, j] = exposure * (sum_after - sum_before)
    return exposure_signal


@njit(cache=True)
def _solve_sums(signal: Array, row_gain: float, sum_gain: float) -> Array:
    """Solve P_0 = 0, P_(R+1) = P_R + x_R with x_R = (y_R - sum_gain P_R) / row_gain; return P_0 to P_M.

    The result has the shape (rows + 1, columns).
    """
    rows, columns = signal.shape
    gain, decay = 1.0 / row_gain, sum_gain / row_gain - 1.0
    sums = np.empty((rows + 1, columns))
    sums[0] = 0.0
    for i in range(rows):
        for j in range(columns):
            sums[i + 1, j] = gain * signal[i, j] - decay * sums[i, j]
    return sums
