"""Size of a change at which a failure rate reaches a limit."""

import math
from dataclasses import dataclass

import numpy as np

from marsyard.reports.statistics.weighted import MIN_EFFECTIVE, Changes, WeightedRates

#: Rounding error of a rate that is compared with a limit.
_ROUNDING = 1e-12


@dataclass(frozen=True)
class Crossing:
    """Sizes of a change at which upper bound (`lower`), estimate (`change`) and lower bound (`upper`) reach a limit.

    - lower: `reach` if the upper bound stays below the limit; NaN if it exceeds the limit without a change
    - change, upper: NaN if they do not reach the limit
    - reach: largest size with `MIN_EFFECTIVE` effective units; effective_cases: their number at `change`, or at `reach`
    """

    change: float
    lower: float
    upper: float
    reach: float
    effective_cases: float


def find_crossing(sizes: Changes, rates: WeightedRates, limit: float, *, decides_by_rate: bool = False) -> Crossing:
    """Find the sizes of a change at which the failure rate reaches a limit, by linear interpolation.

    decides_by_rate: whether `lower` is that of the estimate
    """
    # the tolerance is for rounding errors of the largest size
    is_usable = np.logical_and.accumulate(np.nan_to_num(rates.effective_units) >= MIN_EFFECTIVE * (1.0 - 1e-9))
    count = int(is_usable.sum())
    if not count:
        return Crossing(math.nan, math.nan, math.nan, 0.0, float(rates.effective_units[0]))
    reach = float(sizes[count - 1])
    lost, change, shown = (
        _first_above(sizes[:count], values[:count], limit)
        for values in (rates.estimate if decides_by_rate else rates.upper, rates.estimate, rates.lower)
    )
    lower = math.nan if lost == 0.0 else reach if math.isnan(lost) else lost
    size = reach if math.isnan(change) else change
    return Crossing(change, lower, shown, reach, float(np.interp(size, sizes, rates.effective_units)))


def _first_above(sizes: Changes, values: Changes, limit: float) -> float:
    """Find the smallest size whose value exceeds a limit, by linear interpolation; NaN if there is none."""
    above = np.flatnonzero(values > limit + _ROUNDING)
    if not above.size:
        return math.nan
    last = int(above[0])
    if last == 0:
        return 0.0
    return float(np.interp(limit, values[last - 1 : last + 1], sizes[last - 1 : last + 1]))
