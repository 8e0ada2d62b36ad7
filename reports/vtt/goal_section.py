"""Section on the accuracy of the target's position at the goal, and tables of the runs that lost the target.

Sections and equations are those of Kim et al., "Targeted Driving Using Visual Tracking".
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from marsyard.algorithms.interface import TargetLoss
from marsyard.algorithms.vtt.accuracy import GOAL_M, NAVCAM, PANCAM, drift_error_m, stereo_range_error_m
from marsyard.reports import populations, rates
from marsyard.reports.blocks import distribution_block
from marsyard.reports.column_values import numbers
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Block, Grid, Section, Subject, create_section, has_values
from marsyard.reports.statistics.samples import quantile_bounds
from marsyard.reports.vtt.tracking_runs import is_closed_loop, selectable_targets
from marsyard.reports.wording import NOTHING, format_fraction, note_text
from marsyard.scenarios.rover.run_state import RunOutcome


def losses_grid(frame: pd.DataFrame) -> Grid:
    """Count runs that ended without a tracked target, by outcome and loss criteria, the largest number first."""
    failed_runs = frame[~populations.flag_mask(frame, "tracked")]
    has_clouds = "clear_sky" in failed_runs and rates.flag_fraction(failed_runs, "clear_sky", value=False).hits > 0
    groups = failed_runs.groupby([failed_runs["outcome"], failed_runs["losses"].fillna(NOTHING)])
    rows = []
    for (outcome, losses), runs in sorted(groups, key=lambda group: -len(group[1])):
        azimuth = rates.finite_values(runs, "azimuth_change_max_deg")
        azimuth_text = f"{azimuth.max():.1f}" if azimuth.size else NOTHING
        distance_text = rates.median_text(rates.finite_values(runs, "lost_range_m"), 1)
        loss_text = str(losses).replace("_", " ").lower()
        row = [str(outcome), loss_text, f"{len(runs):,}", distance_text, azimuth_text]
        n_cloudy = rates.flag_fraction(runs, "clear_sky", value=False).hits if has_clouds else 0
        rows.append([*row, f"{n_cloudy:,}"] if has_clouds else row)
    head = ["Outcome", "Lost by", "Runs", "Lost at a range of (m)", "Maximum azimuth change (deg)"]
    return Grid([*head, "With clouds"] if has_clouds else head, rows)


def losses_note(frame: pd.DataFrame) -> str:
    """Describe the table of `losses_grid`, with the meaning of the loss criteria that occur."""
    # a run can be lost by several criteria
    losses = frame.loc[~populations.flag_mask(frame, "tracked"), "losses"].dropna().astype(str)
    occurring = {name for names in losses for name in names.split(", ")}
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
    stereo_texts, drift_texts = [], []
    for camera in (PANCAM, NAVCAM):
        stereo_cm = 100.0 * stereo_range_error_m(GOAL_M, camera.focal_px, camera.baseline_m)
        drift_cm = 100.0 * drift_error_m(GOAL_M, camera.focal_px, 1.0)
        stereo_texts.append(f"{stereo_cm:.2f} cm ({camera.name.lower()})")
        drift_texts.append(f"{drift_cm:.3f} cm ({camera.name.lower()})")
    text = (
        "The position error is the distance of the reported from the true position of the designated point, in the "
        "rover frame. Drift: distance in the last image from the tracked target to the true projection. By Eqs. 1 and "
        f"4 of the paper, 1 px of disparity error at {GOAL_M:g} m is {' and '.join(stereo_texts)} along the line of "
        f"sight, and 1 px of drift is {' and '.join(drift_texts)} across it. The measured errors also contain errors "
        f"of the camera calibration and of the mast's pointing: {_POINTING_ERROR_DEG:g} deg is "
        f"{pointing_error_cm(GOAL_M):.2f} cm at {GOAL_M:g} m."
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
