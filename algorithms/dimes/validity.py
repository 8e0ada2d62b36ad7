"""Checks of tracks: the validity metrics (section II.A) and the agreement with the IMU (section II.B).

Sections are those of Johnson et al., "Field Testing of the MER DIMES".
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import product

import numpy as np
from jaxtyping import Float

from marsyard.algorithms.arrays import Raster, Vector2
from marsyard.algorithms.dimes.options import DimesOptions
from marsyard.algorithms.image.peaks import Peak, peak_width, second_peak


class ValidityCheck(Enum):
    """Validity checks of a track; each value describes the failure."""

    CONTRAST = "too little contrast in the template"
    PEAK_HEIGHT = "correlation peak too low"
    PEAK_WIDTH = "correlation peak too wide"
    SECOND_PEAK = "second peak almost as high as the first"
    SEARCH_BORDER = "correlation highest on the border of the search range"


@dataclass(frozen=True)
class TrackMetrics:
    """Validity metrics of a track, which `failed_checks` compares with the limits in the options (section II.A).

    - contrast: Harris interest of the template divided by its mean signal, per binned pixel
    - peak: Height of the correlation peak, at most 1
    - peak_width_px: Full width of the peak at three quarters of its height, in its longest direction, rectified pixels
    - second_peak_ratio: Second-highest local maximum divided by the peak; 1 without a positive peak
    - on_border: Whether the highest correlation lies on the border of the search range, or next to a position where the
      second image does not show the complete template
    """

    contrast: float
    peak: float
    peak_width_px: float
    second_peak_ratio: float
    on_border: bool


def track_metrics(contrast: float, surface: Raster, peak: Peak, options: DimesOptions) -> TrackMetrics:
    """Compute the metrics from a correlation surface and its template's contrast."""
    second = second_peak(surface, peak, options.second_peak_exclusion_px)
    return TrackMetrics(
        contrast=contrast,
        peak=peak.value,
        peak_width_px=peak_width(surface, peak),
        second_peak_ratio=second / peak.value if peak.value > 0.0 else 1.0,
        on_border=peak.on_border,
    )


def failed_checks(metrics: TrackMetrics, options: DimesOptions) -> tuple[ValidityCheck, ...]:
    """Return the failed checks; empty for a valid track."""
    failures = {
        ValidityCheck.CONTRAST: not metrics.contrast >= options.min_contrast,
        ValidityCheck.PEAK_HEIGHT: not metrics.peak >= options.min_peak,
        ValidityCheck.PEAK_WIDTH: not metrics.peak_width_px <= options.max_peak_width_px,
        ValidityCheck.SECOND_PEAK: not metrics.second_peak_ratio <= options.max_second_peak_ratio,
        ValidityCheck.SEARCH_BORDER: metrics.on_border,
    }
    return tuple(check for check, failed in failures.items() if failed)


@dataclass(frozen=True)
class Combination:
    """One track of the first pair and one of the second pair (indices), and their discrepancy from the IMU.

    The discrepancy is the length of the difference between the tracks' and the IMU's horizontal velocity change.
    """

    first: int
    second: int
    discrepancy_m_s: float


def rank_combinations(
    first: Sequence[tuple[int, Vector2]],
    second: Sequence[tuple[int, Vector2]],
    interval_velocities_m_s: Float[np.ndarray, "2 3"],
) -> tuple[Combination, ...]:
    """Combine all valid tracks (index, velocity) of the first and the second pair; best agreement with the IMU first.

    `interval_velocities_m_s` are the IMU's mean velocities over both pairs.
    """
    change = (interval_velocities_m_s[1] - interval_velocities_m_s[0])[:2]
    combinations = [
        Combination(first_index, second_index, float(np.hypot(*(second_velocity - first_velocity - change))))
        for (first_index, first_velocity), (second_index, second_velocity) in product(first, second)
    ]
    return tuple(sorted(combinations, key=lambda combination: combination.discrepancy_m_s))
