"""Section on the tracked targets by step size (Fig. 8 of Kim et al., "Targeted Driving Using Visual Tracking").

A step is the motion of the rover from one image to the next: an angle, or a fraction of the distance to the target.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import pandas as pd

from marsyard.reports import rates
from marsyard.reports.plots import RateLine, rate_figure
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Block, Grid, Section, Subject, build_grid, svg_figure
from marsyard.reports.vtt.tracking_runs import PAPER, is_tracking, read_legs, selectable_targets
from marsyard.reports.wording import NOTHING, format_fraction, note_text, number

#: Columns that distinguish the lines of the figure of steps: tracker, or side of the search window. The first column
#: that varies is used.
_LINE_COLUMNS = ("algorithm", "search_px")
_STEPS_NOTE = note_text("vtt.steps", confidence=format_fraction(CONFIDENCE))
#: Maximum difference of a step from that of a result of the paper, degrees or per cent.
_MAX_STEP_DIFFERENCE = 0.5
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
            [cell.step for cell in line_cells],
            [cell.good for cell in line_cells],
            {cell.step: cell.paper_percent / 100.0 for cell in line_cells if cell.paper_percent is not None},
        )
        for name in dict.fromkeys(cell.line for cell in steps)
        if (line_cells := [cell for cell in steps if cell.line == name and cell.good.n])
    ]
    unit = "% of the distance" if motion["per_cent"] else "deg"
    xlabel = "step (% of the target's distance)" if motion["per_cent"] else "step (deg)"
    caption = f"Selectable targets that are tracked to the end, with {format_fraction(CONFIDENCE)} intervals."
    columns: dict[str, Callable[[StepRates], str]] = {
        f"Step ({unit})": lambda cell: number(cell.step).rstrip("0").rstrip("."),
        "Tracked, of selectable": lambda cell: rates.fraction_text(cell.good),
        f"{format_fraction(CONFIDENCE)} interval": lambda cell: rates.interval_text(cell.good),
        "Tracked, of all targets": lambda cell: rates.fraction_text(cell.all_targets),
        "False track, of selectable": lambda cell: rates.fraction_text(cell.false_tracks),
    }
    if any(cell.line for cell in steps):
        name = "Search window" if steps[0].line.endswith("px") else "Tracker"
        columns = {name: lambda cell: cell.line, **columns}
    if any(line.paper for line in lines):
        caption += " Open marks: text of the paper."
        columns["Paper, of selectable"] = lambda cell: (
            NOTHING if cell.paper_percent is None else f"{cell.paper_percent:.0f} %"
        )
    grid = build_grid(steps, columns)
    svg_figures = [svg_figure(rate_figure(lines, (xlabel, "targets tracked")), "steps", caption)]
    blocks = [Block(text=motion["text"], figures=svg_figures), Block(grid=grid, note=_STEPS_NOTE)]
    oblique = _obliquity_grid(subject.frame, per_cent=bool(motion["per_cent"]))
    if oblique is not None:
        blocks.append(Block(heading="By obliquity of the surface", grid=oblique, note=note_text("vtt.obliquity")))
    return Section("steps", "Steps", motion["title"], blocks, {"cells": steps})


def _read_motion(subject: Subject) -> Mapping[str, Any] | None:
    """Read the paper's results for the motion of the drive; None unless it is one leg of a motion in the paper."""
    drive_legs = read_legs(subject)
    motions: Mapping[str, Mapping[str, Any]] = PAPER["steps"]
    return motions.get(str(drive_legs[0].get("motion", "approach"))) if len(drive_legs) == 1 else None


@dataclass(frozen=True)
class StepRates:
    """Rates of tracked targets of a line (tracker or search window; empty for a single one) at a step size.

    - step: angle in degrees, or fraction of the distance to the target in per cent
    - good, false_tracks: fractions of the selectable targets that are tracked, and that have a false track
    - all_targets: fraction of all targets that are tracked
    - paper_percent: percentage of tracked targets in the paper; None without one
    """

    line: str
    step: float
    good: rates.CaseFraction
    all_targets: rates.CaseFraction
    false_tracks: rates.CaseFraction
    paper_percent: float | None


def step_rates(subject: Subject) -> list[StepRates]:
    """Compute the rates of tracked targets for every line and step size."""
    frame, motion = subject.frame, _read_motion(subject)
    if motion is None or not is_tracking(frame) or "step" not in frame:
        return []
    cells = []
    for line, line_rows in _group_by_line(frame[frame["step"].notna()]):
        paper = motion["paper"].get(line) or motion["paper"].get("", {})
        for _, step_rows in line_rows.groupby("step"):
            step = float(step_rows["step"].iloc[0]) * (100.0 if motion["per_cent"] else 1.0)
            selectable_rows = selectable_targets(step_rows)
            paper_percentages = (
                percentage for size, percentage in paper.items() if abs(step - float(size)) < _MAX_STEP_DIFFERENCE
            )
            cells.append(
                StepRates(
                    line=line,
                    step=step,
                    good=rates.flag_fraction(selectable_rows, "tracked"),
                    all_targets=rates.flag_fraction(step_rows, "tracked"),
                    false_tracks=rates.flag_fraction(selectable_rows, "no_false_track", value=False),
                    paper_percent=next(paper_percentages, None),
                )
            )
    return cells


def _group_by_line(frame: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Group rows by the column that varies (`_LINE_COLUMNS`); a single line without name if no column varies."""
    column = next((name for name in _LINE_COLUMNS if name in frame and frame[name].nunique() > 1), None)
    if column is None:
        yield "", frame
        return
    for value in sorted(frame[column].dropna().unique(), reverse=column == "algorithm"):
        # an algorithm's label in the rows has underscores, its name hyphens
        name = f"{value:g} px" if column.endswith("_px") else str(value).replace("_", "-")
        yield name, frame[frame[column].eq(value)]


def _obliquity_grid(frame: pd.DataFrame, *, per_cent: bool) -> Grid | None:
    """Create a table of tracked targets by maximum obliquity and step size; None if rows contain no obliquities.

    Trackers have separate rows; search windows are pooled.
    per_cent: whether steps are fractions of the distance to the target, not degrees
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
    scale, unit = (100.0, "%") if per_cent else (1.0, "deg")
    head = ["Maximum obliquity (deg)", *(f"{scale * step:.3g} {unit}" for step in steps)]
    return Grid(["Tracker", *head] if has_trackers else head, rows) if rows else None
