"""Sections about visual target tracking: comparisons with the paper's tables and runs, and tracking by step size.

A step is the motion of the rover from one image to the next: an angle, or a fraction of the distance to the target.

The paper is Kim et al., "Targeted Driving Using Visual Tracking".
"""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from marsyard.reports import rates
from marsyard.reports.blocks import Rows
from marsyard.reports.column_values import numbers
from marsyard.reports.papers import paper_section, read_paper
from marsyard.reports.plots import RateLine, rate_figure
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Block, Grid, Section, Subject, build_grid, svg_figure
from marsyard.reports.stored import table
from marsyard.reports.vtt.goal import (
    is_closed_loop,
    is_tracking,
    losses_grid,
    losses_note,
    selectable_targets,
    table_1_section,
)
from marsyard.reports.wording import NOTHING, format_fraction, note_text, number, percent

_PAPER_FILE = Path(__file__).with_name("paper.toml")
PAPER = read_paper(_PAPER_FILE)
#: Campaigns of Tables II and III, and of the regression runs.
TERRAINS, CHECKOUT_1, CHECKOUT_3, REGRESSION = "vtt-terrains", "vtt-checkout-1", "vtt-checkout-3", "vtt-regression"


def read_legs(subject: Subject) -> list[Mapping[str, Any]]:
    """Read the legs of the drive (approach or turn, for example) from the campaign's parameters."""
    drive = subject.run.parameter("drive")
    leg_table = table(drive).get("legs") if drive is not None else subject.run.parameter("legs")
    return [table(leg) for leg in leg_table] if isinstance(leg_table, list | tuple) else []


def table_4_grid(frame: Rows, legs: Sequence[Mapping[str, Any]]) -> Grid:
    """Create Table IV: tracking updates and minutes of each operational mode; `legs` are the legs of the drive.

    The minutes of a mode end at its last update, and start at the end of the previous mode.
    """
    updates = [int(str(name).split("_")[1]) for name in frame.columns if re.match(r"^update_\d+_leg$", str(name))]
    update_legs = np.column_stack([numbers(frame, f"update_{update_number}_leg") for update_number in updates])
    update_minutes = (
        np.column_stack([numbers(frame, f"update_{update_number}_time_s") for update_number in updates]) / 60.0
    )
    leg_modes = [(str(leg.get("motion", "approach")), bool(leg.get("autonav"))) for leg in legs]
    leg_modes = [(motion, motion == "approach" and autonav) for motion, autonav in leg_modes]
    rows, previous_end = [], np.zeros(len(frame))
    for mode in PAPER["table_4"]:
        mode_legs = [
            index for index, leg in enumerate(leg_modes) if leg == (mode["motion"], mode.get("autonav", False))
        ]
        # the first update is at the start, before any leg; its leg is -1
        is_in_mode = np.isin(update_legs, [-1, *mode_legs] if mode.get("start") else mode_legs)
        is_reached = is_in_mode.any(axis=1)
        end = np.where(is_in_mode, update_minutes, -np.inf).max(axis=1)
        counts, minutes = is_in_mode.sum(axis=1).astype(np.float64), (end - previous_end)[is_reached]
        simulated_texts = (rates.median_text(counts[is_reached], 0), rates.median_text(minutes, 1))
        rows.append(
            [mode["name"], f"{mode['updates']}", simulated_texts[0], f"{mode['minutes']:g}", simulated_texts[1]]
        )
        previous_end = np.where(is_reached, end, previous_end)
    return Grid(["Mode", "Updates, paper", "Updates, ours", "Minutes, paper", "Minutes, ours"], rows)


def single_run_section(subject: Subject) -> Section | None:
    """Compare the paper's single runs with the campaigns that repeat them; None for other campaigns."""
    blocks = []
    if subject.run.name == CHECKOUT_3 and "update_1_leg" in subject.frame:
        grid = table_4_grid(subject.frame, read_legs(subject))
        blocks.append(Block(heading="By operational mode", grid=grid, note=note_text("vtt.table_4")))
    return paper_section(subject, _PAPER_FILE, *blocks)


#: Quantities of an update in the table: heading, suffix of the column `update_<number>_<suffix>`, digits.
QUANTITIES: tuple[tuple[str, str, int], ...] = (
    ("Range (m)", "range_m", 2), ("Magnification", "magnification", 2), ("Roll change (deg)", "roll_change_deg", 2),
    ("Azimuth change (deg)", "azimuth_change_deg", 2), ("NCC score", "match_score", 2),
    ("Stereo score", "stereo_score", 2), ("Correction (px)", "correction_px", 1),
    ("Tracking error (px)", "error_px", 1),
)  # fmt: skip
#: Definitions of the quantities of an update.
DEFINITIONS = (
    "Range: true distance from the left camera to the designated point. Magnification and roll change: change of the "
    "target's image since the last match, computed from the estimated motion of the rover. Roll is positive clockwise. "
    "Azimuth change: rotation of the line of sight in the world since the last match, positive to the right. NCC score "
    "and stereo score: normalised cross-correlation of the match in the left and in the right image; the maximum is 1. "
    "Correction: distance from the predicted to the matched position, the larger of columns and rows. Tracking error: "
    "distance from the match to the true projection of the designated point. A dash means that there is no value; at "
    "the first update, no match precedes."
)
_UPDATES_NOTE = "The values are medians over all cases that reached the update, with minimum to maximum in brackets."
_TABLE_3_NOTE = (
    'Rows "ours": median over all cases, with minimum to maximum in brackets. All values are without signs, as in the '
    "paper. Ranges are those of Fig. 15. Path and steps are the paper's. The paper does not specify rock, ground and "
    "light. A dash means that no value is printed, or that no match precedes."
)


def updates_section(subject: Subject) -> Section | None:
    """Create the section on the updates, with Table III for the first checkout; None if rows contain no updates."""
    frame = subject.frame
    matches = (re.match(r"^update_(\d+)_range_m$", str(name)) for name in frame.columns)
    updates = sorted(int(match[1]) for match in matches if match)
    if not is_tracking(frame) or not updates:
        return None
    suffixes = [suffix for _, suffix, _ in QUANTITIES]
    values = {
        update_number: {name: rates.finite_values(frame, f"update_{update_number}_{name}") for name in suffixes}
        for update_number in updates
    }
    rows = [
        [
            str(update_number),
            f"{update['range_m'].size:,}",
            *(rates.median_text(update[name], digits) for _, name, digits in QUANTITIES),
        ]
        for update_number, update in values.items()
        if update["range_m"].size
    ]
    grid = Grid(["Update", "Cases", *(heading for heading, _, _ in QUANTITIES)], rows)
    note = f"{_UPDATES_NOTE} {DEFINITIONS}"
    blocks, title = [Block(grid=grid, note=note)], "All updates"
    if subject.run.name == CHECKOUT_1:
        title = "Updates of the first checkout (Table III of the paper)"
        comparison_rows = []
        for heading, suffix, digits in QUANTITIES:
            printed_values = PAPER["table_3"].get(suffix)
            if printed_values is not None:
                paper = [
                    f"{printed_values[str(update_number)]:.{digits}f}"
                    if str(update_number) in printed_values
                    else NOTHING
                    for update_number in values
                ]
                simulated_texts = [rates.median_text(np.abs(update[suffix]), digits) for update in values.values()]
                comparison_rows += [[heading, "paper", *paper], [heading, "ours", *simulated_texts]]
        table_3 = Grid(
            ["Quantity", "Source", *(f"Update {update_number}" for update_number in values)], comparison_rows
        )
        blocks = [
            Block(heading="Comparison with the paper", grid=table_3, note=_TABLE_3_NOTE),
            Block(heading="All updates of Marsyard", grid=grid, note=note),
        ]
    data = {
        str(update_number): {name: values_of_update.tolist() for name, values_of_update in update.items()}
        for update_number, update in values.items()
    }
    return Section("updates", "Updates", title, blocks, {"updates": data})


#: Columns that distinguish the lines of the figure of steps: tracker, or side of the search window. The first column
#: that varies is used.
_LINE_COLUMNS = ("algorithm", "search_px")
_STEPS_NOTE = note_text("vtt.steps", confidence=format_fraction(CONFIDENCE))
_OBLIQUITY_NOTE = (
    "Obliquity: angle between the line of sight and the surface normal at the target; 0 is face-on. Rows are classes "
    "of its maximum over the stops, columns are steps. Cells: tracked targets, of selectable targets. The template is "
    "scaled and rolled, but not foreshortened like the image of an oblique patch, in the next image or the right one."
)
#: Edges of the classes of maximum obliquity, deg.
_OBLIQUITY_EDGES_DEG = (0.0, 45.0, 60.0, 65.0, 70.0, 90.0)


def steps_section(subject: Subject) -> Section | None:
    """Create the section on step sizes (Fig. 8, sections 5.2 and 5.3).

    None unless the rows contain step sizes, and the drive is one leg of a motion in the paper.
    """
    motion, steps = _read_motion(subject), step_rates(subject)
    if motion is None or not steps:
        return None
    lines = [
        RateLine(
            name,
            [cell["step"] for cell in line_cells],
            [cell["good"] for cell in line_cells],
            {cell["step"]: cell["paper_percent"] / 100.0 for cell in line_cells if cell["paper_percent"] is not None},
        )
        for name in dict.fromkeys(cell["line"] for cell in steps)
        if (line_cells := [cell for cell in steps if cell["line"] == name and cell["good"].n])
    ]
    unit = "% of the distance" if motion["per_cent"] else "deg"
    xlabel = "step (% of the target's distance)" if motion["per_cent"] else "step (deg)"
    caption = f"Selectable targets that are tracked to the end, with {format_fraction(CONFIDENCE)} intervals."
    columns: dict[str, Callable[[dict[str, Any]], str]] = {
        f"Step ({unit})": lambda cell: number(cell["step"]).rstrip("0").rstrip("."),
        "Tracked, of selectable": lambda cell: rates.fraction_text(cell["good"]),
        f"{format_fraction(CONFIDENCE)} interval": lambda cell: rates.interval_text(cell["good"]),
        "Tracked, of all targets": lambda cell: rates.fraction_text(cell["all_targets"]),
        "False track, of selectable": lambda cell: rates.fraction_text(cell["false_tracks"]),
    }
    if any(cell["line"] for cell in steps):
        name = "Search window" if str(steps[0]["line"]).endswith("px") else "Tracker"
        columns = {name: lambda cell: cell["line"], **columns}
    if any(line.paper for line in lines):
        caption += " Open marks: text of the paper."
        columns["Paper, of selectable"] = lambda cell: (
            NOTHING if cell["paper_percent"] is None else f"{cell['paper_percent']:.0f} %"
        )
    grid = build_grid(steps, columns)
    svg_figures = [svg_figure(rate_figure(lines, (xlabel, "targets tracked")), "steps", caption)]
    blocks = [Block(text=motion["text"], figures=svg_figures), Block(grid=grid, note=_STEPS_NOTE)]
    oblique = _obliquity_grid(subject.frame, "%" if motion["per_cent"] else "deg")
    if oblique is not None:
        blocks.append(Block(heading="By obliquity of the surface", grid=oblique, note=_OBLIQUITY_NOTE))
    return Section("steps", "Steps", motion["title"], blocks, {"cells": steps})


def _read_motion(subject: Subject) -> Mapping[str, Any] | None:
    """Read the paper's results for the motion of the drive; None unless it is one leg of a motion in the paper."""
    drive_legs = read_legs(subject)
    motions: Mapping[str, Mapping[str, Any]] = PAPER["steps"]
    return motions.get(str(drive_legs[0].get("motion", "approach"))) if len(drive_legs) == 1 else None


def step_rates(subject: Subject) -> list[dict[str, Any]]:
    """Compute the rates of tracked targets for every line (tracker or search window) and step size.

    - step: angle in degrees, or fraction of the distance to the target in per cent
    - good, false_tracks: fractions of the selectable targets that are tracked, and that have a false track
    - all_targets: fraction of all targets that are tracked
    """
    frame, motion = subject.frame, _read_motion(subject)
    if motion is None or not is_tracking(frame) or "step" not in frame:
        return []
    cells = []
    for line, line_rows in _group_by_line(frame[frame["step"].notna()]):
        paper = motion["paper"].get(line) or motion["paper"].get("", {})
        for _, step_rows in line_rows.groupby("step"):
            step = float(step_rows["step"].iloc[0]) * (100.0 if motion["per_cent"] else 1.0)
            selectable_rows = selectable_targets(step_rows)
            cells.append(
                {
                    "line": line,
                    "step": step,
                    "good": rates.flag_fraction(selectable_rows, "tracked"),
                    "all_targets": rates.flag_fraction(step_rows, "tracked"),
                    "false_tracks": rates.flag_fraction(selectable_rows, "no_false_track", value=False),
                    "paper_percent": next(
                        (percentage for size, percentage in paper.items() if abs(step - float(size)) < 0.5), None
                    ),
                }
            )
    return cells


def _group_by_line(frame: Rows) -> Iterator[tuple[str, pd.DataFrame]]:
    """Group rows by the column that varies (`_LINE_COLUMNS`); a single line without name if no column varies."""
    column = next((name for name in _LINE_COLUMNS if name in frame and frame[name].nunique() > 1), None)
    if column is None:
        yield "", frame
        return
    for value in sorted(frame[column].dropna().unique(), reverse=column == "algorithm"):
        # an algorithm's label in the rows has underscores, its name hyphens
        name = f"{value:g} px" if column.endswith("_px") else str(value).replace("_", "-")
        yield name, frame[frame[column].eq(value)]


def _obliquity_grid(frame: Rows, unit: str) -> Grid | None:
    """Create a table of tracked targets by maximum obliquity and step size; None if rows contain no obliquities.

    Trackers have separate rows; search windows are pooled.
    """
    if "obliquity_max_deg" not in frame:
        return None
    visible = selectable_targets(frame[frame["obliquity_max_deg"].notna()], face=False)
    steps = sorted(visible["step"].unique())
    has_trackers = "algorithm" in visible and visible["algorithm"].nunique() > 1
    rows = []
    for name, line_rows in _group_by_line(visible) if has_trackers else [("", visible)]:
        for low, high in pairwise(_OBLIQUITY_EDGES_DEG):
            class_rows = line_rows[line_rows["obliquity_max_deg"].between(low, high, inclusive="left")]
            if len(class_rows):
                fractions = [rates.flag_fraction(class_rows[class_rows["step"].eq(step)], "tracked") for step in steps]
                cells = [f"{low:g} to {high:g}", *(f"{fraction.hits:,} of {fraction.n:,}" for fraction in fractions)]
                rows.append([name, *cells] if has_trackers else cells)
    scale = 100.0 if unit == "%" else 1.0
    head = ["Maximum obliquity (deg)", *(f"{scale * step:.3g} {unit}" for step in steps)]
    return Grid(["Tracker", *head] if has_trackers else head, rows) if rows else None


#: Minimum change of azimuth that the paper calls excessive, degrees (section 5.5).
EXCESSIVE_DEG = 10.0
#: Maximum height of a small rock (section 6), metres.
MAX_SMALL_ROCK_M = 0.1


def terrains_section(subject: Subject) -> Section | None:
    """Create the section on Table II; None unless the campaign is that of the paper's terrains."""
    frame, printed_rows = subject.frame, PAPER["table_2"]
    if subject.run.name != TERRAINS or not is_closed_loop(frame) or "incline" not in frame:
        return None
    names = [str(name) for name in frame["incline"].dropna().unique()]
    ordered_names = [name for name in printed_rows if name in names] + sorted(set(names) - set(printed_rows))
    rows, data = [], []
    for name in ordered_names:
        runs = frame[frame["incline"].eq(name)]
        is_stuck, slips = rates.flag_mask(runs, "stuck"), rates.finite_values(runs, "slip_max")
        mobile_runs, stuck_runs = runs[~is_stuck], selectable_targets(runs[is_stuck])
        selectable_runs = selectable_targets(mobile_runs)
        lost_runs = selectable_runs[~rates.flag_mask(selectable_runs, "tracked")]
        cause_counts = dict(Counter(failure_cause(row) for _, row in lost_runs.iterrows()).most_common())
        failure_fraction, failure_fraction_all = (
            rates.flag_fraction(group, "tracked", value=False) for group in (selectable_runs, mobile_runs)
        )
        held_fraction = rates.fraction_of(rates.flag_mask(stuck_runs, "target_held"), stuck_runs)
        slip = float(slips.max()) if slips.size else float("nan")
        row = printed_rows.get(name)
        paper = [NOTHING] * 2 if row is None else [f"{row['failures']} of {row['trials']}", row["reason"]]
        causes = "; ".join(f"{cause}: {n}" for cause, n in cause_counts.items()) or "none"
        simulated_texts = [
            rates.fraction_text(failure_fraction),
            rates.interval_text(failure_fraction),
            causes,
            rates.fraction_text(failure_fraction_all),
            rates.fraction_text(held_fraction) if held_fraction.n else NOTHING,
        ]
        rows.append([name, *paper, *simulated_texts, percent(slip)])
        fractions = {"failed": failure_fraction, "failed_all": failure_fraction_all, "stuck_held": held_fraction}
        data.append({"name": name, **fractions, "causes": cause_counts, "slip_max": slip})
    head = ["Terrain", "Failures, paper", "Reason, paper", "Failures, ours", f"{format_fraction(CONFIDENCE)} interval"]
    head += ["Cause, ours", "Failures, all targets", "Stuck: target held", "Maximum wheel slip"]
    note = note_text("vtt.table_2", limit=f"{EXCESSIVE_DEG:g}")
    title = "Tracking with visual odometry on four kinds of ground (Table II of the paper)"
    return Section("table-2", "Kinds of ground", title, [Block(grid=Grid(head, rows), note=note)], {"terrains": data})


def failure_cause(row: pd.Series) -> str:
    """Determine the cause of a failed run from its row."""
    outcome = str(row["outcome"])
    if outcome not in ("COMPLETED", "LOST"):
        return outcome.replace("_", " ").lower()
    if float(row.get("azimuth_change_max_deg", 0.0)) > EXCESSIVE_DEG:
        return "excessive azimuth change"
    if row.get("clear_sky") is not None and not bool(row["clear_sky"]):
        return "lighting change"
    return "drift" if outcome == "COMPLETED" else str(row["losses"]).replace("_", " ").lower()


def regression_section(subject: Subject) -> Section | None:
    """Create the section on the regression runs (section 6); None for other campaigns."""
    frame = subject.frame
    if subject.run.name != REGRESSION or not is_closed_loop(frame) or "visual_odometry" not in frame:
        return None
    map_source = frame["map_by"] if "map_by" in frame else pd.Series("none", index=frame.index)
    driving_text = [
        f"Autonav by {cameras} cameras{', visual odometry' * bool(odometry)}"
        if autonav
        else ("visual odometry" if odometry else "blind")
        for autonav, odometry, cameras in zip(frame["autonav"], frame["visual_odometry"], map_source, strict=True)
    ]
    rows_with_labels = frame.assign(
        driving=driving_text, rock=np.where(numbers(frame, "rock_height_m") <= MAX_SMALL_ROCK_M, "small", "large")
    )
    grid = build_grid(
        list(rows_with_labels.groupby(["driving", "rock", "incline"], sort=True)),
        {
            "Driving": lambda group: str(group[0][0]),
            "Rock": lambda group: str(group[0][1]),
            "Ground": lambda group: str(group[0][2]),
            "Runs": lambda group: f"{len(group[1]):,}",
            "Tracked to the goal": lambda group: rates.fraction_text(rates.flag_fraction(group[1], "tracked")),
            "Outcomes": lambda group: ", ".join(sorted(str(outcome) for outcome in group[1]["outcome"].unique())),
            "Position error (cm)": lambda group: rates.median_text(
                rates.finite_values(group[1], "position_error_m", 100.0), 2
            ),
            "Drift (px)": lambda group: rates.median_text(rates.finite_values(group[1], "drift_px"), 1),
            "Navigation updates": lambda group: rates.median_text(rates.finite_values(group[1], "autonav_updates"), 0),
        },
    )
    note = (
        "According to the paper, all 14 runs were successful. Small rocks are at most 10 cm high. Position error "
        "(rover frame) and drift are those at the goal. Drift: distance from the match to the true projection. The "
        "last three columns are medians, with minimum to maximum in brackets."
    )
    blocks, loss_grid = [Block(grid=grid, note=note)], losses_grid(frame)
    if loss_grid.rows:
        note = losses_note(frame)
        blocks.append(Block(heading="Runs that lost the target", grid=loss_grid, note=note))
    data = {"tracked": rates.flag_fraction(frame, "tracked")}
    return Section("regression", "Regression", "Regression runs on the engineering model", blocks, data)


SECTIONS = (
    table_1_section, single_run_section, updates_section, steps_section, terrains_section, regression_section,
)  # fmt: skip
