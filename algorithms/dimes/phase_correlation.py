"""Baseline velocity estimator: phase correlation (OpenCV) of rectified images."""

from dataclasses import dataclass
from typing import final

import cv2
import numpy as np

from marsyard.algorithms.dimes.baselines import (
    DEFAULT_COMMON_OPTIONS,
    CommonOptions,
    PairMatch,
    PairPatches,
    estimate_by_pairs,
)
from marsyard.algorithms.interface import VelocityEstimate
from marsyard.sim.measurements import DescentMeasurements


@dataclass(frozen=True)
class PhaseCorrelationOptions:
    """Options of the phase correlation.

    - common: Geometry and IMU check
    - min_response: Minimum response of `cv2.phaseCorrelate`: energy of the peak, 1 for equal images. Image pairs
      of different ground had up to 0.12; shifted images with the flight camera's noise had at least 0.79.
    """

    common: CommonOptions = DEFAULT_COMMON_OPTIONS
    min_response: float = 0.25


@final
class PhaseCorrelationEstimator:
    """Baseline velocity estimator: shift between rectified images by `cv2.phaseCorrelate` with a Hann window."""

    def __init__(self, options: PhaseCorrelationOptions | None = None) -> None:
        self.options = PhaseCorrelationOptions() if options is None else options

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """Estimate the velocity, with `BaselineDetails`. Raises the same errors as `DimesEstimator.estimate`."""
        return estimate_by_pairs(measurements, self._match, self.options.common)

    def _match(self, patches: PairPatches) -> PairMatch | None:
        """Return the shift and the response; None if a patch is uniform."""
        first, second = patches.first, patches.second
        if np.ptp(first) == 0.0 or np.ptp(second) == 0.0:
            return None
        window = cv2.createHanningWindow((first.shape[1], first.shape[0]), cv2.CV_64F)
        shift, response = cv2.phaseCorrelate(first - first.mean(), second - second.mean(), window)
        return PairMatch(np.array(shift, dtype=np.float64), float(response), response >= self.options.min_response)
