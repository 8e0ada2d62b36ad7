"""Table I of the tracking paper: computed from its equations, as printed, and measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from types import MappingProxyType

import numpy as np
import pandas as pd

from marsyard.algorithms.vtt.accuracy import GOAL_M, START_M, AccuracyRow, table_1, tracked_approach_error_m
from marsyard.reports.columns import numbers
from marsyard.reports.section import Block, Section, Subject
from marsyard.reports.sections import Grid
from marsyard.reports.vtt.rows import is_closed_loop, selectable
from marsyard.reports.wording import number

#: The table's own digits: designation and untracked error, and the two numbers of its last column; centimetres.
PRINTED: Mapping[str, AccuracyRow] = MappingProxyType(
    {"Pancam": AccuracyRow("Pancam", 9.7, 18.7, 0.4, 0.06), "Navcam": AccuracyRow("Navcam", 38.8, 42.0, 1.6, 0.16)}
)
#: Runs count whose distances from the camera differ from the table's by no more than this share.
_NEAR = 0.1


@dataclass(frozen=True)
class Measured:
    """Errors of one camera's runs: three times their root mean square, centimetres, as the paper tells 3 sigma.

    Attributes
    ----------
    camera
        `pancam` or `navcam`.
    runs
        Completed runs.
    designation_cm
        Of the target as first triangulated.
    disparity_px
        Disparity error, 1 sigma, that Eq. 1 makes of it for the camera as it was.
    untracked_cm
        By Eq. 3 from the designation's error and that of the pose at the goal.
    tracked_cm
        Of the position reported at the goal.
    drift_px
        Drift at the goal, root mean square.
    """

    camera: str
    runs: int
    designation_cm: float
    disparity_px: float
    untracked_cm: float
    tracked_cm: float
    drift_px: float


def table_1_section(subject: Subject) -> Section | None:
    """Table I; None where no completed run goes from the paper's 10 m to its 2 m."""
    found = measured(subject.frame)
    if not found:
        return None
    computed = {row.name: row for row in table_1()}
    head = ["Camera", "", "Designation (cm)", "Approach without tracker (cm)", "Approach with N px of drift (cm)"]
    rows = []
    for name, printed in PRINTED.items():
        for kind, row in (("printed", printed), ("computed", computed[name])):
            rows.append([name, kind, f"{row.designation_cm:g}", f"{row.untracked_cm:.1f}", row.tracked_formula])
    note = (
        "All 3 sigma. Computed by Eqs. 1 to 5 with the 4.65 µm pixel of the manufacturer, each column rounded "
        "before the next is computed from it."
    )
    measured_note = (
        f"Selectable targets of completed runs from {START_M:g} m to {GOAL_M:g} m: three times the root mean square. "
        "Without tracker: by Eq. 3 from the measured errors of designation and pose, whatever odometry the runs "
        "had; the paper's is visual. Table I, the same: its last column for the drift measured. The paper takes 1 "
        "px as the disparity error of 3 sigma; the error, calibration included, that Eq. 1 makes of the designation "
        "stands beside."
    )
    blocks = [
        Block(heading="Computed", grid=Grid(head, rows), note=note),
        Block(heading="Measured", grid=_measured_grid(found), note=measured_note),
    ]
    data = {
        "computed": {name: asdict(row) for name, row in computed.items()},
        "printed": {name: asdict(row) for name, row in PRINTED.items()},
        "measured": [asdict(one) for one in found],
    }
    return Section("table-1", "Table I", "Table I: accuracy of a target's position", blocks, data)


def measured(frame: pd.DataFrame) -> list[Measured]:
    """Measured errors by camera."""
    if not is_closed_loop(frame) or "designation_error_m" not in frame or "camera" not in frame:
        return []
    near = _is_near(frame, "range_start_m", START_M) & _is_near(frame, "range_end_m", GOAL_M)
    runs = selectable(frame[near & np.isfinite(numbers(frame, "position_error_m"))])
    return [_measured(runs[runs["camera"].eq(name)], str(name)) for name in sorted(runs["camera"].unique())]


def _is_near(frame: pd.DataFrame, column: str, distance_m: float) -> np.ndarray:
    return np.asarray(np.abs(numbers(frame, column) / distance_m - 1.0) < _NEAR)


def _measured(runs: pd.DataFrame, camera: str) -> Measured:
    designation, pose = numbers(runs, "designation_error_m"), numbers(runs, "pose_error_m")
    per_px = numbers(runs, "designation_3_sigma_m")
    return Measured(
        camera=camera,
        runs=len(runs),
        designation_cm=300.0 * _rms(designation),
        disparity_px=_rms(designation / per_px),
        untracked_cm=300.0 * _rms(np.hypot(designation, pose)),
        tracked_cm=300.0 * _rms(numbers(runs, "position_error_m")),
        drift_px=_rms(numbers(runs, "drift_px")),
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _measured_grid(found: list[Measured]) -> Grid:
    head = ["Camera", "Runs", "Designation (cm)", "Table I", "Disparity error, 1 sigma (px)"]
    head += [
        "Approach without tracker (cm)",
        "Table I",
        "Approach with tracker (cm)",
        "Table I, the same",
        "Drift rms (px)",
    ]
    rows = []
    for one in found:
        printed = next((row for name, row in PRINTED.items() if one.camera.endswith(name.lower())), None)
        paper = ["–"] * 3
        if printed is not None:
            tracked = tracked_approach_error_m(printed.stereo_cm, printed.drift_cm_px * one.drift_px)
            paper = [f"{printed.designation_cm:g}", f"{printed.untracked_cm:.1f}", f"{tracked:.1f}"]
        cells = [f"{one.designation_cm:.1f}", paper[0], number(one.disparity_px), f"{one.untracked_cm:.1f}", paper[1]]
        rows.append([one.camera, f"{one.runs:,}", *cells, f"{one.tracked_cm:.1f}", paper[2], f"{one.drift_px:.1f}"])
    return Grid(head, rows)
