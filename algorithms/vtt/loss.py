"""When the target is lost, and what follows (section 4.6).

Tolerances. Fig. 5 shows that both tolerances are computed anew at each update; the text gives no values, and none can
be read from the figure. Here they are what the errors that the paper names explain, with D the distance now, D_old that
of the last sighting, D_0 that at the seed, s the length of the last move and S that of all moves since the seed:

    distance tolerance = floor + sqrt(dR(D_old)^2 + dR(D)^2 + (e s)^2)
    position tolerance = floor + sqrt(dR(D_0)^2   + dR(D)^2 + (e S)^2 + (w D)^2)

dR is the stereo range error of Eq. 1 for the disparity error of 3 sigma, e the error of the estimated position as a
share of the distance driven, w that of the direction to the target. The first tolerance shrinks as the rover comes
nearer; the second is never less than what the first designation and the drive may have been wrong by.
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
    """The distances that the tolerances depend on, metres.

    - seed_m, last_m, now_m: From the camera to the target at the seed, at the last sighting, and now
    - step_m, driven_m: How far the rover moved since the last sighting, and along its path since the seed
    """

    seed_m: float
    last_m: float
    now_m: float
    step_m: float
    driven_m: float


@dataclass(frozen=True)
class Tolerances:
    """Largest corrections by which a target is still believed, metres: of its distance, and of its position in all."""

    distance_m: float
    position_m: float


def tolerances(journey: Journey, left: CameraModel, right: CameraModel, options: VttOptions) -> Tolerances:
    """The tolerances of Fig. 5 for this update, by the formula above."""
    scale = disparity_px_m(left, right)

    def tolerance(before_m: float, moved_m: float, across_m: float) -> float:
        before, now = (
            stereo_range_error_m(range_m, scale, 1.0, options.stereo_disparity_error_px)
            for range_m in (before_m, journey.now_m)
        )
        return options.tolerance_floor_m + math.hypot(before, now, options.pose_error * moved_m, across_m)

    return Tolerances(
        distance_m=tolerance(journey.last_m, journey.step_m, 0.0),
        position_m=tolerance(journey.seed_m, journey.driven_m, options.direction_error_rad * journey.now_m),
    )


@dataclass(frozen=True)
class Evidence:
    """What the four criteria judge.

    - match_score, stereo_score: Normalised correlation of the match and of point stereo
    - distance_correction_m: Distance of the target found less that predicted
    - position_correction_m: How far the target now lies from where it was first seen, in the world as estimated
    """

    match_score: float
    stereo_score: float
    distance_correction_m: float
    position_correction_m: float


def find_losses(evidence: Evidence, allowed: Tolerances, options: VttOptions) -> tuple[TargetLoss, ...]:
    """Which of the four criteria declare the target lost."""
    criteria = {
        TargetLoss.LOW_MATCH_SCORE: evidence.match_score < options.min_match_score,
        TargetLoss.LOW_STEREO_SCORE: evidence.stereo_score < options.min_stereo_score,
        TargetLoss.DISTANCE_JUMP: abs(evidence.distance_correction_m) > allowed.distance_m,
        TargetLoss.POSITION_JUMP: evidence.position_correction_m > allowed.position_m,
    }
    return tuple(loss for loss, lost in criteria.items() if lost)


def next_state(state: TrackingState, lost_updates: int, found: bool, limit: int) -> tuple[TrackingState, int]:
    """The state after an update, and for how many updates the target has been looked for since it was lost (Fig. 6).

    Losing it leads to LOST; up to `limit` further updates may find it again; then it is FAILURE, which no update ends.
    """
    if state in (TrackingState.FAILURE, TrackingState.NO_TARGET):
        return state, lost_updates
    if found:
        return TrackingState.NORMAL, 0
    if state is TrackingState.NORMAL:
        return (TrackingState.LOST, 0) if limit else (TrackingState.FAILURE, 0)
    tries = lost_updates + 1
    return (TrackingState.FAILURE if tries >= limit else TrackingState.LOST), tries
