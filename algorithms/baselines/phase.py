"""Phase correlation of rectified pictures, as OpenCV has it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import cv2
import numpy as np

from marsyard.algorithms.baselines.pairs import COMMON, CommonOptions, PairMatch, PairPatches, estimate_by_pairs
from marsyard.algorithms.interface import VelocityEstimate
from marsyard.sim.measurements import DescentMeasurements


@dataclass(frozen=True)
class PhaseCorrelationOptions:
    """Options of the estimator.

    Attributes
    ----------
    common
        Geometry and IMU check.
    min_response
        Least response: the peak's energy, 1 for equal pictures. Pictures of different ground gave up to 0.12, shifted
        ones with the flight camera's noise 0.79 and above.
    """

    common: CommonOptions = COMMON
    min_response: float = 0.25


@final
class PhaseCorrelationEstimator:
    """Horizontal velocity from the shift between rectified pictures, by `cv2.phaseCorrelate` under a Hann window."""

    def __init__(self, options: PhaseCorrelationOptions | None = None) -> None:
        self.options = PhaseCorrelationOptions() if options is None else options

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """The estimate; its details are `BaselineDetails`. Raises as `DimesEstimator.estimate` does."""
        return estimate_by_pairs(measurements, self._match, self.options.common)

    def _match(self, patches: PairPatches) -> PairMatch | None:
        first, second = patches.first, patches.second
        if np.ptp(first) == 0.0 or np.ptp(second) == 0.0:
            return None
        window = cv2.createHanningWindow((first.shape[1], first.shape[0]), cv2.CV_64F)
        shift, response = cv2.phaseCorrelate(first - first.mean(), second - second.mean(), window)
        return PairMatch(np.array(shift, dtype=np.float64), float(response), response >= self.options.min_response)
