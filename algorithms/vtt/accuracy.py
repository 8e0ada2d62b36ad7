"""Approach accuracy (tracking paper: Eqs. 1 to 5, Table I), and hand-off of the target to the arm (sections 3, 7.4).

Errors are in metres, and in centimetres in the rows of Table I. They are 3-sigma values if the disparity error is a
3-sigma value (paper: 1 pixel).

Sections, equations and tables are those of Kim et al., "Targeted Driving Using Visual Tracking".
"""

from __future__ import annotations

from dataclasses import dataclass
from decimal import ROUND_HALF_UP, Decimal
from enum import Enum

import numpy as np
from jaxtyping import Float

from marsyard.algorithms.interface import TargetUpdate
from marsyard.algorithms.vtt.stereo import disparity_px_m
from marsyard.sim.measurements import MastCalibration

#: Target distances before and after the traverse (section 4.2), metres.
START_M, GOAL_M = 10.0, 2.0
#: Error of wheel and visual odometry, fraction of the distance: "roughly 2% of the rover travel distance".
NAVIGATION_ERROR = 0.02


@dataclass(frozen=True)
class StereoDesign:
    """Design parameters of a stereo camera: name, focal length, pixel pitch and baseline."""

    name: str
    focal_length_m: float
    pixel_m: float
    baseline_m: float

    @property
    def focal_px(self) -> float:
        """Focal length in pixels, Eq. 2."""
        return self.focal_length_m / self.pixel_m


#: Cameras of section 4.2. With the manufacturer's pixel pitch the printed digits of Table I are reproduced.
PANCAM = StereoDesign("Pancam", 16e-3, 4.65e-6, 0.30)
NAVCAM = StereoDesign("Navcam", 6e-3, 4.65e-6, 0.20)


def stereo_range_error_m(range_m: float, focal_px: float, baseline_m: float, disparity_error_px: float = 1.0) -> float:
    """Stereo range error, Eq. 1: ``R^2 / (f_p B) * disparity error``, with f_p the focal length and B the baseline."""
    return range_m * range_m / (focal_px * baseline_m) * disparity_error_px


def drift_error_m(range_m: float, focal_px: float, drift_px: float) -> float:
    """Error perpendicular to the line of sight, caused by a drift of the tracked point in the image, Eq. 4."""
    return range_m / focal_px * drift_px


def tracked_approach_error_m(stereo_error_m: float, drift_error_m: float) -> float:
    """Error at the goal with a tracker, Eq. 5: root sum square of stereo error at the goal and drift error."""
    return float(np.hypot(stereo_error_m, drift_error_m))


def round_half_up(value: float, digits: int) -> float:
    """Round half away from zero, as in printed tables.

    Rounding errors below 1e-9 are removed first: the equations give 38.7499... instead of 38.75 cm.
    """
    return float(Decimal(str(round(value, 9))).quantize(Decimal(1).scaleb(-digits), ROUND_HALF_UP))


@dataclass(frozen=True)
class AccuracyRow:
    """Row of Table I as printed, centimetres, 3 sigma.

    - name: Camera
    - designation_cm: Stereo range error at 10 m
    - untracked_cm: Approach error at 2 m after a drive of 8 m with visual odometry and without tracker
    - stereo_cm: Stereo range error at 2 m: the first term of the last column
    - drift_cm_px: Error per pixel of drift at 2 m: the factor of N in the last column
    """

    name: str
    designation_cm: float
    untracked_cm: float
    stereo_cm: float
    drift_cm_px: float

    def tracked_cm(self, drift_px: float) -> float:
        """Evaluate the last column (approach error with tracker, cm) for a drift in pixels."""
        return tracked_approach_error_m(self.stereo_cm, self.drift_cm_px * drift_px)

    @property
    def tracked_formula(self) -> str:
        """Formula of the last column as printed."""
        return f"sqrt({self.stereo_cm:g}^2 + ({self.drift_cm_px:g} N)^2)"


def accuracy_row(design: StereoDesign) -> AccuracyRow:
    """Compute a row of Table I.

    The error without tracker (Eq. 3) is the root sum square of the stereo error at designation and the odometry error.

    Each column is rounded before the next one is computed, as in the paper: 42.0 cm for the navcam is
    ``sqrt(38.8^2 + 16^2)``; with 38.75 it would be 41.9.
    """
    designation = round_half_up(100.0 * stereo_range_error_m(START_M, design.focal_px, design.baseline_m), 1)
    navigation = 100.0 * NAVIGATION_ERROR * (START_M - GOAL_M)
    return AccuracyRow(
        name=design.name,
        designation_cm=designation,
        untracked_cm=round_half_up(float(np.hypot(designation, navigation)), 1),
        stereo_cm=round_half_up(100.0 * stereo_range_error_m(GOAL_M, design.focal_px, design.baseline_m), 1),
        drift_cm_px=round_half_up(100.0 * drift_error_m(GOAL_M, design.focal_px, 1.0), 2),
    )


def table_1() -> tuple[AccuracyRow, AccuracyRow]:
    """Compute Table I: pancam and navcam."""
    return accuracy_row(PANCAM), accuracy_row(NAVCAM)


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


def hand_off(update: TargetUpdate, goal: GoalCriterion, mast: MastCalibration, drift_px: float = 2.5) -> HandOff:
    """Hand the target over to the arm if it is tracked and the rover is at its goal.

    `drift_px` is the assumed drift (paper: 2.5 px from 10 m to 2 m). The error is computed for the range from the
    mast's elevation axis.
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
        drift_error_m(range_m, mast.left.focal_lengths[0], drift_px),
    )
    return HandOff(HandOffOutcome.HANDED_OFF, ArmTarget(position, error))
