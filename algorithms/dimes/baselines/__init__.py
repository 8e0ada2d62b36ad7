"""Baseline velocity estimators to compare with DIMES: image registration with OpenCV, with the same interface."""

from marsyard.algorithms.dimes.baselines.homography import HomographyEstimator, HomographyOptions
from marsyard.algorithms.dimes.baselines.pairs import (
    BaselineDetails,
    PairMatch,
    PairPatches,
    PhaseCorrelationEstimator,
    PhaseCorrelationOptions,
)

__all__ = ["BaselineDetails", "HomographyEstimator", "HomographyOptions", "PairMatch", "PairPatches"]
__all__ += ["PhaseCorrelationEstimator", "PhaseCorrelationOptions"]
