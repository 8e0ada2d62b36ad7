"""Landing site estimator: hazard detection and avoidance from two images of one moving camera (sections II and III).

Sections are those of Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

from collections.abc import Callable
from dataclasses import replace
from typing import final

import numpy as np

from marsyard.algorithms.arrays import Points2, Points3, Vector3
from marsyard.algorithms.hda import hazards
from marsyard.algorithms.hda.elevation import elevation_map, fill_small_holes
from marsyard.algorithms.hda.motion import CameraMotion, MotionStart, estimate_motion, plane_depths, range_starts
from marsyard.algorithms.hda.options import HdaOptions, TrackSeed
from marsyard.algorithms.hda.products import HdaDetails, MappedGround
from marsyard.algorithms.hda.scene import (
    LandingScene,
    build_scene,
    points_at_depth,
    surface_from_camera,
    undistort,
    up_direction,
    world_from_surface,
)
from marsyard.algorithms.hda.structure import Matches, dense_structure, scale_factor
from marsyard.algorithms.hda.tracking import Tracks, select_features, track_features, window_half_px
from marsyard.algorithms.interface import SiteEstimate, SiteOutcome
from marsyard.sim.measurements import LandingMeasurements

#: Function that estimates the camera motion from accepted tracks; None without a solution.
MotionSolver = Callable[[LandingScene, Tracks, HdaOptions], CameraMotion | None]
#: Function that computes points of the ground by stereo matching, from the motion at its final scale.
StructureSolver = Callable[[LandingScene, CameraMotion, HdaOptions], Matches]


@final
class HdaEstimator:
    """Landing site estimator: the hazard avoidance of JPL's autonomous helicopter.

    The camera motion is estimated from features tracked between two images, and scaled by the laser range. A grid of
    pixels is matched along epipolar segments and triangulated to points, from which an elevation map is computed. Cells
    with excessive slope or roughness are hazards in the safe landing map. The site is the safe cell farthest from all
    unsafe cells.
    """

    def __init__(self, options: HdaOptions | None = None) -> None:
        self.options = HdaOptions() if options is None else options

    def estimate(self, measurements: LandingMeasurements) -> SiteEstimate:
        """Select the site, with `HdaDetails`. Raises ValueError if an image's size differs from its camera's."""
        return find_site(build_scene(measurements), motion_from_tracks, match_structure, self.options)


def find_site(
    scene: LandingScene, solve_motion: MotionSolver, solve_structure: StructureSolver, options: HdaOptions
) -> SiteEstimate:
    """Run all stages with these solvers for motion and structure; return the site or a failure outcome."""
    details = HdaDetails(scene.views)
    if not (np.isfinite(scene.range_m) and scene.range_m > 0.0):
        return _report_failure(SiteOutcome.NO_RANGE, scene, details)
    features = select_features(scene.views[0].counts, options)
    if len(features) < options.min_tracks:
        return _report_failure(SiteOutcome.NO_FEATURES, scene, details)
    tracks = track_features(
        scene.views[0].counts,
        scene.views[1].counts,
        features,
        expected_pixels(scene, features, options),
        window_half_px(scene.views[0], options),
        options,
    )
    details = details.end_stage(tracks=tracks)
    if np.count_nonzero(tracks.accepted) < options.min_tracks:
        return _report_failure(SiteOutcome.NO_TRACKS, scene, details)
    motion = solve_motion(scene, tracks, options)
    details = replace(details, motion=motion)
    failure = check_motion(motion, options)
    if motion is None or failure is not None:
        return _report_failure(failure or SiteOutcome.NO_MOTION, scene, details)
    coordinates = undistort(scene.views[0].camera, tracks.first[tracks.accepted])
    scale = scale_factor(scene.views, motion, coordinates, scene.range_m, options)
    if not (np.isfinite(scale) and scale > 0.0):
        return _report_failure(SiteOutcome.NO_MOTION, scene, details)
    motion = motion.scale(scale)
    details = details.end_stage(motion=motion)
    matches = solve_structure(scene, motion, options)
    details = details.end_stage(matches=matches)
    if len(matches.points) < options.min_points:
        return _report_failure(SiteOutcome.NO_STRUCTURE, scene, details)
    resolution = hazards.map_resolution(motion, scene.views[0].focal_px, options)
    ground = map_ground(scene, matches.points, resolution, options)
    if ground is None:
        return _report_failure(SiteOutcome.NO_STRUCTURE, scene, details)
    site = site_world(scene, ground)
    details = details.end_stage(ground=ground)
    outcome = SiteOutcome.NO_SAFE_SITE if site is None else SiteOutcome.SAFE_SITE
    return SiteEstimate(outcome, site, details)


def _report_failure(outcome: SiteOutcome, scene: LandingScene, details: HdaDetails) -> SiteEstimate:
    """Return the a-priori site with a failure outcome."""
    return SiteEstimate(outcome, scene.apriori_site_world, details)


def expected_pixels(scene: LandingScene, features: Points2, options: HdaOptions) -> Points2:
    """Predict the features' pixels (u, v) in the second image: unchanged, or from the poses (option `track_seed`)."""
    if options.track_seed is TrackSeed.NOTHING:
        return features
    coordinates = undistort(scene.views[0].camera, features)
    ground = points_at_depth(coordinates, plane_depths(coordinates, scene.range_m, scene.up_camera))
    pixels, visible = scene.views[1].camera.project(scene.second_from_first.apply(ground))
    return np.where(visible[:, None], pixels, features)


def motion_from_tracks(scene: LandingScene, tracks: Tracks, options: HdaOptions) -> CameraMotion:
    """Solve for the motion by robust least squares.

    The published algorithm starts from the slant range alone (section II.B: "the altimetry measurement is used to set
    the initial depths"). With a start from the poses (option `track_seed`), the motion between the on-board poses, with
    the depths of level ground, is an additional start.
    """
    track_pixels = (tracks.first[tracks.accepted], tracks.second[tracks.accepted])
    first, second = (undistort(view.camera, pixels) for view, pixels in zip(scene.views, track_pixels, strict=True))
    starts = range_starts(first, scene.range_m)
    if options.track_seed is TrackSeed.POSE:
        level_depths = plane_depths(first, scene.range_m, scene.up_camera)
        starts = (MotionStart(scene.second_from_first, level_depths), *starts)
    return estimate_motion(first, second, scene.views[1].focal_px, starts, options)


def check_motion(motion: CameraMotion | None, options: HdaOptions) -> SiteOutcome | None:
    """Return the reason why a motion is rejected; None if it is accepted."""
    if motion is None:
        return SiteOutcome.NO_MOTION
    # at least 6: one more than the five unknowns of a motion without scale
    min_inliers = max(options.min_inlier_fraction * len(motion.inliers), 6)
    if np.count_nonzero(motion.residuals_px <= options.max_residual_px) < min_inliers:
        return SiteOutcome.NO_MOTION
    if motion.parallax_px < options.min_parallax_px:
        return SiteOutcome.NO_BASELINE
    # checked after the baseline, without which depths are arbitrary and the iteration may not converge
    if not motion.converged or np.count_nonzero(motion.inliers) < min_inliers:
        return SiteOutcome.NO_MOTION
    return None


def match_structure(scene: LandingScene, motion: CameraMotion, options: HdaOptions) -> Matches:
    """Compute points of the ground by matches along epipolar segments."""
    return dense_structure(scene.views, motion.second_from_first, motion.depth_range_m, options)


def map_ground(
    scene: LandingScene, points_camera: Points3, resolution: hazards.Resolution, options: HdaOptions
) -> MappedGround | None:
    """Compute the maps of `points_camera` (first camera's frame), and the site; None if the points cover no area."""
    first = scene.views[0]
    to_surface = surface_from_camera(up_direction(first, scene.up_camera, points_camera, options))
    points = to_surface.apply(points_camera)
    elevation = elevation_map(points)
    if elevation is None:
        return None
    # no hazard at the lander's limit fits into a filled hole
    elevation = fill_small_holes(elevation, options.narrowest_hazard * options.max_roughness_m)
    maps = hazards.hazard_maps(elevation, options)
    if options.check_footprints:
        maps = replace(maps, safety=hazards.classify_footprints(elevation, resolution, options))
    to_world = world_from_surface(first.world_from_camera.rotation, to_surface)
    apriori = to_world.inv().apply(scene.apriori_site_world - first.world_from_camera.translation)
    apriori_cell = elevation.cells(apriori[:2])
    site_cell = hazards.safe_site(maps.safety, apriori_cell)
    return MappedGround(to_surface, to_world, points, elevation, maps, apriori_cell, site_cell)


def site_world(scene: LandingScene, ground: MappedGround) -> Vector3 | None:
    """Site in the world frame, metres, on the smooth surface; None if no cell is safe."""
    cell = ground.site_cell
    if cell is None:
        return None
    x, y = ground.elevation.positions(np.array(cell, dtype=np.float64))
    # a footprint can be safe (`check_footprints`) where the squares of the smooth surface are not covered by the map
    smooth = ground.hazards.smooth_m[cell]
    site = np.array([x, y, smooth if np.isfinite(smooth) else ground.elevation.elevation_m[cell]])
    return np.asarray(scene.views[0].world_from_camera.translation + ground.world_from_surface.apply(site))
