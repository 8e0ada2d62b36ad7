"""The visual target tracker: the loop of section 4.1, its states, and the criteria of a loss.

The steps are functions of `pointing`, `matching`, `stereo`, `loss` and `accuracy`. The state of a track is an
immutable `Track`; the tracker holds the latest one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.arrays import Counts, Patch, Vector2, Vector3
from marsyard.algorithms.interface import MastAim, TargetLoss, TargetUpdate, TrackingState
from marsyard.algorithms.vtt import matching
from marsyard.algorithms.vtt.accuracy import stereo_range_error_m
from marsyard.algorithms.vtt.options import VttOptions
from marsyard.algorithms.vtt.pointing import aim_at_pixel, aim_at_position
from marsyard.algorithms.vtt.stereo import (
    StereoMatch,
    disparity_px_m,
    epipolar_pixels,
    nearest_point,
    point_stereo,
    search_ranges,
)
from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import compose
from marsyard.sim.measurements import MastCalibration, PixelTarget, RoverMeasurements, TargetDesignation


@dataclass(frozen=True)
class Journey:
    """Distances that determine the tolerances.

    - seed_m, last_m, now_m: From the camera to the target at the seed, at the last match, and now
    - step_m, driven_m: Rover motion since the last match, and path length since the seed
    """

    seed_m: float
    last_m: float
    now_m: float
    step_m: float
    driven_m: float


@dataclass(frozen=True)
class Tolerances:
    """Largest accepted corrections: of the target's distance, and of its position since the seed."""

    distance_m: float
    position_m: float


def tolerances(journey: Journey, left: CameraModel, right: CameraModel, options: VttOptions) -> Tolerances:
    """The tolerances of Fig. 5 for this update, by the formula of the module."""
    scale = disparity_px_m(left, right)

    def tolerance(before_m: float, moved_m: float, across_m: float) -> float:
        error_px = options.stereo_disparity_error_px
        before, now = (stereo_range_error_m(one, scale, 1.0, error_px) for one in (before_m, journey.now_m))
        return options.tolerance_floor_m + math.hypot(before, now, options.pose_error * moved_m, across_m)

    return Tolerances(
        distance_m=tolerance(journey.last_m, journey.step_m, 0.0),
        position_m=tolerance(journey.seed_m, journey.driven_m, options.direction_error_rad * journey.now_m),
    )


@dataclass(frozen=True)
class Evidence:
    """Input of the four loss criteria.

    - match_score, stereo_score: Normalised correlations of the match and of point stereo
    - distance_correction_m: Measured less predicted distance of the target
    - position_correction_m: Distance of the target from its position at the seed, in the estimated world frame
    """

    match_score: float
    stereo_score: float
    distance_correction_m: float
    position_correction_m: float


def find_losses(evidence: Evidence, allowed: Tolerances, options: VttOptions) -> tuple[TargetLoss, ...]:
    """Failed loss criteria."""
    criteria = {
        TargetLoss.LOW_MATCH_SCORE: evidence.match_score < options.min_match_score,
        TargetLoss.LOW_STEREO_SCORE: evidence.stereo_score < options.min_stereo_score,
        TargetLoss.DISTANCE_JUMP: abs(evidence.distance_correction_m) > allowed.distance_m,
        TargetLoss.POSITION_JUMP: evidence.position_correction_m > allowed.position_m,
    }
    return tuple(loss for loss, lost in criteria.items() if lost)


def next_state(state: TrackingState, lost_updates: int, found: bool, limit: int) -> tuple[TrackingState, int]:
    """State after an update, and number of updates since the loss (Fig. 6).

    A loss leads to LOST; up to `limit` further updates may recover the target; then FAILURE is final.
    """
    if state in (TrackingState.FAILURE, TrackingState.NO_TARGET):
        return state, lost_updates
    if found:
        return TrackingState.NORMAL, 0
    if state is TrackingState.NORMAL:
        return (TrackingState.LOST, 0) if limit else (TrackingState.FAILURE, 0)
    tries = lost_updates + 1
    return (TrackingState.FAILURE if tries >= limit else TrackingState.LOST), tries


@dataclass(frozen=True)
class VttDetails:
    """Intermediate products of one update, as shown in the paper's Figs. 15 and 17 and Table III.

    - seeded: Whether this update took the first template
    - predicted_pixel: Predicted full-frame (u, v) in the left image; None if invisible
    - window, window_corner: Left search window, counts, and the full-frame (u, v) of its upper left pixel; None with
      `predicted_pixel`
    - change: Computed magnification and roll since the last match, applied or not; None at the seed or if invisible
    - match: The left match with its searched template; None if the window does not fit
    - template: The new image about the match: the next template as it is now
    - stereo: The right match; None without a left one, or if it does not fit
    - distance_m: From the left camera to the target: triangulated, else predicted
    - azimuth_rad: Direction from the left camera to the target in the rover frame, positive to the right
    - azimuth_change_rad: Change of the direction in the world since the last match, positive to the right
    - position_world: Triangulated target in the estimated world frame, metres; None without triangulation
    - step_m: Estimated rover motion since the last match
    - evidence, allowed: Input of the loss criteria and their tolerances; None at the seed and for incomplete updates
    """

    seeded: bool
    predicted_pixel: Vector2 | None
    window: Counts | None = None
    window_corner: tuple[int, int] | None = None
    change: matching.Change | None = None
    match: matching.Match | None = None
    template: Patch | None = None
    stereo: StereoMatch | None = None
    distance_m: float = float("nan")
    azimuth_rad: float = float("nan")
    azimuth_change_rad: float = 0.0
    position_world: Vector3 | None = None
    step_m: float = 0.0
    evidence: Evidence | None = None
    allowed: Tolerances | None = None


@dataclass(frozen=True)
class Track:
    """State of the tracker for its target.

    - designated: The designated pixel, or the target's position in the world, metres
    - world_from_rover: The pose at the last update, found or not
    - state, lost_updates: State of Fig. 6, and number of updates since the loss
    - sighting: The last match; None before the seed
    - seed_world: Position at the seed, in the estimated world frame, metres; None before
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
    """Tracks a target by its template, scaled and rolled with the rover's motion; see `TargetTracker`.

    `PURE_NCC` as options is the paper's baseline; `matcher` replaces the search in the left image (see
    `marsyard.algorithms.vtt.matching`).
    """

    def __init__(
        self, options: VttOptions | None = None, matcher: matching.Matcher = matching.match_by_correlation
    ) -> None:
        self.options = VttOptions() if options is None else options
        self.matcher = matcher
        self.track: Track | None = None

    @property
    def state(self) -> TrackingState:
        """State of the tracker."""
        return TrackingState.NO_TARGET if self.track is None else self.track.state

    def designate(self, target: TargetDesignation, world_from_rover: RigidTransform) -> None:
        """Set the target, with the rover's estimated pose."""
        if isinstance(target, PixelTarget):
            self.track = Track(target, world_from_rover)
        else:
            self.track = Track(matching.designated_position_world(target, world_from_rover), world_from_rover)

    def clear(self) -> None:
        """Clear the target."""
        self.track = None

    def aim(self, world_from_rover: RigidTransform, mast: MastCalibration) -> MastAim | None:
        """Mast aim from this pose; None without a target, or if the mast cannot show it."""
        if self.track is None:
            return None
        if self.track.sighting is None and isinstance(self.track.designated, PixelTarget):
            return aim_at_pixel(self.track.designated, mast, self.options)
        expected = expected_position(self.track, world_from_rover)
        return None if expected is None else aim_at_position(expected, mast, self.options)

    def update(self, measurements: RoverMeasurements) -> TargetUpdate:
        """Match the target in a new stereo pair, with `VttDetails`. In the failure state no search is made."""
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


@dataclass(frozen=True)
class Finding:
    """Result of one update: losses, or the target in the rover frame and the new sighting."""

    losses: tuple[TargetLoss, ...]
    details: VttDetails
    position_rover: Vector3 | None = None
    sighting: matching.Sighting | None = None


@dataclass(frozen=True)
class Stop:
    """Measurements of a stop, and the estimated head pose; cameras are in the head's frame."""

    measurements: RoverMeasurements
    rover_from_head: RigidTransform
    world_from_head: RigidTransform

    @classmethod
    def of(cls, measurements: RoverMeasurements) -> Stop:
        """The stop of these measurements."""
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
        """From the left camera's centre."""
        return float(np.linalg.norm(position_head - self.left.c))


def expected_position(track: Track, world_from_frame: RigidTransform) -> Vector3 | None:
    """Predicted target position in a frame of this pose (rover or head); None for a pixel target before the seed."""
    if track.sighting is not None:
        last = track.sighting
        return matching.predicted_position(last.position_head, last.world_from_head, world_from_frame)
    if isinstance(track.designated, PixelTarget):
        return None
    return np.asarray(world_from_frame.inv().apply(track.designated.copy()))


def seed_track(track: Track, measurements: RoverMeasurements, options: VttOptions) -> Finding:
    """Take the first template at the designated target, and triangulate it by point stereo."""
    stop = Stop.of(measurements)
    if isinstance(track.designated, PixelTarget):
        pixel, ranges = track.designated.pixel, options.seed_range_m
    else:
        expected = np.asarray(stop.world_from_head.inv().apply(track.designated.copy()))
        pixel = stop.left.project(expected)[0]
        ranges = search_ranges(stop.left, stop.right, stop.distance_m(expected), options.disparity_search_px)
    if not np.all(np.isfinite(pixel)) or not matching.has_room(measurements.left, pixel, options.template_px):
        return Finding((TargetLoss.OUT_OF_VIEW,), VttDetails(True, None))
    template = matching.cut_patch(measurements.left, pixel, options.template_px)
    window, window_corner = matching.search_window(measurements.left, pixel, options.search_px)
    match = matching.Match(pixel, 1.0, template)
    details = VttDetails(True, pixel, window, window_corner, match=match, template=template)
    located = triangulate_target(stop, pixel, template, ranges, details, options)
    stereo = located.details.stereo
    if located.sighting is not None and stereo is not None and stereo.score < options.min_stereo_score:
        return Finding((TargetLoss.LOW_STEREO_SCORE,), located.details)
    return located


def follow_track(
    track: Track,
    last: matching.Sighting,
    measurements: RoverMeasurements,
    options: VttOptions,
    matcher: matching.Matcher,
) -> Finding:
    """Actions 1 to 6 of section 4.1 except pointing, and the loss criteria."""
    stop = Stop.of(measurements)
    new_from_old = matching.pose_change(last.world_from_head, stop.world_from_head)
    expected = np.asarray(new_from_old.apply(last.position_head.copy()))
    lever_px = matching.lever_pixels(last.position_head, last.camera, stop.left, new_from_old, options.roll_lever_m)
    if lever_px is None:
        return Finding((TargetLoss.OUT_OF_VIEW,), VttDetails(False, None))
    predicted = lever_px[0]
    magnification = matching.magnification(last.position_head, last.camera.c, expected, stop.left.c)
    change = matching.Change(magnification, matching.roll_angle(lever_px))
    window, window_corner = matching.search_window(measurements.left, predicted, options.search_px)
    details = VttDetails(False, predicted, window, window_corner, change)
    applied = matching.Change(change.magnification if options.scale else 1.0, change.roll_rad if options.roll else 0.0)
    match = matcher(last, measurements.left, predicted, applied, options)
    if match is None:
        return Finding((TargetLoss.OUT_OF_VIEW,), details)
    template = matching.cut_patch(measurements.left, match.pixel, options.template_px)
    details = replace(details, match=match, template=template)
    ranges = search_ranges(stop.left, stop.right, stop.distance_m(expected), options.disparity_search_px)
    located = triangulate_target(stop, match.pixel, template, ranges, details, options)
    if located.sighting is None:
        return located
    return check_losses(track, last, located, stop, stop.distance_m(expected), options)


def triangulate_target(
    stop: Stop, pixel: Vector2, template: Patch, ranges_m: tuple[float, float], details: VttDetails, options: VttOptions
) -> Finding:
    """Triangulate the target from its left pixel by point stereo over these ranges."""
    sight = stop.left.rays(pixel)
    curve = epipolar_pixels(sight, stop.left, stop.right, ranges_m)
    stereo = point_stereo(template, stop.measurements.right, curve, options)
    if stereo is None:
        return Finding((TargetLoss.OUT_OF_VIEW,), details)
    position = nearest_point(sight, stop.right.rays(stereo.pixel))
    if position is None:
        return Finding((TargetLoss.NO_RANGE,), replace(details, stereo=stereo))
    in_rover = np.asarray(stop.rover_from_head.apply(np.stack([position, stop.left.c])))
    ahead = in_rover[0] - in_rover[1]
    world_from_rover = stop.measurements.world_from_rover
    details = replace(
        details,
        stereo=stereo,
        distance_m=stop.distance_m(position),
        azimuth_rad=float(np.arctan2(-ahead[1], ahead[0])),
        position_world=np.asarray(stop.world_from_head.apply(position)),
    )
    sighting = matching.Sighting(
        stop.measurements.left, pixel, position, stop.left, stop.world_from_head, world_from_rover
    )
    return Finding((), details, in_rover[0], sighting)


def check_losses(
    track: Track, last: matching.Sighting, located: Finding, stop: Stop, expected_m: float, options: VttOptions
) -> Finding:
    """Apply the four loss criteria to a match."""
    details, sighting = located.details, located.sighting
    match, stereo, position = details.match, details.stereo, details.position_world
    if sighting is None or match is None or stereo is None or position is None or track.seed_world is None:
        raise ValueError("only a target that was matched, ranged and seeded can be evaluated")
    moved = sighting.world_from_rover.translation - last.world_from_rover.translation
    since_update = sighting.world_from_rover.translation - track.world_from_rover.translation
    journey = Journey(
        seed_m=track.seed_distance_m,
        last_m=last.distance_m,
        now_m=details.distance_m,
        step_m=float(np.linalg.norm(moved)),
        driven_m=track.driven_m + float(np.linalg.norm(since_update)),
    )
    evidence = Evidence(
        match_score=match.score,
        stereo_score=stereo.score,
        distance_correction_m=details.distance_m - expected_m,
        position_correction_m=float(np.linalg.norm(position - track.seed_world)),
    )
    allowed: Tolerances = tolerances(journey, stop.left, stop.right, options)
    turned = sighting.azimuth_world_rad - last.azimuth_world_rad
    details = replace(
        details,
        step_m=journey.step_m,
        azimuth_change_rad=float(np.arctan2(np.sin(turned), np.cos(turned))),
        evidence=evidence,
        allowed=allowed,
    )
    failed = find_losses(evidence, allowed, options)
    return Finding(failed, details) if failed else replace(located, details=details)


def advance_track(track: Track, finding: Finding, measurements: RoverMeasurements, options: VttOptions) -> Track:
    """The track after an update; a new match replaces the template."""
    pose, sighting = measurements.world_from_rover, finding.sighting
    state, lost_updates = next_state(track.state, track.lost_updates, sighting is not None, options.max_lost_updates)
    after = replace(track, state=state, lost_updates=lost_updates, world_from_rover=pose)
    if track.sighting is not None:
        moved = float(np.linalg.norm(pose.translation - track.world_from_rover.translation))
        after = replace(after, driven_m=track.driven_m + moved)
    if sighting is None:
        return after
    if track.sighting is None:
        after = replace(after, seed_world=finding.details.position_world, seed_distance_m=finding.details.distance_m)
    return replace(after, sighting=sighting)
