"""Validity of a track: the four metrics of section II.A and their thresholds."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from jaxtyping import Float

from marsyard.algorithms.dimes.options import DimesOptions
from marsyard.algorithms.image.peak import Peak, peak_width, second_peak


class ValidityCheck(Enum):
    """What a track can fail."""

    CONTRAST = "too little contrast in the template"
    PEAK_HEIGHT = "correlation peak too low"
    PEAK_WIDTH = "correlation peak too wide"
    SECOND_PEAK = "second peak too near to the first in height"
    SEARCH_BORDER = "correlation highest on the border of the search range"


@dataclass(frozen=True)
class TrackMetrics:
    """What the validity of a track is judged by.

    Attributes
    ----------
    contrast
        Harris interest of the template divided by its mean signal, per binned pixel (see `selection.contrasts`).
    peak
        Height of the correlation peak, at most 1.
    peak_width_px
        Its full width at three quarters of its height along its longest direction, rectified pixels.
    second_peak_ratio
        Second highest local maximum over the peak; 1 where there is no positive peak.
    on_border
        Whether the highest correlation lies on the border of the search range: then it is no peak.
    """

    contrast: float
    peak: float
    peak_width_px: float
    second_peak_ratio: float
    on_border: bool


def track_metrics(
    contrast: float, surface: Float[np.ndarray, "rows columns"], peak: Peak, options: DimesOptions
) -> TrackMetrics:
    """The metrics of a correlation surface and the contrast of its template."""
    second = second_peak(surface, peak, options.second_peak_exclusion_px)
    return TrackMetrics(
        contrast=contrast,
        peak=peak.value,
        peak_width_px=peak_width(surface, peak),
        second_peak_ratio=second / peak.value if peak.value > 0.0 else 1.0,
        on_border=peak.on_border,
    )


def failed_checks(metrics: TrackMetrics, options: DimesOptions) -> tuple[ValidityCheck, ...]:
    """The checks that the metrics fail, none for a valid track."""
    failures = {
        ValidityCheck.CONTRAST: not metrics.contrast >= options.min_contrast,
        ValidityCheck.PEAK_HEIGHT: not metrics.peak >= options.min_peak,
        ValidityCheck.PEAK_WIDTH: not metrics.peak_width_px <= options.max_peak_width_px,
        ValidityCheck.SECOND_PEAK: not metrics.second_peak_ratio <= options.max_second_peak_ratio,
        ValidityCheck.SEARCH_BORDER: metrics.on_border,
    }
    return tuple(check for check, failed in failures.items() if failed)
