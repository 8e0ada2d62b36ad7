"""Loss criteria of the target tracker, their tolerances, and its states (section 4.1, Figs. 5 and 6).

Sections and figures are those of Kim et al., "Targeted Driving Using Visual Tracking".
"""

import math
from dataclasses import dataclass

from marsyard.algorithms.interface import TargetLoss, TrackingState
from marsyard.algorithms.vtt.accuracy import stereo_range_error_m
from marsyard.algorithms.vtt.options import VttOptions
from marsyard.algorithms.vtt.stereo import disparity_px_m
from marsyard.sim.camera import CameraModel


@dataclass(frozen=True)
class Distances:
    """Distances that determine the tolerances of an update.

    - seed_m, last_m, current_m: Distance from camera to target at the seed, at the last match, and in this update
    - step_m, driven_m: Rover displacement since the last match, and path length since the seed
    """

    seed_m: float
    last_m: float
    current_m: float
    step_m: float
    driven_m: float


@dataclass(frozen=True)
class Tolerances:
    """Maximum accepted corrections (see `MatchEvidence`): of the target's distance and of its position, metres."""

    distance_m: float
    position_m: float


def tolerances(distances: Distances, left: CameraModel, right: CameraModel, options: VttOptions) -> Tolerances:
    """Compute the tolerances of Fig. 5 for this update: a minimum plus the root sum square of the errors."""
    focal_times_baseline = disparity_px_m(left, right)

    def compute_tolerance(reference_m: float, motion_m: float, lateral_m: float) -> float:
        error_px = options.stereo_disparity_error_px
        # focal length times baseline is one argument, so the other one is 1
        errors_m = [
            stereo_range_error_m(range_m, focal_times_baseline, 1.0, error_px)
            for range_m in (reference_m, distances.current_m)
        ]
        return options.min_tolerance_m + math.hypot(*errors_m, options.pose_error * motion_m, lateral_m)

    return Tolerances(
        distance_m=compute_tolerance(distances.last_m, distances.step_m, 0.0),
        position_m=compute_tolerance(
            distances.seed_m, distances.driven_m, options.direction_error_rad * distances.current_m
        ),
    )


@dataclass(frozen=True)
class MatchEvidence:
    """Input of the four loss criteria.

    - match_score, stereo_score: Normalised correlations of the template match and of the stereo match
    - distance_correction_m: Measured minus predicted distance of the target
    - position_correction_m: Distance of the target from its position at the seed, in the estimated world frame
    """

    match_score: float
    stereo_score: float
    distance_correction_m: float
    position_correction_m: float


def find_losses(evidence: MatchEvidence, allowed: Tolerances, options: VttOptions) -> tuple[TargetLoss, ...]:
    """Return the reasons for a loss: low scores, or corrections above their tolerances."""
    criteria = {
        TargetLoss.LOW_MATCH_SCORE: evidence.match_score < options.min_match_score,
        TargetLoss.LOW_STEREO_SCORE: evidence.stereo_score < options.min_stereo_score,
        TargetLoss.DISTANCE_JUMP: abs(evidence.distance_correction_m) > allowed.distance_m,
        TargetLoss.POSITION_JUMP: evidence.position_correction_m > allowed.position_m,
    }
    return tuple(loss for loss, is_exceeded in criteria.items() if is_exceeded)


def next_state(state: TrackingState, lost_updates: int, is_matched: bool, limit: int) -> tuple[TrackingState, int]:
    """Return the state after an update, and the number of updates since the loss (Fig. 6).

    `is_matched`: whether the update matched the target. After a loss the state is LOST. Up to `limit` further updates
    can recover the target; afterwards the state is FAILURE until the target is cleared.
    """
    if state in (TrackingState.FAILURE, TrackingState.NO_TARGET):
        return state, lost_updates
    if is_matched:
        return TrackingState.NORMAL, 0
    if state is TrackingState.NORMAL:
        return (TrackingState.LOST, 0) if limit else (TrackingState.FAILURE, 0)
    attempts = lost_updates + 1
    return (TrackingState.FAILURE if attempts >= limit else TrackingState.LOST), attempts
