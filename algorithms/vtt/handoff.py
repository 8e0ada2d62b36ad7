"""Handing the target over to the arm at the goal (sections 3 and 7.4)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from jaxtyping import Float

from algorithms.interface import TrackingState
from algorithms.vtt.accuracy import drift_error_m, stereo_range_error_m, tracked_approach_error_m


class HandOffOutcome(Enum):
    """How a hand-off ended. Every member but HANDED_OVER is an expected failure: the arm gets no target."""

    HANDED_OVER = "the arm has the target"
    NOT_TRACKED = "the target is not tracked"
    NOT_AT_GOAL = "the rover is not at the commanded distance from the target"


@dataclass(frozen=True)
class ArmTarget:
    """What the arm gets.

    Attributes
    ----------
    position_rover
        The target in the rover frame, metres, shape (3,).
    error_m
        Its error of 3 sigma by Eq. 5, metres.
    """

    position_rover: Float[np.ndarray, "3"]
    error_m: float


@dataclass(frozen=True)
class HandOff:
    """The outcome, and the target if it was handed over."""

    outcome: HandOffOutcome
    target: ArmTarget | None


@dataclass(frozen=True)
class GoalReached:
    """When the rover is at its goal: the target's horizontal distance from the rover's origin, metres."""

    distance_m: float
    tolerance_m: float

    def holds(self, position_rover: Float[np.ndarray, "3"]) -> bool:
        """Whether a target at this position is at the commanded distance."""
        return abs(float(np.hypot(position_rover[0], position_rover[1])) - self.distance_m) <= self.tolerance_m


def hand_off(
    state: TrackingState,
    position_rover: Float[np.ndarray, "3"] | None,
    goal: GoalReached,
    optics: tuple[float, float, float],
    drift_px: float,
) -> HandOff:
    """The target for the arm, if it is tracked and the rover at its goal.

    `optics` are the target's distance from the camera (m), the focal length (px) and the baseline (m); `drift_px` the
    drift to allow for (paper: 2.5 px from 10 m to 2 m).
    """
    if state is not TrackingState.NORMAL or position_rover is None:
        return HandOff(HandOffOutcome.NOT_TRACKED, None)
    if not goal.holds(position_rover):
        return HandOff(HandOffOutcome.NOT_AT_GOAL, None)
    range_m, focal_px, baseline_m = optics
    error = tracked_approach_error_m(
        stereo_range_error_m(range_m, focal_px, baseline_m), drift_error_m(range_m, focal_px, drift_px)
    )
    return HandOff(HandOffOutcome.HANDED_OVER, ArmTarget(position_rover, error))
