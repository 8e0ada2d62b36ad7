"""Conversion of the intermediate products of hazard detection to plain arrays, for storage and figures.

Figures are those of Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

from typing import Any

import numpy as np

from marsyard.algorithms.hda.details import HdaDetails, MappedGround
from marsyard.algorithms.hda.scene import CameraView, points_at_depth, undistort


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
