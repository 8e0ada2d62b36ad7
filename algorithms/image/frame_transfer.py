"""Removal of the frame-transfer ramp of a camera without shutter (DIMES paper, section II.A).

Without a shutter a charge packet gathers light under every row that it passes. A packet that ends as physical row r
passes under rows r+1 .. N-1 while the detector is cleared before the exposure (`clear_row_s` under each) and under rows
r-1 .. 0 on its way out (`transfer_row_s` under each). n physical rows are summed into a delivered row; let them be
equally bright, x_R counts per second each. Averaged over the n packets, a delivered row R of M is (divided by n)

    y_R = (t + (n-1)/2 (a + b)) x_R + n a P_R + n b (T - P_R - x_R)

with t the exposure time, a and b the transfer and clear times per row, P_R the sum of x over the rows before R, and T
the sum over all rows: within the delivered row the packets pass (n-1)/2 of its own rows on average in each direction.
Given T this is a linear recursion in P; T itself follows because P_M = T is linear in T.
"""

from __future__ import annotations

import numpy as np

from marsyard.algorithms.arrays import Raster
from marsyard.algorithms.image.kernels import frame_transfer as kernels
from marsyard.sim.measurements import DetectorCalibration


def remove_frame_transfer(signal: Raster, calibration: DetectorCalibration, rows_summed: int) -> Raster:
    """The signal of the exposure alone, in the units of `signal`, from whole columns of a delivered image.

    `signal` holds counts above the offset, all rows, any columns; `rows_summed` physical rows per row. The inversion is
    exact for a static scene that is constant within each delivered row. Without frame transfer it is the identity.
    Raises ValueError if the exposure is too short against the row times.
    """
    n, a, b = rows_summed, calibration.transfer_row_s, calibration.clear_row_s
    if a == 0.0 and b == 0.0:
        return signal
    own = calibration.exposure_s + 0.5 * (n - 1) * (a + b) - n * b
    before = n * (a - b)
    if own <= 0.5 * abs(before):
        raise ValueError(
            f"an exposure of {calibration.exposure_s} s is too short to invert a frame transfer of "
            f"{a} s and {b} s per row with {n} rows summed"
        )
    values = np.ascontiguousarray(signal, dtype=np.float64)
    return np.asarray(kernels.remove_frame_transfer(values, calibration.exposure_s, own, before, n * b))
