"""Rows of landing cases and the outcomes of their search, with the paper's values and the note of all sections.

The paper is Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool

from marsyard.reports import populations
from marsyard.reports.papers import read_paper
from marsyard.reports.section import Subject

PAPER = read_paper(Path(__file__).with_name("paper.toml"))
#: Columns by which rows of landing cases are recognized.
_REQUIRED_COLUMNS = ("site_safe", "site_reported", "no_site_reported", "true_safe_fraction")
#: Meaning of the intervals of fractions of flights.
INTERVAL_NOTE = (
    "The intervals are two-sided Clopper-Pearson intervals, corrected for flights on shared terrains. They are wider "
    "than the one-sided bounds of the section Verdict at the same confidence."
)


def landing_rows(subject: Subject) -> pd.DataFrame | None:
    """Return the rows if they are those of landing cases; None for other rows."""
    frame = subject.frame
    return frame if all(name in frame for name in _REQUIRED_COLUMNS) and len(frame) > 0 else None


class Answer(NamedTuple):
    """An outcome of the search: its name in `report.json`, and the heading of its column."""

    name: str
    heading: str


#: Outcomes of the search for a site, by key of `classify_answers`, in the order of columns.
ANSWERS: Mapping[str, Answer] = {
    "safe": Answer("truly safe site", "safe site reported"),
    "wrong": Answer("unsafe site", "unsafe site reported"),
    "refused": Answer("'no safe site'", "'no safe site'"),
    # the case finished, but the algorithm reported neither a site nor that no site is safe
    "unconverged": Answer("not converged", "not converged"),
    # every case that did not finish, not only crashes
    "unfinished": Answer("crashed", "crashed"),
}


def classify_answers(frame: pd.DataFrame) -> dict[str, Bool[np.ndarray, " n"]]:
    """Create a mask for each key of `ANSWERS`; each row has exactly one outcome."""
    is_reported, is_safe, is_refused = (
        populations.flag_mask(frame, name) for name in ("site_reported", "site_safe", "no_site_reported")
    )
    is_finished = frame["site_reported"].notna().to_numpy(dtype=np.bool_)
    return {
        "safe": is_reported & is_safe,
        "wrong": is_reported & ~is_safe,
        "refused": is_refused,
        "unconverged": is_finished & ~is_reported & ~is_refused,
        "unfinished": ~is_finished,
    }
