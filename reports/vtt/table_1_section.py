"""Section on Table I of the paper: accuracy of a target's position as printed, as computed, and as measured.

Equations and tables are those of Kim et al., "Targeted Driving Using Visual Tracking".
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from marsyard.algorithms.vtt.accuracy import (
    GOAL_M,
    NAVIGATION_ERROR,
    START_M,
    AccuracyRow,
    table_1,
    tracked_approach_error_m,
)
from marsyard.reports import rates
from marsyard.reports.column_values import numbers
from marsyard.reports.section import Block, Grid, Section, Subject, build_grid
from marsyard.reports.vtt.goal_section import pointing_error_cm
from marsyard.reports.vtt.tracking_runs import PAPER, is_closed_loop, selectable_targets
from marsyard.reports.wording import NOTHING, note_text

#: Table I as printed.
PRINTED = {name: AccuracyRow(name, **row) for name, row in PAPER["table_1"].items()}
#: Maximum relative deviation of the start and goal distances of a run from those of Table I.
_MAX_DEVIATION = 0.1
#: Three standard deviations in centimetres, of a standard deviation of 1 m.
_THREE_SIGMA_CM = 300.0


def table_1_section(subject: Subject) -> Section | None:
    """Create the section on Table I: computed, printed and measured; None without completed runs from 10 m to 2 m."""
    accuracy = measured_accuracy(subject.frame)
    if not accuracy:
        return None
    computed_rows = {row.name: row for row in table_1()}
    pairs = [
        (source, row[name]) for name in PRINTED for source, row in (("paper", PRINTED), ("computed", computed_rows))
    ]
    grid = build_grid(
        pairs,
        {
            "Camera": lambda pair: pair[1].name,
            "Source": lambda pair: pair[0],
            "3 sigma at the designation (cm)": lambda pair: f"{pair[1].designation_cm:g}",
            "3 sigma at the goal without tracking (cm)": lambda pair: f"{pair[1].untracked_cm:.1f}",
            "3 sigma at the goal with tracking, drift of N px (cm)": lambda pair: pair[1].tracked_formula,
        },
    )
    blocks = [
        Block(
            heading="Computed",
            grid=grid,
            note=note_text(
                "vtt.table_1_computed",
                start=f"{START_M:g}",
                goal=f"{GOAL_M:g}",
                odometry=f"{100.0 * NAVIGATION_ERROR:g}",
            ),
        ),
        Block(
            heading="Measured in this campaign",
            grid=_measured_grid(accuracy),
            note=note_text(
                "vtt.table_1_measured",
                deviation=f"{100.0 * _MAX_DEVIATION:g}",
                start=f"{START_M:g}",
                goal=f"{GOAL_M:g}",
                start_error=f"{pointing_error_cm(START_M):.1f}",
                goal_error=f"{pointing_error_cm(GOAL_M):.2f}",
            ),
        ),
    ]
    data = {"computed": computed_rows, "printed": PRINTED, "measured": accuracy}
    return Section(
        "table-1", "Position accuracy", "Accuracy of a target's position (Table I of the paper)", blocks, data
    )


@dataclass(frozen=True)
class MeasuredAccuracy:
    """3-sigma errors (three times the root mean square) of the completed runs of a camera, centimetres.

    - designation_cm, tracked_cm: errors at the designation, and at the goal with tracking
    - untracked_cm: error at the goal without tracking, computed by Eq. 3 from the errors of designation and pose
    - drift_px: root mean square of the drift, pixels
    """

    camera: str
    runs: int
    designation_cm: float
    untracked_cm: float
    tracked_cm: float
    drift_px: float


def measured_accuracy(frame: pd.DataFrame) -> list[MeasuredAccuracy]:
    """Compute the errors of the completed runs of each camera with the distances of Table I.

    The disparity error cannot be computed from the designation error by Eq. 1, because most of the designation error
    is caused by the mast and lies across the line of sight.
    """
    if not is_closed_loop(frame) or "designation_error_m" not in frame or "camera" not in frame:
        return []
    distances = {"range_start_m": START_M, "range_end_m": GOAL_M}
    is_near = [np.abs(numbers(frame, name) / value - 1.0) < _MAX_DEVIATION for name, value in distances.items()]
    is_completed = np.isfinite(numbers(frame, "position_error_m"))
    completed_runs = selectable_targets(frame[np.logical_and.reduce([*is_near, is_completed])])
    rows = []
    for camera in sorted(completed_runs["camera"].unique()):
        runs = completed_runs[completed_runs["camera"].eq(camera)]
        designation, pose = numbers(runs, "designation_error_m"), numbers(runs, "pose_error_m")
        rows.append(
            MeasuredAccuracy(
                camera=str(camera),
                runs=len(runs),
                designation_cm=_THREE_SIGMA_CM * rates.rms(designation),
                untracked_cm=_THREE_SIGMA_CM * rates.rms(np.hypot(designation, pose)),
                tracked_cm=_THREE_SIGMA_CM * rates.rms(numbers(runs, "position_error_m")),
                drift_px=rates.rms(numbers(runs, "drift_px")),
            )
        )
    return rows


def _measured_grid(accuracy: Sequence[MeasuredAccuracy]) -> Grid:
    """Create the table of measured errors, each next to that of the paper for the camera."""
    quantities = ("Designation", "Without tracking", "With tracking")
    pairs = [(f"{name} (cm)", f"Paper: {name.lower()} (cm)") for name in quantities[:2]]
    pairs.append((f"{quantities[2]} (cm)", "Paper's formula: with tracking (cm)"))
    rows = []
    for row in accuracy:
        printed_row = next(
            (row_of_paper for name, row_of_paper in PRINTED.items() if row.camera.endswith(name.lower())), None
        )
        paper = [NOTHING] * 3
        if printed_row is not None:
            # the formula holds in any unit of length
            paper_cm = tracked_approach_error_m(printed_row.stereo_cm, printed_row.drift_cm_px * row.drift_px)
            paper = [f"{printed_row.designation_cm:g}", f"{printed_row.untracked_cm:.1f}", f"{paper_cm:.1f}"]
        measured = [f"{value:.1f}" for value in (row.designation_cm, row.untracked_cm, row.tracked_cm)]
        texts = [text for pair in zip(measured, paper, strict=True) for text in pair]
        rows.append([row.camera, f"{row.runs:,}", *texts, f"{row.drift_px:.1f}"])
    return Grid(["Camera", "Runs", *(heading for pair in pairs for heading in pair), "Drift, rms (px)"], rows)
