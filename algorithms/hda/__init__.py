"""Hazard detection and avoidance from one moving camera (Johnson, Montgomery & Matthies, sections II and III)."""

from algorithms.hda.details import STAGES, Ground, HdaDetails, hda_products
from algorithms.hda.elevation import ElevationMap
from algorithms.hda.estimator import HdaEstimator
from algorithms.hda.hazards import HazardMaps, Safety, hazard_maps, safe_site
from algorithms.hda.motion import Motion
from algorithms.hda.options import HdaOptions, SurfaceFrame, TrackSeed
from algorithms.hda.structure import Fate, Matches
from algorithms.hda.tracking import Tracks

__all__ = [
    "STAGES",
    "ElevationMap",
    "Fate",
    "Ground",
    "HazardMaps",
    "HdaDetails",
    "HdaEstimator",
    "HdaOptions",
    "Matches",
    "Motion",
    "Safety",
    "SurfaceFrame",
    "TrackSeed",
    "Tracks",
    "hazard_maps",
    "hda_products",
    "safe_site",
]
