"""The requirement on a target's position at the goal: error, drift, completion and harm, by camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from marsyard.algorithms.vtt.accuracy import GOAL_M, NAVCAM, PANCAM, drift_error_m, stereo_range_error_m
from marsyard.reports.answers import CONFIDENCE, Share, share_of
from marsyard.reports.columns import numbers
from marsyard.reports.figures import axis_edge, note_beyond
from marsyard.reports.plates import plate
from marsyard.reports.populations import terrain_groups
from marsyard.reports.section import Block, Section, Subject
from marsyard.reports.sections import Grid
from marsyard.reports.statistics.samples import quantile_bounds
from marsyard.reports.svg import REQUIREMENT, SERIES, in_page_style, new_axes
from marsyard.reports.vtt.rows import flag_share, interval_text, is_closed_loop, known, selectable, share_text
from marsyard.reports.wording import NOTHING, number, stated

#: The instrument placement's requirement of section 4.2, metres, and the share of runs that shall keep it.
WITHIN_M = 0.03
QUANTILE = 0.99
#: How a line of a figure is drawn.
_LINES = ("-", "--", "-.", ":")


@dataclass(frozen=True)
class CameraRuns:
    """Runs with one camera at selectable targets.

    Attributes
    ----------
    camera
        Its name.
    completed, tracked
        Shares of all runs that came to the goal, and whose target was then within the stated pixels.
    within
        Share of the completed runs with an error of at most `WITHIN_M`.
    false_tracks
        Share of all runs in which some update reported a wrong place: the harm.
    median_m, quantile_m, quantile_bound_m
        Of the position error of completed runs: median, 99 % quantile, and its upper bound; infinite for too few.
    range_rms_m, cross_rms_m
        Its parts along the line of sight and across it, root mean square.
    drift_median_px, drift_quantile_px
        Drift at the goal: median and 99 % quantile.
    """

    camera: str
    completed: Share
    tracked: Share
    within: Share
    false_tracks: Share
    median_m: float
    quantile_m: float
    quantile_bound_m: float
    range_rms_m: float
    cross_rms_m: float
    drift_median_px: float
    drift_quantile_px: float


def goal_section(subject: Subject) -> Section | None:
    """Positions at the goal; None where rows are not those of runs that the tracker steers to one."""
    found = camera_runs(subject.frame)
    if not found:
        return None
    frame = selectable(subject.frame)
    caption = "Share of completed runs with an error at the goal of up to so much; dashed: the requirement."
    blocks = [
        Block(plates=[plate(error_figure(frame), "goal", caption)]),
        Block(heading="Runs at selectable targets", grid=_runs_grid(found), note=_NOTE),
        Block(heading="Errors at the goal", grid=_errors_grid(found), note=_physics()),
    ]
    lost = losses_grid(frame)
    if lost.rows:
        blocks.append(Block(heading="Runs that did not track to the end", grid=lost, note=_LOST_NOTE))
    data = {"cameras": [asdict(one) for one in found]}
    return Section("goal", "Goal", "Where the target is, as told at the goal", blocks, data)


_NOTE = (
    "Selectable: the designated point is lit and off the rock's edge. Falsely tracked: some update reported the "
    "target beyond the stated pixels from the designated point's true projection. Intervals: two-sided, Clopper and "
    f"Pearson, at {stated(CONFIDENCE)} confidence."
)
_LOST_NOTE = (
    "Losses are the criteria (section 4.6) of the first update that lost the target. Azimuth change: the largest "
    "between two sightings; clouds: whether there were any. What caused a loss is for a replay to tell."
)


def _physics() -> str:
    """What Eqs. 1 and 4 make of the paper's cameras at the goal."""
    said = []
    for design in (PANCAM, NAVCAM):
        stereo = stereo_range_error_m(GOAL_M, design.focal_px, design.baseline_m)
        drift = drift_error_m(GOAL_M, design.focal_px, 1.0)
        said.append(f"{design.name.lower()} {1000.0 * stereo:.1f} mm along and {1000.0 * drift:.2f} mm across")
    return (
        f"By Eqs. 1 and 4 a pixel of disparity and a pixel of drift at {GOAL_M:g} m are, for the paper's cameras: "
        f"{'; '.join(said)}. Along: of the line of sight. Bound: of the {stated(QUANTILE)} quantile at "
        f"{stated(CONFIDENCE)} confidence (order statistics; it takes 230 runs)."
    )


def camera_runs(frame: pd.DataFrame) -> list[CameraRuns]:
    """Runs by camera; none where rows are not those of closed loops."""
    if not is_closed_loop(frame) or "camera" not in frame:
        return []
    runs = selectable(frame)
    return [_of_camera(runs[runs["camera"].eq(name)], str(name)) for name in sorted(runs["camera"].dropna().unique())]


def _of_camera(runs: pd.DataFrame, camera: str) -> CameraRuns:
    completed = runs[np.isfinite(numbers(runs, "position_error_m"))]
    error, drift = known(completed, "position_error_m"), known(completed, "drift_px")
    return CameraRuns(
        camera=camera,
        completed=share_of(np.isfinite(numbers(runs, "position_error_m")), runs),
        tracked=flag_share(runs, "tracked"),
        within=share_of(error <= WITHIN_M, completed),
        false_tracks=flag_share(runs, "true_track", wanted=False),
        median_m=_quantile(error, 0.5),
        quantile_m=_quantile(error, QUANTILE),
        quantile_bound_m=quantile_bounds(error, QUANTILE, CONFIDENCE, terrain_groups(completed))[1],
        range_rms_m=_rms(known(completed, "range_error_m")),
        cross_rms_m=_rms(known(completed, "cross_error_m")),
        drift_median_px=_quantile(drift, 0.5),
        drift_quantile_px=_quantile(drift, QUANTILE),
    )


def _quantile(values: np.ndarray, probability: float) -> float:
    return float(np.quantile(values, probability)) if values.size else float("nan")


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def _runs_grid(found: Sequence[CameraRuns]) -> Grid:
    named = (
        ("Completed", "completed"),
        ("Tracked at the goal", "tracked"),
        (f"Within {100.0 * WITHIN_M:g} cm, of completed", "within"),
        ("Falsely tracked", "false_tracks"),
    )
    head = ["Camera", "", "Runs", f"{stated(CONFIDENCE)} interval"]
    rows = []
    for one in found:
        for name, attribute in named:
            share: Share = getattr(one, attribute)
            rows.append([one.camera, name, share_text(share), interval_text(share)])
    return Grid(head, rows)


def _errors_grid(found: Sequence[CameraRuns]) -> Grid:
    head = ["Camera", "Median (mm)", f"{stated(QUANTILE)} quantile (mm)", "Its bound (mm)", "Along, rms (mm)"]
    head += ["Across, rms (mm)", "Drift, median (px)", f"Drift, {stated(QUANTILE)} quantile (px)"]
    rows = []
    for one in found:
        bound = number(1000.0 * one.quantile_bound_m) if np.isfinite(one.quantile_bound_m) else "n too small"
        lengths = [number(1000.0 * value) for value in (one.median_m, one.quantile_m)]
        parts = [number(1000.0 * value) for value in (one.range_rms_m, one.cross_rms_m)]
        rows.append([one.camera, *lengths, bound, *parts, number(one.drift_median_px), number(one.drift_quantile_px)])
    return Grid(head, rows)


def losses_grid(frame: pd.DataFrame) -> Grid:
    """Runs that ended without a tracked target, by how they ended and what lost it."""
    failed = frame[~frame["tracked"].fillna(False).to_numpy(dtype=np.bool_)]
    rows = []
    for (outcome, losses), chosen in failed.groupby([failed["outcome"], failed["losses"].fillna(NOTHING)]):
        azimuth = known(chosen, "azimuth_change_max_deg")
        turned = f"{azimuth.max():.1f}" if azimuth.size else NOTHING
        distance = known(chosen, "lost_range_m")
        where = f"{distance.min():.1f} to {distance.max():.1f}" if distance.size else NOTHING
        cloudy = flag_share(chosen, "clear_sky", wanted=False).hits if "clear_sky" in chosen else 0
        words = str(losses).replace("_", " ").lower()
        rows.append([str(outcome), words, f"{len(chosen):,}", where, turned, f"{cloudy:,}"])
    rows.sort(key=lambda row: -int(row[2].replace(",", "")))
    return Grid(["Outcome", "Lost by", "Runs", "Lost at (m)", "Azimuth change, to (deg)", "With clouds"], rows)


@in_page_style
def error_figure(frame: pd.DataFrame) -> Figure:
    """Fraction of completed runs up to each position error, a line for each camera."""
    figure, axes = new_axes(6.2, 3.3)
    errors = known(frame, "position_error_m")
    edge = max(1.25 * WITHIN_M, axis_edge(errors, WITHIN_M))
    for place, camera in enumerate(sorted(frame["camera"].dropna().unique())):
        error = np.sort(known(frame[frame["camera"].eq(camera)], "position_error_m"))
        if error.size == 0:
            continue
        share = np.arange(1, error.size + 1) / error.size
        x, y = np.concatenate([[0.0], error, [max(edge, error[-1])]]), np.concatenate([[0.0], share, [1.0]])
        style: dict[str, Any] = {"color": SERIES[place % len(SERIES)], "linestyle": _LINES[place % len(_LINES)]}
        axes.plot(100.0 * x, y, drawstyle="steps-post", linewidth=1.8, label=f"{camera} ({error.size:,})", **style)
    axes.axvline(100.0 * WITHIN_M, color=REQUIREMENT, linewidth=1.5, linestyle="--")
    axes.set(xlim=(0.0, 102.0 * edge), ylim=(0.0, 1.03), xlabel="position error at the goal (cm)")
    axes.set_ylabel("fraction of completed runs")
    note_beyond(axes, int((errors > edge).sum()))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=2)
    return figure
