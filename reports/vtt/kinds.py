"""Runs by kind: the tracking paper's Table II (terrains) and its regression runs (section 6)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd

from marsyard.reports.answers import CONFIDENCE, Share
from marsyard.reports.columns import numbers
from marsyard.reports.section import Block, Section, Subject
from marsyard.reports.sections import Grid
from marsyard.reports.vtt.goal import losses_grid
from marsyard.reports.vtt.rows import (
    flag_share,
    interval_text,
    is_closed_loop,
    known,
    selectable,
    share_text,
    spread_text,
)
from marsyard.reports.wording import NOTHING, percent, stated


@dataclass(frozen=True)
class PaperRow:
    """A row of Table II: trials, failures, and what it says of them."""

    trials: int
    failures: int
    reason: str


#: Table II as printed.
TABLE_II: Mapping[str, PaperRow] = MappingProxyType(
    {
        "flat ground": PaperRow(11, 1, "excessive azimuth change"),
        "shallow incline": PaperRow(4, 0, "none"),
        "steep incline": PaperRow(6, 0, "none (despite 100 % slippage sometimes)"),
        "oblique path": PaperRow(5, 1, "dramatic lighting change"),
    }
)
#: A change of azimuth that the paper calls excessive, degrees (section 5.5).
EXCESSIVE_DEG = 10.0
TERRAINS, REGRESSION = "vtt-terrains", "vtt-regression"
#: Rocks up to this height are small ones (section 6), metres.
SMALL_M = 0.1


@dataclass(frozen=True)
class Terrain:
    """Runs on one kind of ground.

    Attributes
    ----------
    name
        The kind.
    failed, failed_all
        Shares of runs not tracked to the goal: at selectable targets, and at all.
    causes
        Failed runs at selectable targets by cause.
    slip_max
        Largest slip of any drive.
    """

    name: str
    failed: Share
    failed_all: Share
    causes: Mapping[str, int]
    slip_max: float


def terrains_section(subject: Subject) -> Section | None:
    """Table II; None where the campaign is not that of the paper's terrains."""
    if subject.run.name != TERRAINS or not is_closed_loop(subject.frame) or "incline" not in subject.frame:
        return None
    found = terrains(subject.frame)
    head = [
        "Terrain",
        "Failures, paper",
        "Reason, paper",
        "Failures, ours",
        f"{stated(CONFIDENCE)} interval",
        "Cause, ours",
    ]
    head += ["Failures, with unfit targets", "Largest slip"]
    rows = [
        [
            one.name,
            f"{TABLE_II[one.name].failures} of {TABLE_II[one.name].trials}" if one.name in TABLE_II else NOTHING,
            TABLE_II[one.name].reason if one.name in TABLE_II else NOTHING,
            share_text(one.failed),
            interval_text(one.failed),
            "; ".join(f"{cause}: {runs}" for cause, runs in one.causes.items()) or "none",
            share_text(one.failed_all),
            percent(one.slip_max),
        ]
        for one in found
    ]
    blocks = [Block(grid=Grid(head, rows), note=_NOTE)]
    data: dict[str, Any] = {"terrains": [asdict(one) for one in found]}
    return Section(
        "table-2", "Table II", "Table II: tracking with visual odometry on four kinds of ground", blocks, data
    )


_NOTE = (
    "Failures: runs that did not end at the goal with the target within the stated pixels; ours of selectable "
    "targets, and of all, those in shade or on the rock's edge included. Causes, the first that holds: the "
    f"navigator or mast gave up; the azimuth changed by more than {EXCESSIVE_DEG:g} deg between two updates; clouds "
    "passed; drifted though never lost; else the criterion that lost the target."
)


def terrains(frame: pd.DataFrame) -> list[Terrain]:
    """Runs by kind of ground: those of the paper in its order, then others."""
    names = [str(name) for name in frame["incline"].dropna().unique()]
    ordered = [name for name in TABLE_II if name in names] + sorted(set(names) - set(TABLE_II))
    return [_terrain(frame[frame["incline"].eq(name)], name) for name in ordered]


def _terrain(runs: pd.DataFrame, name: str) -> Terrain:
    good = selectable(runs)
    causes: dict[str, int] = {}
    for _, row in good[~good["tracked"].fillna(False).to_numpy(dtype=np.bool_)].iterrows():
        cause = cause_of(row)
        causes[cause] = causes.get(cause, 0) + 1
    slips = known(runs, "slip_max")
    return Terrain(
        name=name,
        failed=flag_share(good, "tracked", wanted=False),
        failed_all=flag_share(runs, "tracked", wanted=False),
        causes=dict(sorted(causes.items(), key=lambda item: -item[1])),
        slip_max=float(slips.max()) if slips.size else float("nan"),
    )


def cause_of(row: pd.Series) -> str:
    """Why a run failed, as far as its row tells."""
    outcome = str(row["outcome"])
    if outcome not in ("COMPLETED", "LOST"):
        return outcome.replace("_", " ").lower()
    if float(row.get("azimuth_change_max_deg", 0.0)) > EXCESSIVE_DEG:
        return "excessive azimuth change"
    if row.get("clear_sky") is not None and not bool(row["clear_sky"]):
        return "lighting change"
    if outcome == "COMPLETED":
        return "drift"
    return str(row["losses"]).replace("_", " ").lower()


def regression_section(subject: Subject) -> Section | None:
    """The regression runs one by one; None where the campaign is not that one."""
    frame = subject.frame
    if subject.run.name != REGRESSION or not is_closed_loop(frame) or "visual_odometry" not in frame:
        return None
    head = ["Driving", "Rock", "Ground", "Runs", "Tracked to the goal", "Outcomes", "Position error (cm)", "Drift (px)"]
    head += ["Navigation updates"]
    described = frame.assign(driving=_driving(frame), rock=_rocks(frame))
    rows = [
        [
            *(str(kind) for kind in kinds),
            f"{len(runs):,}",
            share_text(flag_share(runs, "tracked")),
            ", ".join(sorted(str(outcome) for outcome in runs["outcome"].unique())),
            spread_text(known(runs, "position_error_m", 100.0), 2),
            spread_text(known(runs, "drift_px"), 1),
            spread_text(known(runs, "autonav_updates"), 0),
        ]
        for kinds, runs in described.groupby(["driving", "rock", "incline"], sort=True)
    ]
    lost = losses_grid(frame)
    note = "The paper: 14 runs, all successful, which it does not list. Small rocks are those less than 10 cm high."
    blocks = [Block(grid=Grid(head, rows), note=note)]
    if lost.rows:
        blocks.append(Block(heading="Runs that did not track to the end", grid=lost))
    data = {"tracked": asdict(flag_share(frame, "tracked"))}
    return Section("regression", "Regression", "Regression runs on the engineering model", blocks, data)


def _driving(frame: pd.DataFrame) -> Sequence[str]:
    mapped = frame["map_by"] if "map_by" in frame else pd.Series(["none"] * len(frame))
    flags = zip(frame["visual_odometry"], frame["autonav"], mapped, strict=True)
    return [
        f"Autonav by {by} cameras" if nav else "visual odometry" if visual else "blind" for visual, nav, by in flags
    ]


def _rocks(frame: pd.DataFrame) -> Sequence[str]:
    return ["small" if height <= SMALL_M else "large" for height in numbers(frame, "rock_height_m")]
