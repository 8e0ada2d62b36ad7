"""Loss criteria of the target and their consequences (section 4.6).

Fig. 5 shows that both tolerances are computed at each update; the paper gives no values. Here they follow from the
errors that the paper names, with D the distance now, D_old that of the last match, D_0 that at the seed, s the
length of the last move and S that of all moves since the seed:

    distance tolerance = floor + sqrt(dR(D_old)^2 + dR(D)^2 + (e s)^2)
    position tolerance = floor + sqrt(dR(D_0)^2   + dR(D)^2 + (e S)^2 + (w D)^2)

dR is the stereo range error of Eq. 1 for the disparity error of 3 sigma, e the error of the estimated position as a
fraction of the distance driven, w the error of the direction to the target.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from marsyard.algorithms.interface import TargetLoss, TrackingState
from marsyard.algorithms.vtt.accuracy import stereo_range_error_m
from marsyard.algorithms.vtt.options import VttOptions
from marsyard.algorithms.vtt.stereo import disparity_px_m
from marsyard.sim.camera import CameraModel


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
