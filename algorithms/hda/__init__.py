"""Hazard detection and avoidance from one moving camera (Johnson, Montgomery & Matthies, "Vision Guided Landing")."""

from marsyard.algorithms.hda.elevation import ElevationMap
from marsyard.algorithms.hda.estimator import HdaEstimator
from marsyard.algorithms.hda.hazards import HazardMaps, Safety, hazard_maps, safe_site
from marsyard.algorithms.hda.motion import CameraMotion
from marsyard.algorithms.hda.options import HdaOptions, SurfaceFrame, TrackSeed
from marsyard.algorithms.hda.products import STAGES, HdaDetails, MappedGround, hda_products
from marsyard.algorithms.hda.structure import Matches, MatchStatus
from marsyard.algorithms.hda.tracking import Tracks

__all__ = [
    "STAGES", "CameraMotion", "ElevationMap", "HazardMaps", "HdaDetails", "HdaEstimator", "HdaOptions", "MappedGround",
    "MatchStatus", "Matches", "Safety", "SurfaceFrame", "TrackSeed", "Tracks", "hazard_maps", "hda_products",
    "safe_site",
]  # fmt: skip
