"""Sections about visual target tracking: the paper's tables and runs next to ours, positions at the goal, and steps."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from marsyard.algorithms.vtt.accuracy import GOAL_M, START_M, AccuracyRow, table_1, tracked_approach_error_m
from marsyard.reports import rates
from marsyard.reports.figures import RateLine, rate_figure
from marsyard.reports.kinds import Drawn, MadeBy, Rows
from marsyard.reports.papers import PaperFacts, read_paper
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Block, Grid, Section, Subject, build_grid, plate
from marsyard.reports.stored import table
from marsyard.reports.vtt.goal import is_closed_loop, is_tracking, losses_grid, selectable
from marsyard.reports.wording import NOTHING, format_fraction, note_text, number, numbers, percent

_PAPER_FILE = Path(__file__).with_name("paper.toml")
PAPER = read_paper(_PAPER_FILE)
#: Table I as printed.
PRINTED = {name: AccuracyRow(name, **row) for name, row in PAPER["table_1"].items()}
#: Campaigns of Tables II and III, and of the regression runs.
TERRAINS, CHECKOUT_1, CHECKOUT_3, REGRESSION = "vtt-terrains", "vtt-checkout-1", "vtt-checkout-3", "vtt-regression"
#: Runs count whose distances from the camera differ from Table I's by no more than this share.
_NEAR = 0.1


def table_1_section(subject: Subject) -> Section | None:
    """Table I: computed, printed and measured; None without completed runs from the paper's 10 m to its 2 m."""
    accuracy = measured_accuracy(subject.frame)
    if not accuracy:
        return None
    computed = {row.name: row for row in table_1()}
    both = [(kind, row[name]) for name in PRINTED for kind, row in (("printed", PRINTED), ("computed", computed))]
    grid = build_grid(
        both,
        {
            "Camera": lambda pair: pair[1].name,
            "": lambda pair: pair[0],
            "Designation (cm)": lambda pair: f"{pair[1].designation_cm:g}",
            "Approach without tracker (cm)": lambda pair: f"{pair[1].untracked_cm:.1f}",
            "Approach with N px of drift (cm)": lambda pair: pair[1].tracked_formula,
        },
    )
    measured_note = note_text("vtt.table_1_measured", start=f"{START_M:g}", goal=f"{GOAL_M:g}")
    blocks = [
        Block(heading="Computed", grid=grid, note=note_text("vtt.table_1")),
        Block(heading="Measured", grid=_measured_grid(accuracy), note=measured_note),
    ]
    data = {
        "computed": {name: asdict(row) for name, row in computed.items()},
        "printed": {name: asdict(row) for name, row in PRINTED.items()},
        "measured": accuracy,
    }
    return Section("table-1", "Table I", "Table I: accuracy of a target's position", blocks, data)


def measured_accuracy(frame: Rows) -> list[dict[str, Any]]:
    """Errors of each camera's completed runs, 3 sigma (three times the root mean square).

    disparity_px: 1 sigma, from the designation error by Eq. 1
    untracked_cm: by Eq. 3 from the errors of designation and pose
    """
    if not is_closed_loop(frame) or "designation_error_m" not in frame or "camera" not in frame:
        return []
    ends = {"range_start_m": START_M, "range_end_m": GOAL_M}
    near = [np.abs(numbers(frame, name) / distance - 1.0) < _NEAR for name, distance in ends.items()]
    completed = selectable(frame[near[0] & near[1] & np.isfinite(numbers(frame, "position_error_m"))])
    rows = []
    for camera in sorted(completed["camera"].unique()):
        runs = completed[completed["camera"].eq(camera)]
        designation, pose = numbers(runs, "designation_error_m"), numbers(runs, "pose_error_m")
        rows.append(
            {
                "camera": str(camera),
                "runs": len(runs),
                "designation_cm": 300.0 * rates.rms(designation),
                "disparity_px": rates.rms(designation / numbers(runs, "designation_3_sigma_m")),
                "untracked_cm": 300.0 * rates.rms(np.hypot(designation, pose)),
                "tracked_cm": 300.0 * rates.rms(numbers(runs, "position_error_m")),
                "drift_px": rates.rms(numbers(runs, "drift_px")),
            }
        )
    return rows


def _measured_grid(found: Sequence[Mapping[str, Any]]) -> Grid:
    head = ["Camera", "Runs", "Designation (cm)", "Table I", "Disparity error, 1 sigma (px)"]
    head += ["Approach without tracker (cm)", "Table I", "Approach with tracker (cm)", "Table I, the same"]
    rows = []
    for one in found:
        printed = next((row for name, row in PRINTED.items() if one["camera"].endswith(name.lower())), None)
        paper = [NOTHING] * 3
        if printed is not None:
            tracked = tracked_approach_error_m(printed.stereo_cm, printed.drift_cm_px * one["drift_px"])
            paper = [f"{printed.designation_cm:g}", f"{printed.untracked_cm:.1f}", f"{tracked:.1f}"]
        first = [one["camera"], f"{one['runs']:,}", f"{one['designation_cm']:.1f}", paper[0]]
        second = [number(one["disparity_px"]), f"{one['untracked_cm']:.1f}", paper[1]]
        rows.append([*first, *second, f"{one['tracked_cm']:.1f}", paper[2], f"{one['drift_px']:.1f}"])
    return Grid([*head, "Drift rms (px)"], rows)


def legs(subject: Subject) -> list[Mapping[str, Any]]:
    """The legs of the campaign's drive or runs."""
    drive = subject.run.parameter("drive")
    leg_table = table(drive).get("legs") if drive is not None else subject.run.parameter("legs")
    return [table(leg) for leg in leg_table] if isinstance(leg_table, list | tuple) else []


def table_4(frame: Rows, driven: Sequence[Mapping[str, Any]]) -> Grid:
    """Table IV: tracking updates and minutes of each operational mode; `driven` are the legs."""
    of_update = [int(str(name).split("_")[1]) for name in frame.columns if re.match(r"^update_\d+_leg$", str(name))]
    legs_of = np.column_stack([numbers(frame, f"update_{n}_leg") for n in of_update])
    times = np.column_stack([numbers(frame, f"update_{n}_time_s") for n in of_update]) / 60.0
    steered = [(str(leg.get("motion", "approach")), bool(leg.get("autonav"))) for leg in driven]
    steered = [(motion, motion == "approach" and autonav) for motion, autonav in steered]
    rows, before = [], np.zeros(len(frame))
    for mode in PAPER["table_4"]:
        numbers_of = [k for k, kind in enumerate(steered) if kind == (mode["motion"], mode.get("autonav", False))]
        # the first update, at the start, has the leg -1
        chosen = np.isin(legs_of, [-1, *numbers_of] if mode.get("start") else numbers_of)
        reached = chosen.any(axis=1)
        end = np.where(chosen, times, -np.inf).max(axis=1)
        counts, minutes = chosen.sum(axis=1).astype(np.float64), (end - before)[reached]
        ours = (rates.spread_text(counts[reached], 0), rates.spread_text(minutes, 1))
        rows.append([mode["name"], f"{mode['updates']}", ours[0], f"{mode['minutes']:g}", ours[1]])
        before = np.where(reached, end, before)
    return Grid(["Mode", "Updates, paper", "Updates, ours", "Minutes, paper", "Minutes, ours"], rows)


def _modes(frame: Rows, subject: Subject, key: str) -> Drawn:
    if "update_1_leg" not in frame:
        return [], {}
    return [Block(heading="By operational mode", grid=table_4(frame, legs(subject)), note=note_text("vtt.table_4"))], {}


#: The paper's single runs next to the campaigns that repeat them.
SINGLE_RUNS = PaperFacts(_PAPER_FILE, further={CHECKOUT_3: MadeBy(_modes)})

#: Numbers of an update in the table: heading, ending of the column, digits.
QUANTITIES: tuple[tuple[str, str, int], ...] = (
    ("Distance (m)", "range_m", 2), ("Magnification", "magnification", 2), ("Roll change (deg)", "roll_change_deg", 2),
    ("Azimuth change (deg)", "azimuth_change_deg", 2), ("NCC score", "match_score", 2),
    ("Stereo score", "stereo_score", 2), ("Correction (px)", "correction_px", 1), ("Error (px)", "error_px", 1),
)  # fmt: skip


def updates_section(subject: Subject) -> Section | None:
    """Numbers of every stored update, for the first checkout next to Table III; None if rows store no updates."""
    frame = subject.frame
    matched = (re.match(r"^update_(\d+)_range_m$", str(name)) for name in frame.columns)
    updates = sorted(int(one[1]) for one in matched if one)
    if not is_tracking(frame) or not updates:
        return None
    values = {n: {ending: rates.known(frame, f"update_{n}_{ending}") for _, ending, _ in QUANTITIES} for n in updates}
    rows = [
        [str(n), f"{of_n['range_m'].size:,}", *(rates.spread_text(of_n[ending], d) for _, ending, d in QUANTITIES)]
        for n, of_n in values.items()
        if of_n["range_m"].size
    ]
    grid = Grid(["Update", "Cases", *(heading for heading, _, _ in QUANTITIES)], rows)
    note = note_text("vtt.updates")
    blocks, title = [Block(grid=grid, note=note)], "Updates one by one"
    if subject.run.name == CHECKOUT_1:
        title = "Table III: the first checkout's updates"
        compared = []
        for heading, ending, digits in QUANTITIES:
            printed = PAPER["table_3"].get(ending)
            if printed is not None:
                paper = [f"{printed[str(n)]:.{digits}f}" if str(n) in printed else NOTHING for n in values]
                ours = [rates.spread_text(np.abs(of_n[ending]), digits) for of_n in values.values()]
                compared += [[heading, "paper", *paper], ["", "ours", *ours]]
        table_3 = Grid(["Parameter", "Rover position", *(str(n) for n in values)], compared)
        blocks = [
            Block(heading="Comparison with the paper", grid=table_3, note=note_text("vtt.table_3")),
            Block(heading="All our updates", grid=grid, note=note),
        ]
    lists = {str(n): {ending: one.tolist() for ending, one in of_n.items()} for n, of_n in values.items()}
    return Section("updates", "Updates", title, blocks, {"updates": lists})


#: Columns that distinguish the lines of a figure of steps, if they vary.
_SERIES = ("algorithm", "search_px")
_STEPS_NOTE = note_text("vtt.steps", confidence=format_fraction(CONFIDENCE))
#: Edges of classes of the most oblique sight, deg.
_CLASSES_DEG = (0.0, 45.0, 60.0, 65.0, 70.0, 90.0)


def steps_section(subject: Subject) -> Section | None:
    """Targets tracked by step size: Fig. 8, sideways motion (5.2), turns (5.3); None unless rows share pictures."""
    motion, steps = _motion(subject), step_rates(subject)
    if motion is None or not steps:
        return None
    lines = [
        RateLine(
            name,
            [one["step"] for one in ours],
            [one["good"] for one in ours],
            {one["step"]: one["paper_percent"] / 100.0 for one in ours if one["paper_percent"] is not None},
        )
        for name in dict.fromkeys(one["line"] for one in steps)
        if (ours := [one for one in steps if one["line"] == name and one["good"].n])
    ]
    unit = "% of the distance" if motion["per_cent"] else "deg"
    xlabel = "step (% of the target's distance)" if motion["per_cent"] else "step (deg)"
    caption = "Selectable targets tracked to the end, with intervals; open: the paper's text."
    grid = build_grid(
        steps,
        {
            "Tracker": lambda one: one["line"] or "vtt",
            f"Step ({unit})": lambda one: number(one["step"]).rstrip("0").rstrip("."),
            "Tracked, of selectable": lambda one: rates.fraction_text(one["good"]),
            f"{format_fraction(CONFIDENCE)} interval": lambda one: rates.interval_text(one["good"]),
            "Paper": lambda one: NOTHING if one["paper_percent"] is None else f"{one['paper_percent']:.0f} %",
            "Tracked, of all targets": lambda one: rates.fraction_text(one["all_targets"]),
            "False track, of selectable": lambda one: rates.fraction_text(one["false_tracks"]),
        },
    )
    figure = rate_figure(lines, (xlabel, "targets tracked"))
    blocks = [Block(text=motion["text"], plates=[plate(figure, "steps", caption)]), Block(grid=grid, note=_STEPS_NOTE)]
    oblique = None if motion["per_cent"] else _obliquity_grid(subject.frame)
    if oblique is not None:
        blocks.append(Block(grid=oblique, note=note_text("vtt.obliquity")))
    keys = ("good", "all_targets", "false_tracks")
    data = [one | {name: asdict(one[name]) for name in keys} for one in steps]
    return Section("steps", "Steps", motion["title"], blocks, {"cells": data})


def _motion(subject: Subject) -> Mapping[str, Any] | None:
    """The paper's numbers of the campaign's motion; None unless it drives one leg."""
    of_drive = legs(subject)
    motions: Mapping[str, Mapping[str, Any]] = PAPER["steps"]
    return motions.get(str(of_drive[0].get("motion", "approach"))) if len(of_drive) == 1 else None


def step_rates(subject: Subject) -> list[dict[str, Any]]:
    """Rates for every line (tracker or search window) and step size; `good` is of selectable targets."""
    frame, motion = subject.frame, _motion(subject)
    if motion is None or not is_tracking(frame) or "step" not in frame or "skip" not in frame:
        return []
    limits = []
    for line, rows in _lines(frame[frame["step"].notna()]):
        paper = motion["paper"].get(line) or motion["paper"].get("", {})
        for _, chosen in rows.groupby("skip"):
            step = float(chosen["step"].iloc[0]) * (100.0 if motion["per_cent"] else 1.0)
            good = selectable(chosen)
            limits.append(
                {
                    "line": line,
                    "step": step,
                    "good": rates.flag_fraction(good, "tracked"),
                    "all_targets": rates.flag_fraction(chosen, "tracked"),
                    "false_tracks": rates.flag_fraction(good, "true_track", wanted=False),
                    "paper_percent": next((p for size, p in paper.items() if abs(step - float(size)) < 0.5), None),
                }
            )
    return limits


def _lines(frame: Rows) -> Iterator[tuple[str, pd.DataFrame]]:
    """Rows by the column that distinguishes the lines; one nameless line if none varies."""
    column = next((name for name in _SERIES if name in frame and frame[name].nunique() > 1), None)
    if column is None:
        yield "", frame
        return
    for kind in sorted(frame[column].dropna().unique(), reverse=column == "algorithm"):
        # an algorithm's label in the rows has underscores, its name hyphens
        name = f"{kind:g} px" if column.endswith("_px") else str(kind).replace("_", "-")
        yield name, frame[frame[column].eq(kind)]


def _obliquity_grid(frame: Rows) -> Grid | None:
    """Targets tracked by maximum obliquity and step size; None if rows lack obliquities."""
    if "obliquity_max_deg" not in frame:
        return None
    visible = frame[rates.all_flags(frame, "selectable", "in_view") & frame["obliquity_max_deg"].notna().to_numpy()]
    steps = sorted(visible["step"].unique())
    rows = []
    for low, high in pairwise(_CLASSES_DEG):
        chosen = visible[visible["obliquity_max_deg"].between(low, high, inclusive="left")]
        if len(chosen):
            shares = [rates.flag_fraction(chosen[chosen["step"].eq(step)], "tracked") for step in steps]
            rows.append([f"{low:g} to {high:g}", *(f"{one.hits:,} of {one.n:,}" for one in shares)])
    return Grid(["Maximum obliquity (deg)", *(f"{step:g} deg" for step in steps)], rows) if rows else None


#: A change of azimuth that the paper calls excessive, degrees (section 5.5).
EXCESSIVE_DEG = 10.0
#: Rocks up to this height are small ones (section 6), metres.
SMALL_M = 0.1


def terrains_section(subject: Subject) -> Section | None:
    """Table II; None unless the campaign is that of the paper's terrains."""
    frame, printed = subject.frame, PAPER["table_2"]
    if subject.run.name != TERRAINS or not is_closed_loop(frame) or "incline" not in frame:
        return None
    names = [str(name) for name in frame["incline"].dropna().unique()]
    ordered = [name for name in printed if name in names] + sorted(set(names) - set(printed))
    rows, data = [], []
    for name in ordered:
        runs = frame[frame["incline"].eq(name)]
        good, slips = selectable(runs), rates.known(runs, "slip_max")
        lost = good[~rates.flag(good, "tracked")]
        counted = dict(Counter(failure_cause(row) for _, row in lost.iterrows()).most_common())
        failed, failed_all = (rates.flag_fraction(one, "tracked", wanted=False) for one in (good, runs))
        slip = float(slips.max()) if slips.size else float("nan")
        row = printed.get(name)
        paper = [NOTHING] * 2 if row is None else [f"{row['failures']} of {row['trials']}", row["reason"]]
        causes = "; ".join(f"{cause}: {n}" for cause, n in counted.items()) or "none"
        ours = [rates.fraction_text(failed), rates.interval_text(failed), causes, rates.fraction_text(failed_all)]
        rows.append([name, *paper, *ours, percent(slip)])
        shares = {"failed": asdict(failed), "failed_all": asdict(failed_all)}
        data.append({"name": name, **shares, "causes": counted, "slip_max": slip})
    head = ["Terrain", "Failures, paper", "Reason, paper", "Failures, ours", f"{format_fraction(CONFIDENCE)} interval"]
    head += ["Cause, ours", "Failures, all targets", "Maximum slip"]
    note = note_text("vtt.table_2", limit=f"{EXCESSIVE_DEG:g}")
    title = "Table II: tracking with visual odometry on four kinds of ground"
    return Section("table-2", "Table II", title, [Block(grid=Grid(head, rows), note=note)], {"terrains": data})


def failure_cause(row: pd.Series) -> str:
    """Cause of a failed run by its row."""
    outcome = str(row["outcome"])
    if outcome not in ("COMPLETED", "LOST"):
        return outcome.replace("_", " ").lower()
    if float(row.get("azimuth_change_max_deg", 0.0)) > EXCESSIVE_DEG:
        return "excessive azimuth change"
    if row.get("clear_sky") is not None and not bool(row["clear_sky"]):
        return "lighting change"
    return "drift" if outcome == "COMPLETED" else str(row["losses"]).replace("_", " ").lower()


def regression_section(subject: Subject) -> Section | None:
    """The regression runs (section 6); None unless the campaign is that one."""
    frame = subject.frame
    if subject.run.name != REGRESSION or not is_closed_loop(frame) or "visual_odometry" not in frame:
        return None
    mapped = frame["map_by"] if "map_by" in frame else pd.Series("none", index=frame.index)
    driving = np.where(frame["visual_odometry"].astype(bool), "visual odometry", "blind")
    by_map = ("Autonav by " + mapped.astype(str) + " cameras").to_numpy()
    described = frame.assign(
        driving=np.where(frame["autonav"].astype(bool), by_map, driving),
        rock=np.where(numbers(frame, "rock_height_m") <= SMALL_M, "small", "large"),
    )
    grid = build_grid(
        list(described.groupby(["driving", "rock", "incline"], sort=True)),
        {
            "Driving": lambda one: str(one[0][0]),
            "Rock": lambda one: str(one[0][1]),
            "Ground": lambda one: str(one[0][2]),
            "Runs": lambda one: f"{len(one[1]):,}",
            "Tracked to the goal": lambda one: rates.fraction_text(rates.flag_fraction(one[1], "tracked")),
            "Outcomes": lambda one: ", ".join(sorted(str(outcome) for outcome in one[1]["outcome"].unique())),
            "Position error (cm)": lambda one: rates.spread_text(rates.known(one[1], "position_error_m", 100.0), 2),
            "Drift (px)": lambda one: rates.spread_text(rates.known(one[1], "drift_px"), 1),
            "Navigation updates": lambda one: rates.spread_text(rates.known(one[1], "autonav_updates"), 0),
        },
    )
    note = "The paper: 14 runs, all successful, which it does not list. Small rocks are those less than 10 cm high."
    blocks, lost = [Block(grid=grid, note=note)], losses_grid(frame)
    if lost.rows:
        blocks.append(Block(heading="Runs that lost the target", grid=lost))
    data = {"tracked": asdict(rates.flag_fraction(frame, "tracked"))}
    return Section("regression", "Regression", "Regression runs on the engineering model", blocks, data)


SECTIONS = (table_1_section, SINGLE_RUNS, updates_section, steps_section, terrains_section, regression_section)
