"""Rows of landing cases, with the paper's values and the note that their sections share.

The paper is Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

from pathlib import Path

import pandas as pd

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
