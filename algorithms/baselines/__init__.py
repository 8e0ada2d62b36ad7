"""What a user would take instead of DIMES: ready-made image registration behind the same interface."""

from algorithms.baselines.homography import HomographyEstimator, HomographyOptions
from algorithms.baselines.pairs import BaselineDetails, PairMatch, PairPatches
from algorithms.baselines.phase import PhaseCorrelationEstimator, PhaseCorrelationOptions

__all__ = [
    "BaselineDetails",
    "HomographyEstimator",
    "HomographyOptions",
    "PairMatch",
    "PairPatches",
    "PhaseCorrelationEstimator",
    "PhaseCorrelationOptions",
]
