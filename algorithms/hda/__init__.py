"""Hazard detection and avoidance from one moving camera (Johnson, Montgomery & Matthies, "Vision Guided Landing")."""

from marsyard.algorithms.hda.details import STAGES, Ground, HdaDetails, hda_products
from marsyard.algorithms.hda.estimator import HdaEstimator
from marsyard.algorithms.hda.hazards import ElevationMap, HazardMaps, Safety, hazard_maps, safe_site
from marsyard.algorithms.hda.motion import Motion
from marsyard.algorithms.hda.options import HdaOptions, SurfaceFrame, TrackSeed
from marsyard.algorithms.hda.structure import Matches, MatchStatus
from marsyard.algorithms.hda.tracking import Tracks

__all__ = ["STAGES", "ElevationMap", "Ground", "HazardMaps", "HdaDetails", "HdaEstimator", "HdaOptions", "MatchStatus"]
__all__ += ["Matches", "Motion", "Safety", "SurfaceFrame", "TrackSeed", "Tracks", "hazard_maps", "hda_products"]
__all__ += ["safe_site"]
