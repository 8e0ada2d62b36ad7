"""Removal of the frame-transfer smear of a camera without shutter ("Field Testing of the MER DIMES", section II.A).

Without a shutter a charge packet collects light in every row that it passes. The packet of physical row r passes rows
r+1 .. N-1 while the detector is cleared before the exposure (`clear_row_s` in each), and rows r-1 .. 0 during the
readout (`transfer_row_s` in each). n physical rows are summed into a delivered row. They are assumed to be equally
bright, x_R counts per second each. The mean signal y_R of the n packets of delivered row R (of M rows) is

    y_R = (t + (n-1)/2 (a + b)) x_R + n a P_R + n b (T - P_R - x_R)

where t is the exposure time, a and b are the transfer and clear times per row, P_R is the sum of x over the delivered
rows before R, and T the sum over all delivered rows. Within its delivered row a packet passes (n-1)/2 physical rows on
average in each direction. For known T this is a linear recursion in P. T follows from P_M = T, which is linear in T.
"""

import numpy as np
import scipy  # scipy.signal is slow to import: it is loaded at its first use
from jaxtyping import Float

from marsyard.algorithms.arrays import Raster
from marsyard.sim.measurements import DetectorCalibration


def remove_frame_transfer(signal: Raster, calibration: DetectorCalibration, rows_summed: int) -> Raster:
    """Compute the signal of the exposure alone, in the units of `signal`.

    `signal` contains counts above the offset, all rows of one or more columns; `rows_summed` is the number of physical
    rows per delivered row. The inversion is exact for a static scene that is constant within each delivered row; it is
    the identity without frame transfer. Raises ValueError if the exposure is too short compared with the row times.
    """
    n, a, b = rows_summed, calibration.transfer_row_s, calibration.clear_row_s
    if a == 0.0 and b == 0.0:
        return signal
    row_gain = calibration.exposure_s + 0.5 * (n - 1) * (a + b) - n * b
    sum_gain = n * (a - b)
    # The factor of the recursion, 1 - sum_gain / row_gain, must lie between -1 and 3. Otherwise errors grow with
    # alternating sign, or by more than a factor of 3 per row.
    if row_gain <= 0.5 * abs(sum_gain):
        raise ValueError(
            f"an exposure of {calibration.exposure_s} s is too short to invert a frame transfer of "
            f"{a} s and {b} s per row with {n} rows summed"
        )
    values = np.asarray(signal, dtype=np.float64)
    # P is the solution for T = 0 minus T times `decrease`, the decrease of P for T = 1
    sums_without_total = _sums_before(values, row_gain, sum_gain)
    decrease = _sums_before(np.full((len(values), 1), n * b), row_gain, sum_gain)
    sums = sums_without_total - decrease * (sums_without_total[-1] / (1.0 + decrease[-1]))
    return np.asarray(calibration.exposure_s * np.diff(sums, axis=0))


def _sums_before(signal: Raster, row_gain: float, sum_gain: float) -> Float[np.ndarray, "sums columns"]:
    """Solve P_0 = 0, P_(R+1) = P_R + x_R with x_R = (y_R - sum_gain P_R) / row_gain; return P_0 to P_M."""
    sums = scipy.signal.lfilter([1.0 / row_gain], [1.0, sum_gain / row_gain - 1.0], signal, axis=0)
    return np.concatenate([np.zeros((1, signal.shape[1])), sums])
