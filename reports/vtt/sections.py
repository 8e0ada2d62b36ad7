"""Section on the single runs of the paper (Table IV), and the sections of visual target tracking in their order.

The paper is Kim et al., "Targeted Driving Using Visual Tracking".
"""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from marsyard.reports import rates
from marsyard.reports.column_values import numbers
from marsyard.reports.papers import paper_section
from marsyard.reports.section import Block, Grid, Section, Subject
from marsyard.reports.vtt.paper import CHECKOUT_3, PAPER, PAPER_FILE, read_legs
from marsyard.reports.vtt.regression_section import regression_section
from marsyard.reports.vtt.steps_section import steps_section
from marsyard.reports.vtt.table_1 import table_1_section
from marsyard.reports.vtt.terrains_section import terrains_section
from marsyard.reports.vtt.updates_section import updates_section
from marsyard.reports.wording import note_text


def table_4_grid(frame: pd.DataFrame, legs: Sequence[Mapping[str, Any]]) -> Grid:
    """Create Table IV: tracking updates and minutes of each operational mode; `legs` are the legs of the drive.

    The minutes of a mode end at its last update, and start at the end of the previous mode.
    """
    updates = [int(str(name).split("_")[1]) for name in frame.columns if re.match(r"^update_\d+_leg$", str(name))]
    update_legs = np.column_stack([numbers(frame, f"update_{update_number}_leg") for update_number in updates])
    update_minutes = (
        np.column_stack([numbers(frame, f"update_{update_number}_time_s") for update_number in updates]) / 60.0
    )
    leg_modes = [(str(leg.get("motion", "approach")), bool(leg.get("autonav"))) for leg in legs]
    leg_modes = [(motion, motion == "approach" and autonav) for motion, autonav in leg_modes]
    rows, previous_end = [], np.zeros(len(frame))
    for mode in PAPER["table_4"]:
        mode_legs = [
            index for index, leg in enumerate(leg_modes) if leg == (mode["motion"], mode.get("autonav", False))
        ]
        # the first update is at the start, before any leg; its leg is -1
        is_in_mode = np.isin(update_legs, [-1, *mode_legs] if mode.get("start") else mode_legs)
        is_reached = is_in_mode.any(axis=1)
        end = np.where(is_in_mode, update_minutes, -np.inf).max(axis=1)
        counts, minutes = is_in_mode.sum(axis=1).astype(np.float64), (end - previous_end)[is_reached]
        simulated_texts = (rates.median_text(counts[is_reached], 0), rates.median_text(minutes, 1))
        rows.append(
            [mode["name"], f"{mode['updates']}", simulated_texts[0], f"{mode['minutes']:g}", simulated_texts[1]]
        )
        previous_end = np.where(is_reached, end, previous_end)
    return Grid(["Mode", "Updates, paper", "Updates, ours", "Minutes, paper", "Minutes, ours"], rows)


def single_run_section(subject: Subject) -> Section | None:
    """Compare the paper's single runs with the campaigns that repeat them; None for other campaigns."""
    blocks = []
    if subject.run.name == CHECKOUT_3 and "update_1_leg" in subject.frame:
        grid = table_4_grid(subject.frame, read_legs(subject))
        blocks.append(Block(heading="By operational mode", grid=grid, note=note_text("vtt.table_4")))
    return paper_section(subject, PAPER_FILE, *blocks)


SECTIONS = (
    table_1_section, single_run_section, updates_section, steps_section, terrains_section, regression_section,
)  # fmt: skip
