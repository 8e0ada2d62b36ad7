"""Targets tracked by size of step: the tracking paper's Fig. 8, its sideways motions (5.2) and its turns (5.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from types import MappingProxyType
from typing import Any

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from marsyard.reports.answers import CONFIDENCE, Share
from marsyard.reports.plates import plate
from marsyard.reports.section import Block, Section, Subject
from marsyard.reports.sections import Grid
from marsyard.reports.svg import MARKERS, SERIES, in_page_style, new_axes
from marsyard.reports.vtt.rows import flag_share, holds, interval_text, is_tracking, legs, selectable, share_text
from marsyard.reports.wording import NOTHING, number, stated

#: What tells the lines of a figure apart, where it varies.
_SERIES = ("algorithm", "search_px")


@dataclass(frozen=True)
class Motion:
    """A kind of drive.

    Attributes
    ----------
    title
        Of its section.
    per_cent
        Whether steps are shares of the target's distance, else degrees.
    paper
        What the paper's text gives, in per cent tracked, by the line's name and the step; not what its plots show.
    text
        The paper's findings in words.
    """

    title: str
    per_cent: bool
    paper: Mapping[tuple[str, float], float]
    text: str


MOTIONS: Mapping[str, Motion] = MappingProxyType(
    {
        "approach": Motion(
            "Fig. 8: straight drives by size of step",
            True,
            {("pure-ncc", 5.0): 80.0, ("pure-ncc", 23.0): 15.0, ("vtt", 5.0): 100.0, ("vtt", 23.0): 95.0},
            "The paper's text gives four of its curves' points, of 20 targets on one rock; they are open in the "
            "figure.",
        ),
        "circle": Motion(
            "Fig. 10: sideways around the target by size of step",
            False,
            {("", 5.0): 100.0, ("", 10.0): 100.0, ("", 15.0): 100.0 * 9 / 11},
            "The paper: with steps of 5 and 10 deg all 11 targets off the occluding edge, 2 of the 11 lost with 15 "
            "deg; the larger window loses slightly more. It does not say with which window its numbers are.",
        ),
        "turn": Motion(
            "Turns in place by size of step",
            False,
            {},
            "The paper: tracking was good over the entire range of 5 to 45 deg, without numbers.",
        ),
    }
)


@dataclass(frozen=True)
class StepCell:
    """Targets tracked with one step.

    Attributes
    ----------
    line
        The tracker or its search window.
    step
        In per cent of the target's distance or in degrees.
    good, all_targets
        Shares tracked: of selectable targets, and of all.
    false_tracks
        Share of selectable targets that some update reported at a wrong place.
    paper_percent
        The paper's; None where its text has none.
    """

    line: str
    step: float
    good: Share
    all_targets: Share
    false_tracks: Share
    paper_percent: float | None


def steps_section(subject: Subject) -> Section | None:
    """Shares by step; None where rows do not share pictures of a drive."""
    found = cells(subject)
    motion = _motion(subject)
    if not found or motion is None:
        return None
    caption = "Selectable targets tracked to the end, with intervals; open: the paper's text."
    blocks = [
        Block(text=motion.text, plates=[plate(step_figure(found, motion), "steps", caption)]),
        Block(grid=_grid(found, motion), note=_NOTE),
    ]
    oblique = _obliquity_grid(subject.frame, motion)
    if oblique is not None:
        blocks.append(Block(grid=oblique, note=_OBLIQUE))
    return Section("steps", "Steps", motion.title, blocks, {"cells": [asdict(one) for one in found]})


_NOTE = (
    "Selectable: lit, off the rock's edge, in both pictures to the end and, where the campaign says so, on the face "
    "that all stops see. Tracked: found in the last picture within the stated pixels of the designated point's true "
    "projection. Falsely tracked: reported beyond them at some stop. "
    f"Intervals: two-sided, Clopper and Pearson, at {stated(CONFIDENCE)} confidence, as for independent targets; "
    "those of a rock share its pictures and are not."
)


#: Edges of classes of the most oblique sight, deg.
_CLASSES_DEG = (0.0, 45.0, 60.0, 65.0, 70.0, 90.0)

_OBLIQUE = (
    "Lit targets in view to the end, tracked of all, by how obliquely their surface was seen at most. The template is "
    "scaled and rolled, but not narrowed as an oblique patch is that turns."
)


def _obliquity_grid(frame: pd.DataFrame, motion: Motion) -> Grid | None:
    """Targets tracked by class of the most oblique sight and step; None where sights are not told or do not turn."""
    if motion.per_cent or "obliquity_max_deg" not in frame:
        return None
    seen = frame[holds(frame, "selectable", "in_view") & frame["obliquity_max_deg"].notna().to_numpy()]
    steps = sorted(seen["step"].unique())
    rows = []
    for low, high in pairwise(_CLASSES_DEG):
        chosen = seen[seen["obliquity_max_deg"].between(low, high, inclusive="left")]
        if len(chosen):
            shares = [flag_share(chosen[chosen["step"].eq(step)], "tracked") for step in steps]
            rows.append([f"{low:g} to {high:g}", *(f"{one.hits:,} of {one.n:,}" for one in shares)])
    return Grid(["Most oblique sight (deg)", *(f"{step:g} deg" for step in steps)], rows) if rows else None


def cells(subject: Subject) -> list[StepCell]:
    """Every line and step, in order."""
    frame, motion = subject.frame, _motion(subject)
    if motion is None or not is_tracking(frame) or "step" not in frame or "skip" not in frame:
        return []
    completed = frame[frame["step"].notna()]
    found = []
    for line, rows in _lines(completed):
        for _, chosen in rows.groupby("skip"):
            step = float(chosen["step"].iloc[0]) * (100.0 if motion.per_cent else 1.0)
            good = selectable(chosen)
            found.append(
                StepCell(
                    line=line,
                    step=step,
                    good=flag_share(good, "tracked"),
                    all_targets=flag_share(chosen, "tracked"),
                    false_tracks=flag_share(good, "true_track", wanted=False),
                    paper_percent=_paper(motion, line, step),
                )
            )
    return found


def _motion(subject: Subject) -> Motion | None:
    of_drive = legs(subject)
    return MOTIONS.get(str(of_drive[0].get("motion", "approach"))) if len(of_drive) == 1 else None


def _lines(frame: pd.DataFrame) -> Sequence[tuple[str, pd.DataFrame]]:
    """Rows by what tells them apart; one line without a name where nothing does."""
    for column in _SERIES:
        if column in frame and frame[column].nunique() > 1:
            unit = " px" if column.endswith("_px") else ""
            kinds = sorted(frame[column].dropna().unique(), reverse=column == "algorithm")
            # an algorithm's label in the rows has underscores, its name hyphens
            named = [f"{kind:g}{unit}" if unit else str(kind).replace("_", "-") for kind in kinds]
            return [(name, frame[frame[column].eq(kind)]) for name, kind in zip(named, kinds, strict=True)]
    return [("", frame)]


def _paper(motion: Motion, line: str, step: float) -> float | None:
    return next(
        (
            value
            for (name, size), value in motion.paper.items()
            if name in ("", line) and abs(step - size) < 0.5
        ),
        None,
    )  # fmt: skip


def _grid(found: Sequence[StepCell], motion: Motion) -> Grid:
    unit = "% of the distance" if motion.per_cent else "deg"
    confidence = stated(CONFIDENCE)
    head = ["Tracker", f"Step ({unit})", "Tracked, of selectable", f"{confidence} interval", "Paper"]
    head += ["Tracked, of all targets", "Falsely tracked, of selectable"]
    rows = [
        [
            one.line or "vtt",
            number(one.step).rstrip("0").rstrip("."),
            share_text(one.good),
            interval_text(one.good),
            NOTHING if one.paper_percent is None else f"{one.paper_percent:.0f} %",
            share_text(one.all_targets),
            share_text(one.false_tracks),
        ]
        for one in found
    ]
    return Grid(head, rows)


@in_page_style
def step_figure(found: Sequence[StepCell], motion: Motion) -> Figure:
    """Share of selectable targets tracked against the step, a line each."""
    figure, axes = new_axes(6.6, 3.8)
    lines = list(dict.fromkeys(one.line for one in found))
    for place, line in enumerate(lines):
        ours = [one for one in found if one.line == line and one.good.n]
        steps, shares = [one.step for one in ours], [one.good.share for one in ours]
        below = [one.good.share - one.good.lower for one in ours]
        above = [one.good.upper - one.good.share for one in ours]
        style: dict[str, Any] = {"color": SERIES[place], "marker": MARKERS[place]}
        axes.errorbar(
            steps, shares, [below, above], capsize=2.5, elinewidth=0.9, markersize=5.5, label=line or "tracked", **style
        )
        known = [one for one in ours if one.paper_percent is not None]
        if known:
            x, y = (
                [one.step for one in known],
                [one.paper_percent / 100.0 for one in known if one.paper_percent is not None],
            )
            label = f"{line}, paper" if line else "paper"
            axes.plot(
                x, y, linestyle="", markersize=10, markerfacecolor="none", markeredgewidth=1.5, label=label, **style
            )
    axes.set(ylim=(-0.03, 1.05), ylabel="targets tracked")
    axes.set_xlabel("step (% of the target's distance)" if motion.per_cent else "step (deg)")
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, symbol=" %"))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=2)
    return figure
