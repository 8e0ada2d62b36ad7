"""What rows of tracking campaigns hold, and the words in which all of their sections tell it."""

from __future__ import annotations

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from marsyard.reports.answers import Share, share_of
from marsyard.reports.columns import numbers
from marsyard.reports.populations import is_flag
from marsyard.reports.section import Subject
from marsyard.reports.stored import table
from marsyard.reports.wording import NOTHING, number, percent

#: Columns that every row of a tracking case has.
_OWN = ("tracked", "drift_px", "position_error_m", "losses")


def is_tracking(frame: pd.DataFrame) -> bool:
    """Whether rows are those of tracking cases."""
    return all(name in frame for name in _OWN)


def is_closed_loop(frame: pd.DataFrame) -> bool:
    """Whether rows are those of runs that the tracker steers, rather than of pictures that many targets share."""
    return is_tracking(frame) and "skip" not in frame


def holds(frame: pd.DataFrame, *names: str) -> Bool[np.ndarray, " n"]:
    """Which rows say yes to all of these flags; a flag that the rows do not have is passed over."""
    chosen = np.ones(len(frame), dtype=np.bool_)
    for name in names:
        if is_flag(frame, name):
            chosen &= frame[name].fillna(False).to_numpy(dtype=np.bool_)
    return chosen


def selectable(frame: pd.DataFrame) -> pd.DataFrame:
    """The rows whose target operators would have selected: lit, off the rock's edge, in both pictures to the end.

    Where a campaign says how obliquely its targets may be seen (`face_deg`), those on that face.
    """
    return frame[holds(frame, "selectable", "in_view", "on_face")]


def share_text(share: Share) -> str:
    """``19 of 20: 95.00 %``."""
    return NOTHING if share.n == 0 else f"{share.hits:,} of {share.n:,}: {percent(share.share)}"


def interval_text(share: Share) -> str:
    """A share's interval."""
    return NOTHING if share.n == 0 else f"{percent(share.lower)} to {percent(share.upper)}"


def flag_share(frame: pd.DataFrame, name: str, *, wanted: bool = True) -> Share:
    """The share of rows whose flag is as wanted."""
    chosen = frame[name].fillna(not wanted).to_numpy(dtype=np.bool_) == wanted
    return share_of(chosen, frame)


def known(frame: pd.DataFrame, column: str, scale: float = 1.0) -> Float[np.ndarray, " n"]:
    """A column's numbers that are there, times a factor."""
    values = numbers(frame, column)
    return np.asarray(scale * values[np.isfinite(values)])


def spread_text(values: Float[np.ndarray, " n"], digits: int | None = None) -> str:
    """Median, and least to greatest in brackets; a dash for none, one number where all are alike."""
    if values.size == 0:
        return NOTHING
    low, middle, high = (float(one) for one in (values.min(), np.median(values), values.max()))
    texts = [number(one) if digits is None else f"{one:.{digits}f}".replace("-", "−") for one in (middle, low, high)]
    return texts[0] if texts[1] == texts[2] else f"{texts[0]} ({texts[1]} to {texts[2]})"


def legs(subject: Subject) -> list[dict[str, object]]:
    """The legs that the campaign's file gives its drive or its runs."""
    parameters = table(subject.run.configuration.get("parameters"))
    said = table(parameters.get("drive", parameters)).get("legs")
    return [dict(table(leg)) for leg in said] if isinstance(said, list | tuple) else []
