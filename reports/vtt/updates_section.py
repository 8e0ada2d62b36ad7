"""Section on the updates of a tracking case (Table III).

The paper is Kim et al., "Targeted Driving Using Visual Tracking".
"""

import re

import numpy as np

from marsyard.reports import rates
from marsyard.reports.section import Block, Grid, Section, Subject
from marsyard.reports.vtt.paper import CHECKOUT_1, PAPER
from marsyard.reports.vtt.run_selection import is_tracking
from marsyard.reports.wording import NOTHING

#: Quantities of an update in the table: heading, suffix of the column `update_<number>_<suffix>`, digits.
QUANTITIES: tuple[tuple[str, str, int], ...] = (
    ("Range (m)", "range_m", 2), ("Magnification", "magnification", 2), ("Roll change (deg)", "roll_change_deg", 2),
    ("Azimuth change (deg)", "azimuth_change_deg", 2), ("NCC score", "match_score", 2),
    ("Stereo score", "stereo_score", 2), ("Correction (px)", "correction_px", 1),
    ("Tracking error (px)", "error_px", 1),
)  # fmt: skip
#: Definitions of the quantities of an update.
DEFINITIONS = (
    "Range: true distance from the left camera to the designated point. Magnification and roll change: change of the "
    "target's image since the last match, computed from the estimated motion of the rover. Roll is positive clockwise. "
    "Azimuth change: rotation of the line of sight in the world since the last match, positive to the right. NCC score "
    "and stereo score: normalised cross-correlation of the match in the left and in the right image; the maximum is 1. "
    "Correction: distance from the predicted to the matched position, the larger of columns and rows. Tracking error: "
    "distance from the match to the true projection of the designated point. A dash means that there is no value; at "
    "the first update, no match precedes."
)
_UPDATES_NOTE = "The values are medians over all cases that reached the update, with minimum to maximum in brackets."
_TABLE_3_NOTE = (
    'Rows "ours": median over all cases, with minimum to maximum in brackets. All values are without signs, as in the '
    "paper. Ranges are those of Fig. 15. Path and steps are the paper's. The paper does not specify rock, ground and "
    "light. A dash means that no value is printed, or that no match precedes."
)


def updates_section(subject: Subject) -> Section | None:
    """Create the section on the updates, with Table III for the first checkout; None if rows contain no updates."""
    frame = subject.frame
    matches = (re.match(r"^update_(\d+)_range_m$", str(name)) for name in frame.columns)
    updates = sorted(int(match[1]) for match in matches if match)
    if not is_tracking(frame) or not updates:
        return None
    suffixes = [suffix for _, suffix, _ in QUANTITIES]
    values = {
        update_number: {name: rates.finite_values(frame, f"update_{update_number}_{name}") for name in suffixes}
        for update_number in updates
    }
    rows = [
        [
            str(update_number),
            f"{update['range_m'].size:,}",
            *(rates.median_text(update[name], digits) for _, name, digits in QUANTITIES),
        ]
        for update_number, update in values.items()
        if update["range_m"].size
    ]
    grid = Grid(["Update", "Cases", *(heading for heading, _, _ in QUANTITIES)], rows)
    note = f"{_UPDATES_NOTE} {DEFINITIONS}"
    blocks, title = [Block(grid=grid, note=note)], "All updates"
    if subject.run.name == CHECKOUT_1:
        title = "Updates of the first checkout (Table III of the paper)"
        comparison_rows = []
        for heading, suffix, digits in QUANTITIES:
            printed_values = PAPER["table_3"].get(suffix)
            if printed_values is not None:
                paper = [
                    f"{printed_values[str(update_number)]:.{digits}f}"
                    if str(update_number) in printed_values
                    else NOTHING
                    for update_number in values
                ]
                simulated_texts = [rates.median_text(np.abs(update[suffix]), digits) for update in values.values()]
                comparison_rows += [[heading, "paper", *paper], [heading, "ours", *simulated_texts]]
        table_3 = Grid(
            ["Quantity", "Source", *(f"Update {update_number}" for update_number in values)], comparison_rows
        )
        blocks = [
            Block(heading="Comparison with the paper", grid=table_3, note=_TABLE_3_NOTE),
            Block(heading="All updates of Marsyard", grid=grid, note=note),
        ]
    data = {
        str(update_number): {name: values_of_update.tolist() for name, values_of_update in update.items()}
        for update_number, update in values.items()
    }
    return Section("updates", "Updates", title, blocks, {"updates": data})
