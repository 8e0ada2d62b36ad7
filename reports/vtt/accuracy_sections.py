"""Sections on the accuracy of the target's position: at the goal, and Table I of the paper as printed and as measured.

Sections, equations and tables are those of Kim et al., "Targeted Driving Using Visual Tracking".
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from marsyard.algorithms.interface import TargetLoss
from marsyard.algorithms.vtt.accuracy import (
    GOAL_M,
    NAVCAM,
    NAVIGATION_ERROR,
    PANCAM,
    START_M,
    AccuracyRow,
    drift_error_m,
    stereo_range_error_m,
    table_1,
    tracked_approach_error_m,
)
from marsyard.reports import populations, rates
from marsyard.reports.blocks import distribution_block
from marsyard.reports.column_values import numbers
from marsyard.reports.papers import read_paper
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Block, Grid, Section, Subject, build_grid, create_section, has_values
from marsyard.reports.statistics.samples import quantile_bounds
from marsyard.reports.vtt.tracking_runs import is_closed_loop, selectable_targets
from marsyard.reports.wording import NOTHING, format_fraction, note_text
from marsyard.scenarios.rover.run_state import RunOutcome


def losses_grid(frame: pd.DataFrame) -> Grid:
    """Count runs that ended without a tracked target, by outcome and loss criteria."""
    failed_runs = frame[~populations.flag_mask(frame, "tracked")]
    has_clouds = "clear_sky" in failed_runs and rates.flag_fraction(failed_runs, "clear_sky", value=False).hits > 0
    rows = []
    for (outcome, losses), runs in failed_runs.groupby([failed_runs["outcome"], failed_runs["losses"].fillna(NOTHING)]):
        azimuth = rates.finite_values(runs, "azimuth_change_max_deg")
        azimuth_text = f"{azimuth.max():.1f}" if azimuth.size else NOTHING
        distance_text = rates.median_text(rates.finite_values(runs, "lost_range_m"), 1)
        loss_text = str(losses).replace("_", " ").lower()
        row = [str(outcome), loss_text, f"{len(runs):,}", distance_text, azimuth_text]
        n_cloudy = rates.flag_fraction(runs, "clear_sky", value=False).hits if has_clouds else 0
        rows.append([*row, f"{n_cloudy:,}"] if has_clouds else row)
    rows.sort(key=lambda row: -int(row[2].replace(",", "")))
    head = ["Outcome", "Lost by", "Runs", "Lost at a range of (m)", "Maximum azimuth change (deg)"]
    return Grid([*head, "With clouds"] if has_clouds else head, rows)


def losses_note(frame: pd.DataFrame) -> str:
    """Describe the table of `losses_grid`, with the meaning of the loss criteria that occur."""
    occurring = ", ".join(frame.loc[~populations.flag_mask(frame, "tracked"), "losses"].dropna().astype(str)).split(
        ", "
    )
    meanings = [
        f"{loss.name.replace('_', ' ').capitalize()}: {loss.value}." for loss in TargetLoss if loss.name in occurring
    ]
    text = (
        'The runs ended without the target within 5 px of its true projection at the goal. "Lost by" gives the '
        "criteria (section 4.6 of the paper) of the first update that lost the target. Ranges are medians, with "
        "minimum to maximum in brackets. The azimuth change is that of the line of sight in the world between two "
        "updates with a match."
    )
    return " ".join([text, *meanings])


#: Maximum position error for the instrument placement (section 4.2), metres, and required quantile of the runs.
MAX_ERROR_M, QUANTILE = 0.03, 0.99
#: Names of the rates of a camera's runs at selectable targets, and their keys in `summarize_cameras`.
_RATES: Mapping[str, str] = {
    "Completed": "completed",
    "Within 5 px of the true projection at the goal": "tracked",
    f"Within {100.0 * MAX_ERROR_M:g} cm (of completed runs)": "within",
    "False track": "false_tracks",
}
#: Columns of lengths in the table of errors, and their keys in `summarize_cameras`.
_ERRORS: Mapping[str, str] = {
    "Position error, median (cm)": "median_m",
    f"Position error, {format_fraction(QUANTILE)} quantile (cm)": "quantile_m",
    f"Upper bound of the {format_fraction(QUANTILE)} quantile (cm)": "quantile_bound_m",
    "Error along the line of sight, rms (cm)": "range_rms_m",
    "Error across the line of sight, rms (cm)": "cross_rms_m",
    "Drift, median (px)": "drift_median_px",
    f"Drift, {format_fraction(QUANTILE)} quantile (px)": "drift_quantile_px",
}


def _group_by_camera(runs: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield the name of each camera and its rows."""
    for name in sorted(runs["camera"].dropna().unique()):
        yield str(name), runs[runs["camera"].eq(name)]


def summarize_cameras(runs: pd.DataFrame) -> list[dict[str, Any]]:
    """Summarize each camera: rates (`_RATES`), and position errors and drift of its completed runs.

    `range` and `cross` are the error components along and across the line of sight.
    """
    rows = []
    for camera, camera_rows in _group_by_camera(runs):
        is_completed = np.isfinite(numbers(camera_rows, "position_error_m"))
        completed_runs = camera_rows[is_completed]
        error, drift = (rates.finite_values(completed_runs, name) for name in ("position_error_m", "drift_px"))
        _, bound = quantile_bounds(error, QUANTILE, CONFIDENCE, rates.terrain_groups(completed_runs))
        rows.append(
            {
                "camera": camera,
                "completed": rates.fraction_of(is_completed, camera_rows),
                "tracked": rates.flag_fraction(camera_rows, "tracked"),
                "within": rates.fraction_of(error <= MAX_ERROR_M, completed_runs),
                "false_tracks": rates.flag_fraction(camera_rows, "no_false_track", value=False),
                "median_m": rates.quantile(error, 0.5),
                "quantile_m": rates.quantile(error, QUANTILE),
                "quantile_bound_m": bound,
                "range_rms_m": rates.rms(rates.finite_values(completed_runs, "range_error_m")),
                "cross_rms_m": rates.rms(rates.finite_values(completed_runs, "cross_error_m")),
                "drift_median_px": rates.quantile(drift, 0.5),
                "drift_quantile_px": rates.quantile(drift, QUANTILE),
            }
        )
    return rows


def _errors_grid(cameras: Sequence[Mapping[str, Any]]) -> Grid:
    """Create the table of errors in centimetres and of drift in pixels; columns without any value are omitted."""
    columns = {heading: name for heading, name in _ERRORS.items() if np.isfinite([row[name] for row in cameras]).any()}
    rows = []
    for row in cameras:
        values = [(100.0 if name.endswith("_m") else 1.0) * row[name] for name in columns.values()]
        rows.append([row["camera"], *(f"{value:.2f}" if np.isfinite(value) else "too few runs" for value in values)])
    return Grid(["Camera", *columns], rows)


def _create_camera_blocks(runs: pd.DataFrame) -> list[Block]:
    """Create the tables of rates and errors of each camera, and of the runs that lost the target."""
    cameras = summarize_cameras(runs)
    rows = [
        [row["camera"], name, rates.fraction_text(row[rate]), rates.interval_text(row[rate])]
        for row in cameras
        for name, rate in _RATES.items()
    ]
    run_grid = Grid(["Camera", "Result", "Runs", f"{format_fraction(CONFIDENCE)} interval"], rows)
    blocks = [
        Block(
            "Runs at selectable targets",
            grid=run_grid,
            note=note_text("vtt.goal_rates", completed=RunOutcome.COMPLETED.value),
            data={"cameras": cameras},
        )
    ]
    if any(row["completed"].hits for row in cameras):
        grid, note = _errors_grid(cameras), _describe_errors(cameras)
        blocks.append(Block(heading="Errors of the completed runs at the goal", grid=grid, note=note))
    loss_grid = losses_grid(runs)
    if loss_grid.rows:
        blocks.append(Block(heading="Runs that lost the target", grid=loss_grid, note=losses_note(runs)))
    return blocks


#: Example of a pointing error of the mast, degrees; the notes name the position error that it causes.
_POINTING_ERROR_DEG = 0.1


def pointing_error_cm(range_m: float) -> float:
    """Compute the position error that `_POINTING_ERROR_DEG` causes at a range, centimetres."""
    return 100.0 * range_m * math.radians(_POINTING_ERROR_DEG)


def _describe_errors(cameras: Sequence[Mapping[str, Any]]) -> str:
    """Describe the errors, those of the paper's cameras by Eqs. 1 and 4, and the runs that the quantiles need."""
    designs = (PANCAM, NAVCAM)
    stereo, drift = (
        " and ".join(f"{100.0 * error_m:.{digits}f} cm ({design.name.lower()})" for design, error_m in errors)
        for digits, errors in (
            (2, [(design, stereo_range_error_m(GOAL_M, design.focal_px, design.baseline_m)) for design in designs]),
            (3, [(design, drift_error_m(GOAL_M, design.focal_px, 1.0)) for design in designs]),
        )
    )
    text = (
        "The position error is the distance of the reported from the true position of the designated point, in the "
        "rover frame. Drift: distance in the last image from the tracked target to the true projection. By Eqs. 1 and "
        f"4 of the paper, 1 px of disparity error at {GOAL_M:g} m is {stereo} along the line of sight, and 1 px of "
        f"drift is {drift} across it. The measured errors also contain errors of the camera calibration and of the "
        f"mast's pointing: {_POINTING_ERROR_DEG:g} deg is {pointing_error_cm(GOAL_M):.2f} cm at {GOAL_M:g} m."
    )
    if all(np.isfinite(row["quantile_bound_m"]) for row in cameras):
        return text
    # the largest of n values is an upper bound of the quantile q at the confidence c if q^n <= 1 - c
    name, min_runs = format_fraction(QUANTILE), math.ceil(math.log(1.0 - CONFIDENCE) / math.log(QUANTILE))
    return (
        f"{text} Too few runs: for a camera, the {name} quantile needs at least {round(1.0 / (1.0 - QUANTILE))} runs, "
        f"and its upper bound at {format_fraction(CONFIDENCE)} confidence at least {min_runs} runs, "
        "or terrains if runs share terrains."
    )


def goal_section(subject: Subject) -> Section | None:
    """Create the section on the position error at the goal; None unless the tracker guides the rover to a goal."""
    if not is_closed_loop(subject.frame):
        return None
    runs = selectable_targets(subject.frame)
    if not has_values(runs, "camera"):
        return None
    curves = {
        f"{camera} ({error.size:,})": error
        for camera, camera_rows in _group_by_camera(runs)
        if (error := rates.finite_values(camera_rows, "position_error_m", 100.0)).size
    }
    distribution = distribution_block(
        "goal",
        curves,
        ("position error at the goal (cm)", "fraction of completed runs"),
        "Completed runs at selectable targets; their number is in brackets. Red line: requirement of "
        f"{100.0 * MAX_ERROR_M:g} cm.",
        bound=100.0 * MAX_ERROR_M,
    )
    return create_section(
        "goal", "Goal", "Target position error at the goal", distribution, *_create_camera_blocks(runs)
    )


#: Table I as printed.
PRINTED = {
    name: AccuracyRow(name, **row)
    for name, row in read_paper(Path(__file__).with_name("paper.toml"))["table_1"].items()
}
#: Maximum relative deviation of the start and goal distances of a run from those of Table I.
_MAX_DEVIATION = 0.1


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


def measured_accuracy(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """Compute the 3-sigma errors (three times the root mean square) of the completed runs of each camera.

    untracked_cm: error without tracking, computed by Eq. 3 from the errors of designation and pose

    The disparity error cannot be computed from the designation error by Eq. 1, because most of the designation error
    is caused by the mast and lies across the line of sight.
    """
    if not is_closed_loop(frame) or "designation_error_m" not in frame or "camera" not in frame:
        return []
    distances = {"range_start_m": START_M, "range_end_m": GOAL_M}
    is_near = [np.abs(numbers(frame, name) / value - 1.0) < _MAX_DEVIATION for name, value in distances.items()]
    is_completed = np.isfinite(numbers(frame, "position_error_m"))
    completed_runs = selectable_targets(frame[np.logical_and.reduce([*is_near, is_completed])])
    # factor 300: 3 sigma in centimetres
    rows = []
    for camera in sorted(completed_runs["camera"].unique()):
        runs = completed_runs[completed_runs["camera"].eq(camera)]
        designation, pose = numbers(runs, "designation_error_m"), numbers(runs, "pose_error_m")
        rows.append(
            {
                "camera": str(camera),
                "runs": len(runs),
                "designation_cm": 300.0 * rates.rms(designation),
                "untracked_cm": 300.0 * rates.rms(np.hypot(designation, pose)),
                "tracked_cm": 300.0 * rates.rms(numbers(runs, "position_error_m")),
                "drift_px": rates.rms(numbers(runs, "drift_px")),
            }
        )
    return rows


def _measured_grid(accuracy: Sequence[Mapping[str, Any]]) -> Grid:
    quantities = ("Designation", "Without tracking", "With tracking")
    pairs = [(f"{name} (cm)", f"Paper: {name.lower()} (cm)") for name in quantities[:2]]
    pairs.append((f"{quantities[2]} (cm)", "Paper's formula: with tracking (cm)"))
    rows = []
    for row in accuracy:
        printed_row = next(
            (row_of_paper for name, row_of_paper in PRINTED.items() if row["camera"].endswith(name.lower())), None
        )
        paper = [NOTHING] * 3
        if printed_row is not None:
            # the formula holds in any unit of length
            paper_cm = tracked_approach_error_m(printed_row.stereo_cm, printed_row.drift_cm_px * row["drift_px"])
            paper = [f"{printed_row.designation_cm:g}", f"{printed_row.untracked_cm:.1f}", f"{paper_cm:.1f}"]
        measured = [f"{row[name]:.1f}" for name in ("designation_cm", "untracked_cm", "tracked_cm")]
        texts = [text for pair in zip(measured, paper, strict=True) for text in pair]
        rows.append([row["camera"], f"{row['runs']:,}", *texts, f"{row['drift_px']:.1f}"])
    return Grid(["Camera", "Runs", *(heading for pair in pairs for heading in pair), "Drift, rms (px)"], rows)
