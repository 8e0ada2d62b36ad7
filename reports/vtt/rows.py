"""Rows of tracking campaigns: which they are, and which of their targets operators would have selected."""

from __future__ import annotations

import pandas as pd

from marsyard.reports.rates import all_flags

#: Columns that every row of a tracking case has.
_OWN = ("tracked", "drift_px", "position_error_m", "losses")


def is_tracking(frame: pd.DataFrame) -> bool:
    """Whether rows are those of tracking cases."""
    return all(name in frame for name in _OWN)


def is_closed_loop(frame: pd.DataFrame) -> bool:
    """Whether rows are those of runs that the tracker steers, rather than of pictures that many targets share."""
    return is_tracking(frame) and "skip" not in frame


def selectable(frame: pd.DataFrame) -> pd.DataFrame:
    """The rows whose target operators would have selected: lit, off the rock's edge, in both pictures to the end.

    Where a campaign says how obliquely its targets may be seen (`face_deg`), those on that face.
    """
    return frame[all_flags(frame, "selectable", "in_view", "on_face")]
