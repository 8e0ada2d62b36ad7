"""Runs of tracking campaigns: which rows they are, and the numbers and campaigns of the paper that they repeat.

The paper is Kim et al., "Targeted Driving Using Visual Tracking".
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from marsyard.reports import populations
from marsyard.reports.papers import read_paper
from marsyard.reports.section import Subject
from marsyard.reports.stored import table

#: Columns of all rows of tracking cases.
_TRACKING_COLUMNS = ("tracked", "drift_px", "position_error_m", "losses")


def is_tracking(frame: pd.DataFrame) -> bool:
    """Whether the rows are those of tracking cases."""
    return {*_TRACKING_COLUMNS} <= {*frame}


def is_closed_loop(frame: pd.DataFrame) -> bool:
    """Whether the tracker guides the rover; in other campaigns, many targets are tracked in the same images."""
    return is_tracking(frame) and "step" not in frame


def selectable_targets(frame: pd.DataFrame, face: bool = True) -> pd.DataFrame:
    """Select rows with selectable targets: sunlit, in both images to the end, not on the rock's edge.

    In shared drives, whose path does not depend on the tracker, the rover's shadow is never on the target. With `face`,
    the target is also on the rock's face, where the campaign defines it.
    """
    names = ["selectable", "in_view", *(["on_face"] if face else [])]
    if "step" in frame:
        names.append("no_rover_shadow_on_target")
    return frame[populations.all_flags(frame, *names)]


PAPER_FILE = Path(__file__).with_name("paper.toml")
PAPER = read_paper(PAPER_FILE)
#: Campaigns of Tables II and III, and of the regression runs.
TERRAINS, CHECKOUT_1, CHECKOUT_3, REGRESSION = "vtt-terrains", "vtt-checkout-1", "vtt-checkout-3", "vtt-regression"


def read_legs(subject: Subject) -> list[Mapping[str, Any]]:
    """Read the legs of the drive (approach or turn, for example) from the campaign's parameters."""
    drive = subject.run.parameter("drive")
    leg_table = table(drive).get("legs") if drive is not None else subject.run.parameter("legs")
    return [table(leg) for leg in leg_table] if isinstance(leg_table, list | tuple) else []
