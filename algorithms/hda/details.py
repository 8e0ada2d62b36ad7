"""Intermediate products of hazard detection (paper: Figs. 1-5 and 7).

Figures and Table I are those of Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from marsyard.algorithms.hda.elevation import ElevationMap
from marsyard.algorithms.hda.hazards import HazardMaps
from marsyard.algorithms.hda.motion import CameraMotion
from marsyard.algorithms.hda.scene import Views
from marsyard.algorithms.hda.structure import Matches
from marsyard.algorithms.hda.tracking import Tracks

#: Stages of Table I, in order. "motion" includes the scale, "hazards" the elevation map.
STAGES = ("tracking", "motion", "structure", "hazards")


@dataclass(frozen=True)
class MappedGround:
    """Maps of the ground, and the selected site.

    - surface_from_camera: Rotation from the first camera's frame to the surface frame; both origins are at that camera
    - world_from_surface: Rotation about the vertical from the surface frame to the world frame, from the on-board pose
    - points: The point cloud in the surface frame, metres
    - elevation, hazards: Elevation map of these points, and its maps of slope, roughness and safety
    - apriori_cell: Row and column of the a-priori site, fractional, possibly outside the map
    - site_cell: Row and column of the selected site; None if no cell is safe
    """

    surface_from_camera: Rotation
    world_from_surface: Rotation
    points: Float[np.ndarray, "n 3"]
    elevation: ElevationMap
    hazards: HazardMaps
    apriori_cell: Float[np.ndarray, "2"]
    site_cell: tuple[int, int] | None


@dataclass(frozen=True)
class HdaDetails:
    """Intermediate products of `HdaEstimator`, returned as `SiteEstimate.details`; None for stages that did not run.

    - views: The two images with their cameras and on-board poses
    - motion: Camera motion, and depths of the accepted tracks; scaled by the laser altimeter if there are matches
    - ends_s: Processor time at the start, and at the end of every completed stage of `STAGES`
    """

    views: Views
    tracks: Tracks | None = None
    motion: CameraMotion | None = None
    matches: Matches | None = None
    ground: MappedGround | None = None
    ends_s: tuple[float, ...] = field(default_factory=lambda: (time.process_time(),))

    def end_stage(self, **products: Any) -> HdaDetails:
        """Return the details with the products of a stage and its end time (now)."""
        return replace(self, **products, ends_s=(*self.ends_s, time.process_time()))

    @property
    def times_s(self) -> Mapping[str, float]:
        """Processor time of each completed stage."""
        durations = np.diff(self.ends_s)
        return {name: float(duration) for name, duration in zip(STAGES, durations, strict=False)}
