"""Hazard detection and avoidance from two pictures of one moving camera (sections II and III)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import final

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.hda.details import HdaDetails
from marsyard.algorithms.hda.features import select_features
from marsyard.algorithms.hda.footprints import map_resolution
from marsyard.algorithms.hda.landing import map_ground, site_world
from marsyard.algorithms.hda.motion import Motion, estimate_motion, plane_depths
from marsyard.algorithms.hda.options import HdaOptions, TrackSeed
from marsyard.algorithms.hda.scale import scale_factor
from marsyard.algorithms.hda.sighting import Sighting, sighting
from marsyard.algorithms.hda.structure import Matches, dense_structure
from marsyard.algorithms.hda.tracking import Tracks, track_features
from marsyard.algorithms.hda.view import points_at, undistorted
from marsyard.algorithms.interface import SiteEstimate, SiteOutcome
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import LandingMeasurements

#: Solves for the motion from accepted tracks: their undistorted coordinates, focal length in pixels, initial depths.
MotionSolver = Callable[[Sighting, Tracks, HdaOptions], Motion | None]
#: Finds structure from the motion at its final scale.
StructureSolver = Callable[[Sighting, Motion, HdaOptions], Matches]


@final
class HdaEstimator:
    """The landing hazard avoidance of JPL's autonomous helicopter.

    Features are tracked between two pictures; their tracks give the motion and, with the laser's range, its scale; a
    grid of pixels is matched along epipolar segments; the points make an elevation map, whose slope and roughness make
    a map of where it is safe to land; the site is the place farthest from all hazards.
    """

    def __init__(self, options: HdaOptions | None = None) -> None:
        self.options = HdaOptions() if options is None else options

    def estimate(self, measurements: LandingMeasurements) -> SiteEstimate:
        """The estimate; its details are `HdaDetails`.

        Raises
        ------
        ValueError
            If a picture's size is not its camera's.
        """
        return find_site(sighting(measurements), motion_from_tracks, matched_structure, self.options)


def find_site(
    seen: Sighting, solve_motion: MotionSolver, solve_structure: StructureSolver, options: HdaOptions
) -> SiteEstimate:
    """All stages, two of them given: how motion is found from tracks, and how structure from the motion."""
    details = HdaDetails(seen.views)
    if not (np.isfinite(seen.range_m) and seen.range_m > 0.0):
        return _unconverged(SiteOutcome.NO_RANGE, seen, details)
    features = select_features(seen.views[0].counts, options)
    if len(features) < options.min_tracks:
        return _unconverged(SiteOutcome.NO_FEATURES, seen, details)
    tracks = track_features(
        seen.views[0].counts, seen.views[1].counts, features, expected_pixels(seen, features, options), options
    )
    details = details.ended(tracks=tracks)
    if np.count_nonzero(tracks.accepted) < options.min_tracks:
        return _unconverged(SiteOutcome.NO_TRACKS, seen, details)
    motion = solve_motion(seen, tracks, options)
    details = replace(details, motion=motion)
    failure = motion_failure(motion, options)
    if motion is None or failure is not None:
        return _unconverged(failure or SiteOutcome.NO_MOTION, seen, details)
    places = undistorted(seen.views[0].camera, tracks.first[tracks.accepted])
    factor = scale_factor(seen.views, motion, places, seen.range_m, options)
    if not (np.isfinite(factor) and factor > 0.0):
        return _unconverged(SiteOutcome.NO_MOTION, seen, details)
    motion = motion.scaled(factor)
    details = details.ended(motion=motion)
    matches = solve_structure(seen, motion, options)
    details = details.ended(matches=matches)
    if len(matches.points) < options.min_points:
        return _unconverged(SiteOutcome.NO_STRUCTURE, seen, details)
    resolution = map_resolution(motion, seen.views[0].focal_px, options)
    ground = map_ground(seen, matches.points, resolution, options)
    if ground is None:
        return _unconverged(SiteOutcome.NO_STRUCTURE, seen, details)
    site = site_world(seen, ground)
    details = details.ended(ground=ground)
    outcome = SiteOutcome.NO_SAFE_SITE if site is None else SiteOutcome.SAFE_SITE
    return SiteEstimate(outcome, site, details)


def _unconverged(outcome: SiteOutcome, seen: Sighting, details: HdaDetails) -> SiteEstimate:
    return SiteEstimate(outcome, seen.apriori_site_world, details)


def expected_pixels(
    seen: Sighting, features: Float[np.ndarray, "n 2"], options: HdaOptions
) -> Float[np.ndarray, "n 2"]:
    """Where features are looked for in the second picture."""
    if options.track_seed is TrackSeed.NOTHING:
        return features
    places = undistorted(seen.views[0].camera, features)
    ground = points_at(places, plane_depths(places, seen.range_m, seen.up_camera))
    pixels, visible = seen.views[1].camera.project(seen.second_from_first.apply(ground))
    return np.where(visible[:, None], pixels, features)


def motion_from_tracks(seen: Sighting, tracks: Tracks, options: HdaOptions) -> Motion:
    """The motion by robust least squares, from the on-board poses' motion and from none, whichever fits better."""
    first, second = (
        undistorted(one.camera, pixels[tracks.accepted])
        for one, pixels in zip(seen.views, (tracks.first, tracks.second), strict=True)
    )
    depths = plane_depths(first, seen.range_m, seen.up_camera)
    starts: tuple[RigidTransform, ...] = (seen.second_from_first, rigid(Rotation.identity(), np.zeros(3)))
    return estimate_motion(first, second, seen.views[1].focal_px, depths, starts, options)


def motion_failure(motion: Motion | None, options: HdaOptions) -> SiteOutcome | None:
    """Why a motion is not to be believed; None if it is."""
    if motion is None:
        return SiteOutcome.NO_MOTION
    least = max(options.min_inlier_share * len(motion.inliers), 6)
    if np.count_nonzero(motion.residuals_px <= options.max_residual_px) < least:
        return SiteOutcome.NO_MOTION
    if motion.parallax_px < options.min_parallax_px:
        return SiteOutcome.NO_BASELINE
    if not motion.converged or np.count_nonzero(motion.inliers) < least:
        return SiteOutcome.NO_MOTION
    return None


def matched_structure(seen: Sighting, motion: Motion, options: HdaOptions) -> Matches:
    """Structure by matches along epipolar segments."""
    return dense_structure(seen.views, motion.second_from_first, motion.depth_range_m, options)
