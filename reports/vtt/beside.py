"""What the tracking paper tells of single runs on Mars and elsewhere, beside the campaign of that name."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from marsyard.reports.columns import numbers
from marsyard.reports.section import Block, Section, Subject
from marsyard.reports.sections import Grid
from marsyard.reports.vtt.rows import flag_share, holds, is_tracking, known, legs, share_text, spread_text
from marsyard.reports.wording import NOTHING

Ours = Callable[[pd.DataFrame], str]


@dataclass(frozen=True)
class Fact:
    """A quantity, what the paper says of it, and how ours is told."""

    name: str
    paper: str
    ours: Ours


@dataclass(frozen=True)
class Facts:
    """What the paper tells of one of its runs: a title, its facts, and what a reader must know."""

    title: str
    facts: Sequence[Fact]
    note: str = ""


def _spread(column: str, digits: int, scale: float = 1.0) -> Ours:
    return lambda frame: spread_text(known(frame, column, scale), digits)


def _size(column: str, digits: int) -> Ours:
    return lambda frame: spread_text(np.abs(known(frame, column)), digits)


def _share(name: str, *flags: str) -> Ours:
    return lambda frame: share_text(flag_share(frame[holds(frame, *flags)], name)) if name in frame else NOTHING


def _difference(first: str, second: str, digits: int) -> Ours:
    def told(frame: pd.DataFrame) -> str:
        values: Float[np.ndarray, " n"] = numbers(frame, first) - numbers(frame, second)
        return spread_text(values[np.isfinite(values)], digits)

    return told


_MEDIANS = "Ours: the median over all cases, and least to greatest in brackets. A dash: the paper does not say."
#: What the paper tells, by the campaign's name.
PAPER: Mapping[str, Facts] = MappingProxyType(
    {
        "vtt-checkout-1": Facts(
            "First checkout (sol 992)",
            (
                Fact("tracked over all eight pictures", "1 of 1", _share("tracked")),
                Fact("azimuth change in all (deg)", "53.5", _size("azimuth_total_deg", 1)),
                Fact("largest azimuth change (deg)", "15.44", _spread("azimuth_change_max_deg", 2)),
                Fact("largest roll change (deg)", "6.25", _spread("roll_change_max_deg", 2)),
                Fact("least magnification", "0.97", _spread("magnification_min", 2)),
                Fact("largest magnification", "1.04", _spread("magnification_max", 2)),
                Fact("least NCC score", "0.79", _spread("match_score_min", 2)),
            ),
        ),
        "vtt-checkout-2": Facts(
            "Second checkout (sol 1100)",
            (
                Fact("tracked to the goal", "1 of 1", _share("tracked")),
                Fact("pictures tracked", "18", _spread("updates", 0)),
                Fact("least magnification", "1.09", _spread("magnification_min", 2)),
                Fact("largest magnification", "1.13", _spread("magnification_max", 2)),
                Fact("least NCC score", "over 0.85", _spread("match_score_min", 2)),
                Fact("least stereo score", "over 0.85", _spread("stereo_score_min", 2)),
                Fact("largest correction (px)", "11", _spread("correction_max_px", 1)),
                Fact("target moved, first to last estimate (cm)", "36", _spread("target_moved_m", 1, 100.0)),
                Fact("duration (min)", "19", _spread("duration_min", 1)),
                Fact("position error at the goal (cm)", NOTHING, _spread("position_error_m", 2, 100.0)),
            ),
            "The paper drives in 15 steps and speaks of 18 images; its smallest magnification leaves out the last, "
            "shorter step, ours does not. Steps, durations and path are set, the rest results.",
        ),
        "vtt-checkout-3": Facts(
            "Table IV: third checkout (sol 1194)",
            (
                Fact("tracked through all motions", "1 of 1", _share("tracked")),
                Fact("tracking updates", "27", _spread("updates", 0)),
                Fact("visual odometry updates", "6", _spread("visual_odometry_updates", 0)),
                Fact("navigation updates", "5", _spread("autonav_updates", 0)),
                Fact("duration (min)", "66", _spread("duration_min", 1)),
                Fact("sun moved (deg)", "16", _spread("sun_moved_deg", 1)),
                Fact("position error at the end (cm)", NOTHING, _spread("position_error_m", 2, 100.0)),
            ),
            "Steps are set as the paper tells them; the sun's 16 deg in 66 minutes are those that it is moved by.",
        ),
        "vtt-placement": Facts(
            "Single-sol placement (sol 1216)",
            (
                Fact("target handed to the arm", "1 of 1", _share("handed_over")),
                Fact("of selectable targets", NOTHING, _share("handed_over", "selectable")),
                Fact("distance at the start (m)", "4.7 from the rover", _spread("range_start_m", 2)),
                Fact("distance at the end (m)", "2", _spread("range_end_m", 2)),
                Fact("position error at the goal (cm)", "within 3", _spread("position_error_m", 2, 100.0)),
            ),
            "The paper asks for 3 cm of instrument placement; it does not measure the error of this run. Our "
            "distances are the camera's.",
        ),
        "vtt-roll": Facts(
            "Fig. 4: passing the target by",
            (
                Fact("roll of the picture in all (deg)", "30", _size("roll_total_deg", 1)),
                Fact("distance at the start (m)", "6.8", _spread("range_start_m", 2)),
                Fact("distance at the end (m)", "1.8", _spread("range_end_m", 2)),
                Fact("tracked with compensation", "1 of 1", _share("tracked", "selectable", "roll_compensated")),
                Fact(
                    "tracked without it", '"would not have succeeded"', _share("tracked", "selectable", "roll_ignored")
                ),
            ),
            "Roll and distances are of all cases, also of those that lost the target on the way.",
        ),
    }
)


#: Campaign of Table IV.
CHECKOUT_3 = "vtt-checkout-3"


@dataclass(frozen=True)
class Mode:
    """A row of Table IV as printed, and which legs of a campaign it is: by motion and by what steers them."""

    name: str
    updates: int
    duration_min: float
    motion: str
    autonav: bool = False


TABLE_IV = (
    Mode("seed at 3 m", 2, 2.0, "stay"),
    Mode("turn in place by 10 deg", 7, 10.0, "turn"),
    Mode("back from 4 to 7 m", 10, 11.0, "back-off"),
    Mode("with visual odometry over 2.1 m", 4, 15.0, "approach"),
    Mode("with the navigator over 1.4 m", 4, 28.0, "approach", autonav=True),
)
_TABLE_IV_NOTE = (
    "The paper's 5 minutes for the first map stand with the navigator's 23, as the map is begun on the way back in "
    "ours. Ours: as above. A mode lasts from the last update before it to its own last."
)
_LEG = re.compile(r"^update_\d+_leg$")


def beside_section(subject: Subject) -> Section | None:
    """The paper's facts beside ours; None where the campaign is none of the paper's runs."""
    facts = PAPER.get(subject.run.name)
    if facts is None or not is_tracking(subject.frame):
        return None
    told = [(fact, fact.ours(subject.frame)) for fact in facts.facts]
    grid = Grid(["", "Paper", "Ours"], [[fact.name, fact.paper, ours] for fact, ours in told])
    note = f"{_MEDIANS} {facts.note}".strip()
    blocks = [Block(grid=grid, note=note)]
    data: dict[str, Any] = {fact.name: {"paper": fact.paper, "ours": ours} for fact, ours in told}
    if subject.run.name == CHECKOUT_3 and "update_1_leg" in subject.frame:
        by_mode = table_iv(subject.frame, legs(subject))
        blocks.append(Block(heading="By operational mode", grid=by_mode, note=_TABLE_IV_NOTE))
    return Section("paper", "Beside the paper", facts.title, blocks, data)


def table_iv(frame: pd.DataFrame, driven: Sequence[Mapping[str, object]]) -> Grid:
    """Tracking updates and minutes of each operational mode, the paper's beside ours; `driven` are the legs."""
    of_update = [int(str(name).split("_")[1]) for name in frame.columns if _LEG.match(str(name))]
    legs_of = np.column_stack([numbers(frame, f"update_{n}_leg") for n in of_update])
    times = np.column_stack([numbers(frame, f"update_{n}_time_s") for n in of_update]) / 60.0
    rows, before = [], np.zeros(len(frame))
    for mode in TABLE_IV:
        chosen = np.isin(legs_of, _legs_of(mode, driven))
        reached = chosen.any(axis=1)
        end = np.where(chosen, times, -np.inf).max(axis=1)
        counts, minutes = chosen.sum(axis=1).astype(np.float64), (end - before)[reached]
        ours = (spread_text(counts[reached], 0), spread_text(minutes, 1))
        rows.append([mode.name, f"{mode.updates}", ours[0], f"{mode.duration_min:g}", ours[1]])
        before = np.where(reached, end, before)
    return Grid(["Mode", "Updates, paper", "Updates, ours", "Minutes, paper", "Minutes, ours"], rows)


def _legs_of(mode: Mode, driven: Sequence[Mapping[str, object]]) -> list[int]:
    """Numbers of a mode's legs; the first update, at the start, has the number -1."""
    motions = [str(leg.get("motion", "approach")) for leg in driven]
    steered = [motion == "approach" and bool(leg.get("autonav")) for motion, leg in zip(motions, driven, strict=True)]
    kinds = enumerate(zip(motions, steered, strict=True))
    found = [number for number, kind in kinds if kind == (mode.motion, mode.autonav)]
    return [-1, *found] if mode is TABLE_IV[0] else found
