"""Hand-off of the tracked target to the arm, at the goal of an approach (tracking paper, sections 3, 7.4)."""

from dataclasses import dataclass
from enum import Enum

import numpy as np
from jaxtyping import Float

from marsyard.algorithms.interface import TargetUpdate
from marsyard.algorithms.vtt.accuracy import drift_error_m, stereo_range_error_m, tracked_approach_error_m
from marsyard.algorithms.vtt.stereo import disparity_px_m
from marsyard.sim.measurements import MastCalibration

#: Assumed drift of the tracked point (paper: 2.5 px from 10 m to 2 m).
DRIFT_PX = 2.5


class HandOffOutcome(Enum):
    """Outcome of a hand-off. All members except HANDED_OFF are expected failures: the arm receives no target."""

    HANDED_OFF = "the arm has received the target"
    NOT_TRACKED = "the target is not tracked"
    NOT_AT_GOAL = "the rover is not at the commanded distance from the target"


@dataclass(frozen=True)
class ArmTarget:
    """Target for the arm: position in the rover frame and its 3-sigma error (Eq. 5), metres."""

    position_rover: Float[np.ndarray, "3"]
    error_m: float


@dataclass(frozen=True)
class HandOff:
    """Outcome of a hand-off, and the target; None if it was not handed off."""

    outcome: HandOffOutcome
    target: ArmTarget | None


@dataclass(frozen=True)
class GoalCriterion:
    """Goal of an approach: horizontal distance of the target from the rover's origin, and tolerance, metres."""

    distance_m: float
    tolerance_m: float

    def is_met(self, position_rover: Float[np.ndarray, "3"]) -> bool:
        """Whether a target at this position is at the commanded distance, within the tolerance."""
        return abs(float(np.hypot(position_rover[0], position_rover[1])) - self.distance_m) <= self.tolerance_m


def hand_off(update: TargetUpdate, goal: GoalCriterion, mast: MastCalibration) -> HandOff:
    """Hand the target off to the arm if it is tracked and the rover is at its goal.

    The error is computed for the drift `DRIFT_PX` and the range from the mast's elevation axis.
    """
    position = update.position_rover
    if not update.tracked or position is None:
        return HandOff(HandOffOutcome.NOT_TRACKED, None)
    if not goal.is_met(position):
        return HandOff(HandOffOutcome.NOT_AT_GOAL, None)
    axis = mast.geometry.base_m + np.array([0.0, 0.0, mast.geometry.elbow_m[2]])
    range_m = float(np.linalg.norm(position - axis))
    error = tracked_approach_error_m(
        stereo_range_error_m(range_m, disparity_px_m(mast.left, mast.right), 1.0),
        drift_error_m(range_m, mast.left.focal_lengths[0], DRIFT_PX),
    )
    return HandOff(HandOffOutcome.HANDED_OFF, ArmTarget(position, error))
