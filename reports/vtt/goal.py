"""Selection of rows of tracking campaigns, and the section on the target's position error at the goal by camera.

Sections and equations are those of Kim et al., "Targeted Driving Using Visual Tracking".
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd

from marsyard.algorithms.vtt.accuracy import GOAL_M, NAVCAM, PANCAM, drift_error_m, stereo_range_error_m
from marsyard.reports import rates
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Block, Grid, Subject, build_grid
from marsyard.reports.section_kinds import BlocksAndData, CustomBlocks, Distribution, Rows, SectionDeclaration
from marsyard.reports.statistics.samples import quantile_bounds
from marsyard.reports.wording import NOTHING, format_fraction, note_text, number, numbers

#: Columns of all rows of tracking cases.
_TRACKING_COLUMNS = ("tracked", "drift_px", "position_error_m", "losses")
#: Maximum position error for the instrument placement (section 4.2), metres, and required quantile of the runs.
MAX_ERROR_M, QUANTILE = 0.03, 0.99
#: Names of the rates of a camera's runs at selectable targets, and their keys in `summarize_cameras`.
_RATES: Mapping[str, str] = {
    "Completed": "completed",
    "Within 10 px of the true projection at the goal": "tracked",
    f"Within {100.0 * MAX_ERROR_M:g} cm (of completed runs)": "within",
    "False track": "false_tracks",
}


def is_tracking(frame: pd.DataFrame) -> bool:
    """Whether the rows are those of tracking cases."""
    return {*_TRACKING_COLUMNS} <= {*frame}


def is_closed_loop(frame: pd.DataFrame) -> bool:
    """Whether the tracker guides the rover; in other campaigns, many targets are tracked in the same images."""
    return is_tracking(frame) and "skipped_stops" not in frame


def selectable_targets(frame: pd.DataFrame) -> pd.DataFrame:
    """Select rows with selectable targets: sunlit, in both images to the end, on the rock's face, not on its edge."""
    return frame[rates.all_flags(frame, "selectable", "in_view", "on_face")]


def goal_rows(subject: Subject) -> Rows | None:
    """Select rows with selectable targets; None unless the tracker guides the rover to a goal."""
    frame = subject.frame
    return selectable_targets(frame) if is_closed_loop(frame) and "camera" in frame else None


def _group_by_camera(runs: Rows) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield the name of each camera and its rows."""
    for name in sorted(runs["camera"].dropna().unique()):
        yield str(name), runs[runs["camera"].eq(name)]


def summarize_cameras(runs: Rows) -> list[dict[str, Any]]:
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


def _format_mm(name: str) -> Any:
    """Create a function that formats a length of a row in millimetres."""
    return lambda row: number(1000.0 * row[name]) if np.isfinite(row[name]) else "too few cases"


def _create_camera_blocks(runs: Rows, subject: Subject, key: str) -> BlocksAndData:
    """Create the tables of rates and errors of each camera, and of the runs that lost the target."""
    cameras = summarize_cameras(runs)
    rows = [
        [row["camera"], name, rates.fraction_text(row[rate]), rates.interval_text(row[rate])]
        for row in cameras
        for name, rate in _RATES.items()
    ]
    run_grid = Grid(["Camera", "", "Runs", f"{format_fraction(CONFIDENCE)} interval"], rows)
    error_grid = build_grid(
        cameras,
        {
            "Camera": lambda row: row["camera"],
            "Median (mm)": _format_mm("median_m"),
            f"{format_fraction(QUANTILE)} quantile (mm)": _format_mm("quantile_m"),
            f"Bound of the {format_fraction(QUANTILE)} quantile (mm)": _format_mm("quantile_bound_m"),
            "Error along the line of sight, rms (mm)": _format_mm("range_rms_m"),
            "Error across the line of sight, rms (mm)": _format_mm("cross_rms_m"),
            "Drift, median (px)": lambda row: number(row["drift_median_px"]),
            f"Drift, {format_fraction(QUANTILE)} quantile (px)": lambda row: number(row["drift_quantile_px"]),
        },
    )
    note = note_text("vtt.goal", confidence=format_fraction(CONFIDENCE))
    blocks = [
        Block(heading="Runs at selectable targets", grid=run_grid, note=note),
        Block(heading="Errors at the goal", grid=error_grid, note=_expected_errors()),
    ]
    loss_grid = losses_grid(runs)
    if loss_grid.rows:
        note = note_text("vtt.losses")
        blocks.append(Block(heading="Runs that lost the target", grid=loss_grid, note=note))
    data = [row | {rate: vars(row[rate]) for rate in _RATES.values()} for row in cameras]
    return blocks, {"cameras": data}


def _expected_errors() -> str:
    """Describe the errors of the paper's cameras at the goal by Eqs. 1 and 4."""
    errors = []
    for design in (PANCAM, NAVCAM):
        stereo = stereo_range_error_m(GOAL_M, design.focal_px, design.baseline_m)
        drift = drift_error_m(GOAL_M, design.focal_px, 1.0)
        errors.append(f"{design.name.lower()} {1000.0 * stereo:.1f} mm along and {1000.0 * drift:.2f} mm across")
    min_runs = math.ceil(math.log(1.0 - CONFIDENCE) / math.log(QUANTILE))
    return (
        f"Errors and drift are those of the completed runs at selectable targets. By Eqs. 1 and 4 of the paper, one "
        f"pixel of disparity error at {GOAL_M:g} m corresponds to an error along the line of sight, and one pixel of "
        f"drift to an error across it; for the paper's cameras: {'; '.join(errors)}. The measured errors also contain "
        f"those of the camera calibration and of the mast angles. The "
        f"bound of the {format_fraction(QUANTILE)} quantile at {format_fraction(CONFIDENCE)} confidence needs at least "
        f"{min_runs} runs."
    )


def losses_grid(frame: Rows) -> Grid:
    """Count runs that ended without a tracked target, by outcome and loss criteria."""
    failed_runs = frame[~rates.flag_mask(frame, "tracked")]
    rows = []
    for (outcome, losses), runs in failed_runs.groupby([failed_runs["outcome"], failed_runs["losses"].fillna(NOTHING)]):
        azimuth = rates.finite_values(runs, "azimuth_change_max_deg")
        distance = rates.finite_values(runs, "lost_range_m")
        azimuth_text = f"{azimuth.max():.1f}" if azimuth.size else NOTHING
        distance_text = f"{distance.min():.1f} to {distance.max():.1f}" if distance.size else NOTHING
        n_cloudy = rates.flag_fraction(runs, "clear_sky", value=False).hits if "clear_sky" in runs else 0
        loss_text = str(losses).replace("_", " ").lower()
        rows.append([str(outcome), loss_text, f"{len(runs):,}", distance_text, azimuth_text, f"{n_cloudy:,}"])
    rows.sort(key=lambda row: -int(row[2].replace(",", "")))
    return Grid(["Outcome", "Lost by", "Runs", "Lost at (m)", "Maximum azimuth change (deg)", "With clouds"], rows)


GOAL = SectionDeclaration(
    "goal",
    "Goal",
    "Target position error at the goal",
    rows=goal_rows,
    requires=("camera",),
    parts=(
        Distribution(
            lambda runs: {
                f"{camera} ({error.size:,})": error
                for camera, camera_rows in _group_by_camera(runs)
                if (error := rates.finite_values(camera_rows, "position_error_m", 100.0)).size
            },
            ("position error at the goal (cm)", "fraction of completed runs"),
            "Fraction of completed runs with a smaller error at the goal. Dashed line: the requirement.",
            bound=100.0 * MAX_ERROR_M,
        ),
        CustomBlocks(_create_camera_blocks),
    ),
)
