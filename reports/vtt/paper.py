"""Numbers of the paper, and the campaigns that repeat its runs.

The paper is Kim et al., "Targeted Driving Using Visual Tracking".
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from marsyard.reports.papers import read_paper
from marsyard.reports.section import Subject
from marsyard.reports.stored import table

PAPER_FILE = Path(__file__).with_name("paper.toml")
PAPER = read_paper(PAPER_FILE)
#: Campaigns of Tables II and III, and of the regression runs.
TERRAINS, CHECKOUT_1, CHECKOUT_3, REGRESSION = "vtt-terrains", "vtt-checkout-1", "vtt-checkout-3", "vtt-regression"


def read_legs(subject: Subject) -> list[Mapping[str, Any]]:
    """Read the legs of the drive (approach or turn, for example) from the campaign's parameters."""
    drive = subject.run.parameter("drive")
    leg_table = table(drive).get("legs") if drive is not None else subject.run.parameter("legs")
    return [table(leg) for leg in leg_table] if isinstance(leg_table, list | tuple) else []
