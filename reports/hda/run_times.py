"""Run time of the four stages beside Table I of the landing paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from marsyard.reports.columns import numbers
from marsyard.reports.hda.rows import is_landing
from marsyard.reports.section import Block, Section, Subject
from marsyard.reports.sections import Grid
from marsyard.reports.wording import NOTHING, count, number


@dataclass(frozen=True)
class Stage:
    """A stage as Table I has it: its column in our rows, its name, seconds and parameters."""

    column: str
    name: str
    paper_s: float
    paper_parameters: str
    ours: tuple[str, ...]
    said: str


#: Table I: on a 400 MHz R12000.
TABLE_1: Sequence[Stage] = (
    Stage(
        "tracking_time_s",
        "Feature selection & tracking",
        0.21,
        "11x11 pixel templates, 81x81 pixel windows",
        ("features",),
        "{:.0f} features",
    ),
    Stage("motion_time_s", "Structure from motion", 0.10, "59 feature tracks", ("tracks",), "{:.0f} tracks"),
    Stage("structure_time_s", "Terrain map generation", 0.41, "600 structure pixels", ("points",), "{:.0f} points"),
    Stage(
        "hazards_time_s",
        "Hazard detection & avoidance",
        0.05,
        "19x27 terrain map",
        ("map_rows", "map_columns"),
        "{:.0f}x{:.0f} terrain map",
    ),
)


@dataclass(frozen=True)
class StageTime:
    """A stage's processor time over the cases that went through all of them, seconds.

    Attributes
    ----------
    name
        As in Table I.
    paper_s
        The paper's.
    median_s, late_s
        Median and 95 % quantile on this host.
    scaled_s
        The median on the paper's processor, by the factor of `paper_factor`.
    parameters
        What it worked on, medians.
    """

    name: str
    paper_s: float
    median_s: float
    late_s: float
    scaled_s: float
    parameters: str


def run_times_section(subject: Subject) -> Section | None:
    """Stages beside Table I; None where no case went through all of them."""
    times, cases = stage_times(subject)
    if not times:
        return None
    factor = paper_factor(times)
    rows = [
        [
            one.name,
            f"{one.paper_s:.2f}",
            f"{1e3 * one.median_s:.1f}",
            f"{1e3 * one.late_s:.1f}",
            f"{one.scaled_s:.2f}",
            stage.paper_parameters,
            one.parameters,
        ]
        for one, stage in zip(times, TABLE_1, strict=True)
    ]
    paper, ours = sum(one.paper_s for one in times), sum(one.median_s for one in times)
    rows.append(["Together", f"{paper:.2f}", f"{1e3 * ours:.1f}", NOTHING, f"{ours * factor:.2f}", NOTHING, NOTHING])
    head = ["Stage", "Paper (s)", "Here, median (ms)", "95 %", "Scaled (s)", "Paper's parameters", "Parameters here"]
    note = (
        f"Processor time of {count(cases, 'case')} that reached a map. The paper's is of a 400 MHz R12000. Scaled: "
        f"times {number(factor)}, which makes the sum the paper's, as no benchmark is known of both processors: it "
        "compares how the time is shared out, not how fast either is. Here the elevation map counts with the hazards, "
        "the scale with the motion. Stages with exactly the paper's parameters, on an idle machine: make bench."
    )
    data = {"factor": factor, "cases": cases, "stages": [asdict(one) for one in times]}
    return Section(
        "run-times", "Run time", "Run time by stage, beside Table I", [Block(grid=Grid(head, rows), note=note)], data
    )


def paper_factor(times: Sequence[StageTime]) -> float:
    """What makes the sum of our stages the paper's 0.77 s."""
    return sum(one.paper_s for one in times) / sum(one.median_s for one in times)


def stage_times(subject: Subject) -> tuple[list[StageTime], int]:
    """The stages' times, and of how many cases; none where no case went through all."""
    frame = subject.frame
    if not is_landing(frame):
        return [], 0
    taken = np.column_stack([numbers(frame, stage.column) for stage in TABLE_1])
    complete = np.isfinite(taken).all(axis=1)
    if not complete.any() or not taken[complete].sum() > 0.0:
        return [], 0
    taken, chosen = taken[complete], frame[complete]
    median, late = np.median(taken, axis=0), np.quantile(taken, 0.95, axis=0)
    factor = sum(stage.paper_s for stage in TABLE_1) / float(median.sum())
    times = []
    for k, stage in enumerate(TABLE_1):
        sizes = [float(np.nanmedian(numbers(chosen, name))) if name in chosen else np.nan for name in stage.ours]
        said = NOTHING if np.isnan(sizes).any() else stage.said.format(*sizes)
        times.append(
            StageTime(stage.name, stage.paper_s, float(median[k]), float(late[k]), factor * float(median[k]), said)
        )
    return times, int(complete.sum())
