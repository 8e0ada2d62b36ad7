"""DIMES: horizontal velocity from three descent pictures (Johnson, Willson, Goguen, Alexander & Meller, section II)."""

from algorithms.dimes.consistency import Combination, propagated
from algorithms.dimes.details import DimesDetails, PairDetails, Track, dimes_products
from algorithms.dimes.estimator import DimesEstimator
from algorithms.dimes.options import DimesOptions
from algorithms.dimes.validity import TrackMetrics, ValidityCheck

__all__ = [
    "Combination",
    "DimesDetails",
    "DimesEstimator",
    "DimesOptions",
    "PairDetails",
    "Track",
    "TrackMetrics",
    "ValidityCheck",
    "dimes_products",
    "propagated",
]
