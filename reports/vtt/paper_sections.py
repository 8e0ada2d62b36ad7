"""Sections on the runs of the paper: updates (Table III), terrains (Table II), regression, and single runs (Table IV).

The paper is Kim et al., "Targeted Driving Using Visual Tracking".
"""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from marsyard.reports import populations, rates
from marsyard.reports.column_values import numbers
from marsyard.reports.papers import paper_section
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Block, Grid, Section, Subject
from marsyard.reports.vtt.goal_section import losses_grid, losses_note
from marsyard.reports.vtt.steps_section import steps_section
from marsyard.reports.vtt.table_1_section import table_1_section
from marsyard.reports.vtt.tracking_runs import (
    CHECKOUT_1,
    CHECKOUT_3,
    PAPER,
    PAPER_FILE,
    REGRESSION,
    TERRAINS,
    is_closed_loop,
    is_tracking,
    read_legs,
    selectable_targets,
)
from marsyard.reports.wording import NOTHING, format_fraction, note_text, percent

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
            Block(heading="Comparison with the paper", grid=table_3, note=note_text("vtt.table_3")),
            Block(heading="All updates of Marsyard", grid=grid, note=note),
        ]
    data = {
        str(update_number): {name: values_of_update.tolist() for name, values_of_update in update.items()}
        for update_number, update in values.items()
    }
    return Section("updates", "Updates", title, blocks, {"updates": data})


#: Minimum change of azimuth that the paper calls excessive, degrees (section 5.5).
EXCESSIVE_DEG = 10.0


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
        is_stuck, slips = populations.flag_mask(runs, "stuck"), rates.finite_values(runs, "slip_max")
        mobile_runs, stuck_runs = runs[~is_stuck], selectable_targets(runs[is_stuck])
        selectable_runs = selectable_targets(mobile_runs)
        lost_runs = selectable_runs[~populations.flag_mask(selectable_runs, "tracked")]
        cause_counts = dict(Counter(failure_cause(row) for _, row in lost_runs.iterrows()).most_common())
        failure_fraction, failure_fraction_all = (
            rates.flag_fraction(group, "tracked", value=False) for group in (selectable_runs, mobile_runs)
        )
        held_fraction = rates.fraction_of(populations.flag_mask(stuck_runs, "target_held"), stuck_runs)
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


#: Maximum height of a small rock (section 6), metres.
MAX_SMALL_ROCK_M = 0.1


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
    rows = [
        [
            *map(str, labels),
            f"{len(runs):,}",
            rates.fraction_text(rates.flag_fraction(runs, "tracked")),
            ", ".join(sorted(str(outcome) for outcome in runs["outcome"].unique())),
            rates.median_text(rates.finite_values(runs, "position_error_m", 100.0), 2),
            rates.median_text(rates.finite_values(runs, "drift_px"), 1),
            rates.median_text(rates.finite_values(runs, "autonav_updates"), 0),
        ]
        for labels, runs in rows_with_labels.groupby(["driving", "rock", "incline"], sort=True)
    ]
    head = ["Driving", "Rock", "Ground", "Runs", "Tracked to the goal", "Outcomes", "Position error (cm)", "Drift (px)"]
    grid = Grid([*head, "Navigation updates"], rows)
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


def table_4_grid(frame: pd.DataFrame, legs: Sequence[Mapping[str, Any]]) -> Grid:
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
    return paper_section(subject, PAPER_FILE, *blocks)


SECTIONS = (
    table_1_section, single_run_section, updates_section, steps_section, terrains_section, regression_section,
)  # fmt: skip
