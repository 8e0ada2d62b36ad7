"""Visual target tracker: the tracking loop of section 4.1.

The steps of the loop are functions in `pointing`, `prediction`, `matching`, `stereo` and `losses`. The tracker stores
its state in an immutable `TargetTrack` and replaces it in each update. The "seed" is the first update, which extracts
the first template.

Sections, equations and figures are those of Kim et al., "Targeted Driving Using Visual Tracking".
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.arrays import Counts, Patch, Vector2, Vector3
from marsyard.algorithms.interface import MastAim, TargetLoss, TargetUpdate, TrackingState
from marsyard.algorithms.vtt import matching, prediction
from marsyard.algorithms.vtt.losses import Distances, MatchEvidence, Tolerances, find_losses, next_state, tolerances
from marsyard.algorithms.vtt.options import VttOptions
from marsyard.algorithms.vtt.pointing import aim_at_pixel, aim_at_position
from marsyard.algorithms.vtt.stereo import StereoMatch, epipolar_pixels, nearest_point, point_stereo, search_ranges
from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import compose
from marsyard.sim.measurements import MastCalibration, PixelTarget, RoverMeasurements, TargetDesignation


@dataclass(frozen=True)
class VttDetails:
    """Intermediate products of one update (paper: Figs. 15 and 17, Table III), returned as `TargetUpdate.details`.

    - seeded: Whether this update is the first one, which designates the target (the seed of the track)
    - predicted_pixel: Predicted full-frame (u, v) in the left image; None if invisible
    - window, window_corner: Left search window, counts, and the full-frame (u, v) of its upper left pixel; None
      without `predicted_pixel`
    - change: Computed magnification and roll since the last match, used or not; None at the seed or if invisible
    - match: Match in the left image, with the template that was searched; None if the window does not fit
    - template: The new image around the match: the next template before magnification and roll
    - stereo: Match in the right image; None without a left match, or if the search range does not fit
    - distance_m: Triangulated distance from the left camera to the target; NaN without triangulation
    - azimuth_rad: Direction from the left camera to the target in the rover frame, positive to the right
    - azimuth_change_rad: Change of the direction in the world since the last match, positive to the right
    - position_world: Triangulated target in the estimated world frame, metres; None without triangulation
    - step_m: Estimated rover displacement since the last match
    - evidence: Input of the loss criteria; None at the seed and for incomplete updates
    """

    seeded: bool
    predicted_pixel: Vector2 | None
    window: Counts | None = None
    window_corner: tuple[int, int] | None = None
    change: prediction.ViewChange | None = None
    match: matching.Match | None = None
    template: Patch | None = None
    stereo: StereoMatch | None = None
    distance_m: float = float("nan")
    azimuth_rad: float = float("nan")
    azimuth_change_rad: float = 0.0
    position_world: Vector3 | None = None
    step_m: float = 0.0
    evidence: MatchEvidence | None = None


@dataclass(frozen=True)
class TargetTrack:
    """State of the tracker for its target.

    - designated: The designated pixel, or the target's position in the world, metres
    - world_from_rover: The pose at the last update, with or without a match
    - state, lost_updates: State of Fig. 6, and number of updates since the loss
    - sighting: The last match; None before the seed
    - seed_world: Position at the seed, in the estimated world frame, metres; None before the seed
    - seed_distance_m: Distance from the camera at the seed
    - driven_m: Estimated path length of the rover since the seed
    """

    designated: PixelTarget | Vector3
    world_from_rover: RigidTransform
    state: TrackingState = TrackingState.NORMAL
    lost_updates: int = 0
    sighting: matching.Sighting | None = None
    seed_world: Vector3 | None = None
    seed_distance_m: float = float("nan")
    driven_m: float = 0.0


@final
class VisualTargetTracker:
    """Target tracker: normalised correlation of a template that is magnified and rolled with the rover's motion.

    Implements `TargetTracker` by the method of "Targeted Driving Using Visual Tracking" (section 4). The match in the
    left image is triangulated with the right image; four loss criteria reject wrong matches. `matcher` searches the
    target in the left image (see `marsyard.algorithms.vtt.matching`). With `PURE_NCC` as options the tracker is the
    paper's baseline.
    """

    def __init__(
        self, options: VttOptions | None = None, matcher: matching.Matcher = matching.match_by_correlation
    ) -> None:
        self.options = VttOptions() if options is None else options
        self.matcher = matcher
        self.track: TargetTrack | None = None

    @property
    def state(self) -> TrackingState:
        """State of the tracker."""
        return TrackingState.NO_TARGET if self.track is None else self.track.state

    def designate(self, target: TargetDesignation, world_from_rover: RigidTransform) -> None:
        """Set the target, with the rover's estimated pose."""
        if isinstance(target, PixelTarget):
            self.track = TargetTrack(target, world_from_rover)
        else:
            self.track = TargetTrack(prediction.designated_position_world(target, world_from_rover), world_from_rover)

    def clear(self) -> None:
        """Clear the target."""
        self.track = None

    def aim(self, world_from_rover: RigidTransform, mast: MastCalibration) -> MastAim | None:
        """Compute the mast aim for this rover pose; None without a target, or if the mast cannot point at it."""
        if self.track is None:
            return None
        if self.track.sighting is None and isinstance(self.track.designated, PixelTarget):
            return aim_at_pixel(self.track.designated, mast, self.options)
        expected = expected_position(self.track, world_from_rover)
        return None if expected is None else aim_at_position(expected, mast, self.options)

    def update(self, measurements: RoverMeasurements) -> TargetUpdate:
        """Find the target in a new stereo pair, with `VttDetails`. In the state FAILURE no search is made."""
        if self.track is None:
            return TargetUpdate(TrackingState.NO_TARGET, (), None)
        if self.track.state is TrackingState.FAILURE:
            predicted = expected_position(self.track, measurements.world_from_rover)
            return TargetUpdate(TrackingState.FAILURE, (), predicted)
        if self.track.sighting is None:
            result = seed_track(self.track, measurements, self.options)
        else:
            result = follow_track(self.track, self.track.sighting, measurements, self.options, self.matcher)
        self.track = advance_track(self.track, result, measurements, self.options)
        position = result.position_rover
        if position is None:
            position = expected_position(self.track, measurements.world_from_rover)
        return TargetUpdate(self.track.state, result.losses, position, result.details)


def lucas_kanade_tracker(options: VttOptions | None = None) -> VisualTargetTracker:
    """Create the baseline that matches by optical flow (Lucas-Kanade); options of the correlation search are unused."""
    return VisualTargetTracker(options, matching.match_by_lucas_kanade)


@dataclass(frozen=True)
class TrackResult:
    """Result of one update: the losses, or the target's position (rover frame, metres) and the new reference."""

    losses: tuple[TargetLoss, ...]
    details: VttDetails
    position_rover: Vector3 | None = None
    sighting: matching.Sighting | None = None


@dataclass(frozen=True)
class StereoStop:
    """Measurements of a rover stop, and the estimated pose of the mast head; cameras are in the head's frame."""

    measurements: RoverMeasurements
    rover_from_head: RigidTransform
    world_from_head: RigidTransform

    @classmethod
    def from_measurements(cls, measurements: RoverMeasurements) -> StereoStop:
        """Compute the head poses of a stop from its measurements."""
        angles = (measurements.azimuth_rad, measurements.elevation_rad)
        rover_from_head = measurements.mast.geometry.rover_from_head(*angles)
        return cls(measurements, rover_from_head, compose(measurements.world_from_rover, rover_from_head))

    @property
    def left(self) -> CameraModel:
        """The left camera."""
        return self.measurements.mast.left

    @property
    def right(self) -> CameraModel:
        """The right camera."""
        return self.measurements.mast.right

    def distance_m(self, position_head: Vector3) -> float:
        """Distance of a point from the left camera's centre."""
        return float(np.linalg.norm(position_head - self.left.c))


def expected_position(track: TargetTrack, world_from_frame: RigidTransform) -> Vector3 | None:
    """Predict the target position in the rover or head frame of this pose; None for a pixel target before the seed."""
    last = track.sighting
    if last is not None:
        return prediction.predicted_position(last.position_head, last.world_from_head, world_from_frame)
    if isinstance(track.designated, PixelTarget):
        return None
    return np.asarray(world_from_frame.inv().apply(track.designated.copy()))


def seed_track(track: TargetTrack, measurements: RoverMeasurements, options: VttOptions) -> TrackResult:
    """Extract the first template at the designated target, and triangulate it by point stereo."""
    stop = StereoStop.from_measurements(measurements)
    if isinstance(track.designated, PixelTarget):
        pixel, ranges = track.designated.pixel, options.seed_range_m
    else:
        expected = np.asarray(stop.world_from_head.inv().apply(track.designated.copy()))
        pixel = stop.left.project(expected)[0]
        ranges = search_ranges(stop.left, stop.right, stop.distance_m(expected), options.disparity_search_px)
    if not np.all(np.isfinite(pixel)) or not matching.window_fits(measurements.left, pixel, options.template_px):
        return TrackResult((TargetLoss.OUT_OF_VIEW,), VttDetails(seeded=True, predicted_pixel=None))
    template = matching.extract_patch(measurements.left, pixel, options.template_px)
    window, window_corner = matching.search_window(measurements.left, pixel, options.search_px)
    match = matching.Match(pixel, 1.0, template)
    details = VttDetails(
        seeded=True, predicted_pixel=pixel, window=window, window_corner=window_corner, match=match, template=template
    )
    result = triangulate_target(stop, pixel, template, ranges, details, options)
    stereo = result.details.stereo
    if result.sighting is not None and stereo is not None and stereo.score < options.min_stereo_score:
        return TrackResult((TargetLoss.LOW_STEREO_SCORE,), result.details)
    return result


def follow_track(
    track: TargetTrack,
    last: matching.Sighting,
    measurements: RoverMeasurements,
    options: VttOptions,
    matcher: matching.Matcher,
) -> TrackResult:
    """Match and triangulate the target (actions 1 to 6 of section 4.1 without pointing); check the loss criteria."""
    stop = StereoStop.from_measurements(measurements)
    new_from_old = prediction.pose_change(last.world_from_head, stop.world_from_head)
    expected = np.asarray(new_from_old.apply(last.position_head.copy()))
    points = prediction.roll_points(last.position_head, last.camera, stop.left, new_from_old, options.roll_lever_m)
    if points is None:
        return TrackResult((TargetLoss.OUT_OF_VIEW,), VttDetails(seeded=False, predicted_pixel=None))
    predicted = points[0]
    magnification = prediction.magnification(last.position_head, last.camera.c, expected, stop.left.c)
    change = prediction.ViewChange(magnification, prediction.roll_angle(points))
    window, window_corner = matching.search_window(measurements.left, predicted, options.search_px)
    details = VttDetails(
        seeded=False, predicted_pixel=predicted, window=window, window_corner=window_corner, change=change
    )
    applied_magnification = change.magnification if options.scale else 1.0
    applied_change = prediction.ViewChange(applied_magnification, change.roll_rad if options.roll else 0.0)
    match = matcher(last, measurements.left, predicted, applied_change, options)
    if match is None:
        return TrackResult((TargetLoss.OUT_OF_VIEW,), details)
    template = matching.extract_patch(measurements.left, match.pixel, options.template_px)
    details = replace(details, match=match, template=template)
    ranges = search_ranges(stop.left, stop.right, stop.distance_m(expected), options.disparity_search_px)
    result = triangulate_target(stop, match.pixel, template, ranges, details, options)
    if result.sighting is None:
        return result
    return check_losses(track, last, result, stop, stop.distance_m(expected), options)


def triangulate_target(
    stop: StereoStop,
    pixel: Vector2,
    template: Patch,
    ranges_m: tuple[float, float],
    details: VttDetails,
    options: VttOptions,
) -> TrackResult:
    """Triangulate the target from its left pixel, by point stereo over the ranges `ranges_m`."""
    left_ray = stop.left.rays(pixel)
    curve = epipolar_pixels(left_ray, stop.left, stop.right, ranges_m)
    stereo = point_stereo(template, stop.measurements.right, curve, options)
    if stereo is None:
        return TrackResult((TargetLoss.OUT_OF_VIEW,), details)
    position = nearest_point(left_ray, stop.right.rays(stereo.pixel))
    if position is None:
        return TrackResult((TargetLoss.NO_RANGE,), replace(details, stereo=stereo))
    rover_points = np.asarray(stop.rover_from_head.apply(np.stack([position, stop.left.c])))
    direction = rover_points[0] - rover_points[1]
    world_from_rover = stop.measurements.world_from_rover
    details = replace(
        details,
        stereo=stereo,
        distance_m=stop.distance_m(position),
        azimuth_rad=float(np.arctan2(-direction[1], direction[0])),
        position_world=np.asarray(stop.world_from_head.apply(position)),
    )
    sighting = matching.Sighting(
        stop.measurements.left, pixel, position, stop.left, stop.world_from_head, world_from_rover
    )
    return TrackResult((), details, rover_points[0], sighting)


def check_losses(
    track: TargetTrack,
    last: matching.Sighting,
    result: TrackResult,
    stop: StereoStop,
    expected_m: float,
    options: VttOptions,
) -> TrackResult:
    """Apply the four loss criteria to a match; `expected_m` is the predicted distance from the left camera."""
    details, sighting = result.details, result.sighting
    match, stereo, position = details.match, details.stereo, details.position_world
    if sighting is None or match is None or stereo is None or position is None or track.seed_world is None:
        raise ValueError("the loss criteria require a match, a stereo match, a position and a seed")
    motion_m = sighting.world_from_rover.translation - last.world_from_rover.translation
    latest_motion_m = sighting.world_from_rover.translation - track.world_from_rover.translation
    distances = Distances(
        seed_m=track.seed_distance_m,
        last_m=last.distance_m,
        current_m=details.distance_m,
        step_m=float(np.linalg.norm(motion_m)),
        driven_m=track.driven_m + float(np.linalg.norm(latest_motion_m)),
    )
    evidence = MatchEvidence(
        match_score=match.score,
        stereo_score=stereo.score,
        distance_correction_m=details.distance_m - expected_m,
        position_correction_m=float(np.linalg.norm(position - track.seed_world)),
    )
    allowed: Tolerances = tolerances(distances, stop.left, stop.right, options)
    azimuth_change = sighting.azimuth_world_rad - last.azimuth_world_rad
    details = replace(
        details,
        step_m=distances.step_m,
        azimuth_change_rad=float(np.arctan2(np.sin(azimuth_change), np.cos(azimuth_change))),
        evidence=evidence,
    )
    losses = find_losses(evidence, allowed, options)
    return TrackResult(losses, details) if losses else replace(result, details=details)


def advance_track(
    track: TargetTrack, result: TrackResult, measurements: RoverMeasurements, options: VttOptions
) -> TargetTrack:
    """Return the track after an update; a new match replaces the template."""
    pose, sighting, details = measurements.world_from_rover, result.sighting, result.details
    state, lost_updates = next_state(track.state, track.lost_updates, sighting is not None, options.max_lost_updates)
    new_track = replace(track, state=state, lost_updates=lost_updates, world_from_rover=pose)
    if track.sighting is not None:
        distance_m = float(np.linalg.norm(pose.translation - track.world_from_rover.translation))
        new_track = replace(new_track, driven_m=track.driven_m + distance_m)
    if sighting is None:
        return new_track
    if track.sighting is None:
        new_track = replace(new_track, seed_world=details.position_world, seed_distance_m=details.distance_m)
    return replace(new_track, sighting=sighting)
