"""Section on the regression runs of the paper.

The paper is Kim et al., "Targeted Driving Using Visual Tracking".
"""

import numpy as np
import pandas as pd

from marsyard.reports import rates
from marsyard.reports.column_values import numbers
from marsyard.reports.section import Block, Section, Subject, build_grid
from marsyard.reports.vtt.losses import losses_grid, losses_note
from marsyard.reports.vtt.paper import REGRESSION
from marsyard.reports.vtt.run_selection import is_closed_loop

#: Maximum height of a small rock (section 6), metres.
MAX_SMALL_ROCK_M = 0.1


def regression_section(subject: Subject) -> Section | None:
    """Create the section on the regression runs (section 6); None for other campaigns."""
    frame = subject.frame
    if subject.run.name != REGRESSION or not is_closed_loop(frame) or "visual_odometry" not in frame:
        return None
    map_source = frame["map_by"] if "map_by" in frame else pd.Series("none", index=frame.index)
    driving_text = [
        f"Autonav by {cameras} cameras{', visual odometry' * bool(odometry)}"
        if autonav
        else ("visual odometry" if odometry else "blind")
        for autonav, odometry, cameras in zip(frame["autonav"], frame["visual_odometry"], map_source, strict=True)
    ]
    rows_with_labels = frame.assign(
        driving=driving_text, rock=np.where(numbers(frame, "rock_height_m") <= MAX_SMALL_ROCK_M, "small", "large")
    )
    grid = build_grid(
        list(rows_with_labels.groupby(["driving", "rock", "incline"], sort=True)),
        {
            "Driving": lambda group: str(group[0][0]),
            "Rock": lambda group: str(group[0][1]),
            "Ground": lambda group: str(group[0][2]),
            "Runs": lambda group: f"{len(group[1]):,}",
            "Tracked to the goal": lambda group: rates.fraction_text(rates.flag_fraction(group[1], "tracked")),
            "Outcomes": lambda group: ", ".join(sorted(str(outcome) for outcome in group[1]["outcome"].unique())),
            "Position error (cm)": lambda group: rates.median_text(
                rates.finite_values(group[1], "position_error_m", 100.0), 2
            ),
            "Drift (px)": lambda group: rates.median_text(rates.finite_values(group[1], "drift_px"), 1),
            "Navigation updates": lambda group: rates.median_text(rates.finite_values(group[1], "autonav_updates"), 0),
        },
    )
    note = (
        "According to the paper, all 14 runs were successful. Small rocks are at most 10 cm high. Position error "
        "(rover frame) and drift are those at the goal. Drift: distance from the match to the true projection. The "
        "last three columns are medians, with minimum to maximum in brackets."
    )
    blocks, loss_grid = [Block(grid=grid, note=note)], losses_grid(frame)
    if loss_grid.rows:
        note = losses_note(frame)
        blocks.append(Block(heading="Runs that lost the target", grid=loss_grid, note=note))
    data = {"tracked": rates.flag_fraction(frame, "tracked")}
    return Section("regression", "Regression", "Regression runs on the engineering model", blocks, data)
