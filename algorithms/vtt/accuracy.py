"""Approach accuracy of target tracking (tracking paper: Eqs. 1 to 5, Table I).

Errors are in metres, and in centimetres in the rows of Table I. They are 3-sigma values if the disparity error is a
3-sigma value (paper: 1 pixel).

Sections, equations and tables are those of Kim et al., "Targeted Driving Using Visual Tracking".
"""

from dataclasses import dataclass
from decimal import ROUND_HALF_UP, Decimal

import numpy as np

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
