"""Rows of tracking campaigns, and the section on the target's position at the goal by camera."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd

from marsyard.algorithms.vtt.accuracy import GOAL_M, NAVCAM, PANCAM, drift_error_m, stereo_range_error_m
from marsyard.reports import rates
from marsyard.reports.kinds import Distribution, Drawn, MadeBy, Rows, SectionDeclaration
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Block, Grid, Subject, build_grid
from marsyard.reports.statistics.samples import quantile_bounds
from marsyard.reports.wording import NOTHING, format_fraction, note_text, number, numbers

#: Columns of every row of a tracking case.
_TRACKING_COLUMNS = ("tracked", "drift_px", "position_error_m", "losses")
#: Requirement of the instrument placement (section 4.2), metres, and the quantile of runs that shall meet it.
WITHIN_M, QUANTILE = 0.03, 0.99
#: Rates of a camera's runs at selectable targets, by key. Tracked: the target is within the stated pixels at the goal.
_RATES: Mapping[str, str] = {
    "Completed": "completed",
    "Tracked at the goal": "tracked",
    f"Within {100.0 * WITHIN_M:g} cm, of completed": "within",
    "False track": "false_tracks",
}


def is_tracking(frame: pd.DataFrame) -> bool:
    """Whether rows are those of tracking cases."""
    return {*_TRACKING_COLUMNS} <= {*frame}


def is_closed_loop(frame: pd.DataFrame) -> bool:
    """Whether rows are those of runs that the tracker steers, not of pictures shared by many targets."""
    return is_tracking(frame) and "skip" not in frame


def selectable(frame: pd.DataFrame) -> pd.DataFrame:
    """Rows with selectable targets: lit, off the rock's edge, in both pictures to the end, on the stated face."""
    return frame[rates.all_flags(frame, "selectable", "in_view", "on_face")]


def goal_rows(subject: Subject) -> Rows | None:
    """Rows at selectable targets; None unless the tracker steers the runs to a goal."""
    frame = subject.frame
    return selectable(frame) if is_closed_loop(frame) and "camera" in frame else None


def _by_camera(runs: Rows) -> Iterator[tuple[str, pd.DataFrame]]:
    for name in sorted(runs["camera"].dropna().unique()):
        yield str(name), runs[runs["camera"].eq(name)]


def camera_runs(runs: Rows) -> list[dict[str, Any]]:
    """Each camera's rates (`_RATES`, each a `Share`), and position errors and drift of its completed runs."""
    rows = []
    for camera, ours in _by_camera(runs):
        reached = np.isfinite(numbers(ours, "position_error_m"))
        completed = ours[reached]
        error, drift = rates.known(completed, "position_error_m"), rates.known(completed, "drift_px")
        rows.append(
            {
                "camera": camera,
                "completed": rates.fraction_of(reached, ours),
                "tracked": rates.flag_fraction(ours, "tracked"),
                "within": rates.fraction_of(error <= WITHIN_M, completed),
                "false_tracks": rates.flag_fraction(ours, "true_track", wanted=False),
                "median_m": rates.quantile(error, 0.5),
                "quantile_m": rates.quantile(error, QUANTILE),
                "quantile_bound_m": quantile_bounds(error, QUANTILE, CONFIDENCE, rates.terrain_groups(completed))[1],
                "range_rms_m": rates.rms(rates.known(completed, "range_error_m")),
                "cross_rms_m": rates.rms(rates.known(completed, "cross_error_m")),
                "drift_median_px": rates.quantile(drift, 0.5),
                "drift_quantile_px": rates.quantile(drift, QUANTILE),
            }
        )
    return rows


def _millimetres(name: str) -> Any:
    return lambda one: number(1000.0 * one[name]) if np.isfinite(one[name]) else "n too small"


def _draw_cameras(runs: Rows, subject: Subject, key: str) -> Drawn:
    groups = camera_runs(runs)
    rows = [
        [one["camera"], name, rates.fraction_text(one[rate]), rates.interval_text(one[rate])]
        for one in groups
        for name, rate in _RATES.items()
    ]
    of_runs = Grid(["Camera", "", "Runs", f"{format_fraction(CONFIDENCE)} interval"], rows)
    of_errors = build_grid(
        groups,
        {
            "Camera": lambda one: one["camera"],
            "Median (mm)": _millimetres("median_m"),
            f"{format_fraction(QUANTILE)} quantile (mm)": _millimetres("quantile_m"),
            "Its bound (mm)": _millimetres("quantile_bound_m"),
            "Along, rms (mm)": _millimetres("range_rms_m"),
            "Across, rms (mm)": _millimetres("cross_rms_m"),
            "Drift, median (px)": lambda one: number(one["drift_median_px"]),
            f"Drift, {format_fraction(QUANTILE)} quantile (px)": lambda one: number(one["drift_quantile_px"]),
        },
    )
    note = note_text("vtt.goal", confidence=format_fraction(CONFIDENCE))
    blocks = [
        Block(heading="Runs at selectable targets", grid=of_runs, note=note),
        Block(heading="Errors at the goal", grid=of_errors, note=_expected_errors()),
    ]
    lost = losses_grid(runs)
    if lost.rows:
        note = note_text("vtt.losses")
        blocks.append(Block(heading="Runs that lost the target", grid=lost, note=note))
    data = [one | {rate: vars(one[rate]) for rate in _RATES.values()} for one in groups]
    return blocks, {"cameras": data}


def _expected_errors() -> str:
    """Errors of the paper's cameras at the goal by Eqs. 1 and 4."""
    errors = []
    for design in (PANCAM, NAVCAM):
        stereo = stereo_range_error_m(GOAL_M, design.focal_px, design.baseline_m)
        drift = drift_error_m(GOAL_M, design.focal_px, 1.0)
        errors.append(f"{design.name.lower()} {1000.0 * stereo:.1f} mm along and {1000.0 * drift:.2f} mm across")
    return (
        f"By Eqs. 1 and 4 a pixel of disparity and a pixel of drift at {GOAL_M:g} m are, for the paper's cameras: "
        f"{'; '.join(errors)}. Along: along the line of sight. Bound: of the {format_fraction(QUANTILE)} quantile at "
        f"{format_fraction(CONFIDENCE)} confidence (order statistics; it takes 230 runs)."
    )


def losses_grid(frame: Rows) -> Grid:
    """Runs that ended without a tracked target, by outcome and loss criteria."""
    failed = frame[~rates.flag(frame, "tracked")]
    rows = []
    for (outcome, losses), chosen in failed.groupby([failed["outcome"], failed["losses"].fillna(NOTHING)]):
        azimuth, distance = rates.known(chosen, "azimuth_change_max_deg"), rates.known(chosen, "lost_range_m")
        turned = f"{azimuth.max():.1f}" if azimuth.size else NOTHING
        where = f"{distance.min():.1f} to {distance.max():.1f}" if distance.size else NOTHING
        cloudy = rates.flag_fraction(chosen, "clear_sky", wanted=False).hits if "clear_sky" in chosen else 0
        words = str(losses).replace("_", " ").lower()
        rows.append([str(outcome), words, f"{len(chosen):,}", where, turned, f"{cloudy:,}"])
    rows.sort(key=lambda row: -int(row[2].replace(",", "")))
    return Grid(["Outcome", "Lost by", "Runs", "Lost at (m)", "Azimuth change, to (deg)", "With clouds"], rows)


GOAL = SectionDeclaration(
    "goal",
    "Goal",
    "Reported position of the target at the goal",
    rows=goal_rows,
    requires=("camera",),
    parts=(
        Distribution(
            lambda runs: {
                f"{camera} ({error.size:,})": error
                for camera, ours in _by_camera(runs)
                if (error := rates.known(ours, "position_error_m", 100.0)).size
            },
            ("position error at the goal (cm)", "fraction of completed runs"),
            "Fraction of completed runs up to each error at the goal; dashed: the requirement.",
            bound=100.0 * WITHIN_M,
        ),
        MadeBy(_draw_cameras),
    ),
)
