"""Intermediate products of hazard detection (paper: Figs. 1-5 and 7), and their conversion to plain arrays.

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
from marsyard.algorithms.hda.scene import CameraView, Views, points_at_depth, undistort
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


def hda_products(details: HdaDetails) -> dict[str, Any]:
    """Convert the details to plain arrays, for storage and figures; stages that did not run are omitted.

    Keys, pixels (u, v), lengths in metres, angles in radians:

    - Fig. 1: `features`, `tracked`, `correlations`, `tracks_accepted`;
    - Fig. 2: `rotation` and `translation` (second from first camera), `sparse_points` (of the accepted tracks, first
      camera's frame), `residuals_px`, `inliers`, `frustum_0` and `frustum_1` (rays of each image's corners in its
      camera's frame, at unit depth);
    - Fig. 3: `grid`, `segment_starts`, `segment_ends`, `matched`, `matches_accepted`;
    - Fig. 4: `points`, `elevation`, `corner`, `cell` (surface frame);
    - Figs. 5 and 7: `smooth`, `roughness`, `slope`, `safety` (values of `Safety`), `site` and `apriori` (row, column;
      the site empty for none), `map_pixels` (pixels of the first image of every cell's centre at its elevation),
      `surface_from_camera` and `world_from_surface` (matrices).
    """
    products: dict[str, Any] = {}
    if details.tracks is not None:
        tracks = details.tracks
        products |= {"features": tracks.first, "tracked": tracks.second, "correlations": tracks.correlations}
        products["tracks_accepted"] = tracks.accepted
    if details.tracks is not None and details.motion is not None:
        motion = details.motion
        coordinates = undistort(details.views[0].camera, details.tracks.first[details.tracks.accepted])
        products["rotation"] = motion.second_from_first.rotation.as_matrix()
        products["translation"] = motion.second_from_first.translation
        products["sparse_points"] = points_at_depth(coordinates, motion.depths)
        products |= {"residuals_px": motion.residuals_px, "inliers": motion.inliers}
        for number, view in enumerate(details.views):
            rays = view.camera.corner_rays()[1]
            products[f"frustum_{number}"] = rays / rays[:, 2:]
    if details.matches is not None:
        matches = details.matches
        products |= {"grid": matches.first, "segment_starts": matches.starts, "segment_ends": matches.ends}
        products |= {"matched": matches.second, "matches_accepted": matches.accepted}
    if details.ground is not None:
        products |= _ground_products(details.views[0], details.ground)
    return products


def _ground_products(first: CameraView, ground: MappedGround) -> dict[str, Any]:
    """Return the products of Figs. 4, 5 and 7."""
    elevation = ground.elevation
    shape = elevation.elevation_m.shape
    positions = elevation.positions(np.moveaxis(np.indices(shape).astype(np.float64), 0, -1))
    centres = np.concatenate([positions, elevation.elevation_m[..., None]], axis=-1).reshape(-1, 3)
    pixels, _ = first.camera.project(ground.surface_from_camera.inv().apply(centres))
    return {
        "points": ground.points,
        "elevation": elevation.elevation_m,
        "corner": elevation.corner_m,
        "cell": np.array([elevation.cell_m]),
        "smooth": ground.hazards.smooth_m,
        "roughness": ground.hazards.roughness_m,
        "slope": ground.hazards.slope_rad,
        "safety": ground.hazards.safety,
        "site": np.array(() if ground.site_cell is None else ground.site_cell, dtype=np.float64),
        "apriori": ground.apriori_cell,
        "map_pixels": pixels.reshape(*shape, 2),
        "surface_from_camera": ground.surface_from_camera.as_matrix(),
        "world_from_surface": ground.world_from_surface.as_matrix(),
    }
