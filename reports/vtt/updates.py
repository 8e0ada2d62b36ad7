"""Every update's numbers over all cases: the tracking paper's Table III, where the campaign is its first checkout."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import pandas as pd

from marsyard.reports.section import Block, Section, Subject
from marsyard.reports.sections import Grid
from marsyard.reports.vtt.rows import is_tracking, known, spread_text
from marsyard.reports.wording import NOTHING

#: What the table tells of an update: its heading, the column's ending, digits.
QUANTITIES: tuple[tuple[str, str, int], ...] = (
    ("Distance (m)", "range_m", 2),
    ("Magnification", "magnification", 2),
    ("Roll change (deg)", "roll_change_deg", 2),
    ("Azimuth change (deg)", "azimuth_change_deg", 2),
    ("NCC score", "match_score", 2),
    ("Stereo score", "stereo_score", 2),
    ("Correction (px)", "correction_px", 1),
    ("Off by (px)", "error_px", 1),
)
#: Campaign whose updates are those of Table III, and the table as printed, by the column's ending, positions 2 to 8.
#: Distances are those of Fig. 15; the paper gives changes without a sign.
CHECKOUT_1 = "vtt-checkout-1"
TABLE_III: Mapping[str, Mapping[int, float]] = MappingProxyType(
    {
        "range_m": {1: 4.00, 3: 3.67, 5: 3.73, 8: 3.68},
        "magnification": dict(enumerate((1.04, 1.03, 1.03, 1.01, 1.00, 0.97, 1.04), start=2)),
        "roll_change_deg": dict(enumerate((2.46, 2.46, 2.92, 3.27, 3.27, 0.06, 6.25), start=2)),
        "azimuth_change_deg": dict(enumerate((6.01, 6.38, 8.53, 8.58, 8.62, 0.00, 15.44), start=2)),
        "match_score": dict(enumerate((0.88, 0.88, 0.85, 0.87, 0.87, 0.94, 0.79), start=2)),
    }
)
_COLUMN = re.compile(r"^update_(\d+)_range_m$")


def updates_section(subject: Subject) -> Section | None:
    """Numbers of every stored update; None where rows store none."""
    frame = subject.frame
    numbers = sorted(int(found[1]) for name in frame.columns if (found := _COLUMN.match(str(name))))
    if not is_tracking(frame) or not numbers:
        return None
    paper = TABLE_III if subject.run.name == CHECKOUT_1 else {}
    note = (
        "Of all cases that came so far: median, and least to greatest in brackets. Changes are since the update "
        "before; roll and azimuth with their sign. Correction: the larger of row and column, found less predicted. "
        "Off by: found less true."
    )
    blocks = [Block(grid=_grid(frame, numbers), note=note)]
    title = "Updates one by one"
    if paper:
        title = "Table III: the first checkout's updates"
        blocks.insert(0, Block(heading="Beside the paper's", grid=paper_grid(frame, numbers), note=_PAPER_NOTE))
        blocks[1] = Block(heading="All of ours", grid=blocks[1].grid, note=note)
    data: dict[str, Any] = {
        str(n): {ending: known(frame, f"update_{n}_{ending}").tolist() for _, ending, _ in QUANTITIES} for n in numbers
    }
    return Section("updates", "Updates", title, blocks, {"updates": data})


_PAPER_NOTE = (
    "The paper's number, then ours: the median, and least to greatest in brackets, without their signs, as the paper "
    "prints them. Distances are those that Fig. 15 states. Path and steps are the paper's; rock, ground and light are "
    "not known from it."
)


def paper_grid(frame: pd.DataFrame, numbers: Sequence[int]) -> Grid:
    """Table III, a row for each quantity and whose it is, a column for each rover position."""
    rows = []
    for heading, ending, digits in QUANTITIES:
        if ending not in TABLE_III:
            continue
        printed = TABLE_III[ending]
        paper = [f"{printed[n]:.{digits}f}" if n in printed else NOTHING for n in numbers]
        ours = [spread_text(abs(known(frame, f"update_{n}_{ending}")), digits) for n in numbers]
        rows += [[heading, "paper", *paper], ["", "ours", *ours]]
    return Grid(["Parameter", "Rover position", *(str(n) for n in numbers)], rows)


def _grid(frame: pd.DataFrame, numbers: Sequence[int]) -> Grid:
    rows = []
    for n in numbers:
        of_each = [(known(frame, f"update_{n}_{ending}"), digits) for _, ending, digits in QUANTITIES]
        if of_each[0][0].size:
            texts = (spread_text(values, digits) for values, digits in of_each)
            rows.append([str(n), f"{of_each[0][0].size:,}", *texts])
    return Grid(["Update", "Cases", *(heading for heading, _, _ in QUANTITIES)], rows)
