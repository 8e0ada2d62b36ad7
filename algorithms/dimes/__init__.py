"""DIMES: horizontal velocity from three descent images ("Field Testing of the MER DIMES", section II)."""

from marsyard.algorithms.dimes.estimator import DimesEstimator, propagate_velocity
from marsyard.algorithms.dimes.options import DimesOptions
from marsyard.algorithms.dimes.products import DimesDetails, DimesTrack, PairDetails, dimes_products
from marsyard.algorithms.dimes.tilt import GroundFit
from marsyard.algorithms.dimes.validity import Combination, TrackMetrics, ValidityCheck

__all__ = [
    "Combination", "DimesDetails", "DimesEstimator", "DimesOptions", "DimesTrack", "GroundFit", "PairDetails",
    "TrackMetrics", "ValidityCheck", "dimes_products", "propagate_velocity",
]  # fmt: skip
