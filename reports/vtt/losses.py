"""Table of the runs that lost the target."""

import pandas as pd

from marsyard.algorithms.interface import TargetLoss
from marsyard.reports import populations, rates
from marsyard.reports.section import Grid
from marsyard.reports.wording import NOTHING


def losses_grid(frame: pd.DataFrame) -> Grid:
    """Count runs that ended without a tracked target, by outcome and loss criteria."""
    failed_runs = frame[~populations.flag_mask(frame, "tracked")]
    has_clouds = "clear_sky" in failed_runs and rates.flag_fraction(failed_runs, "clear_sky", value=False).hits > 0
    rows = []
    for (outcome, losses), runs in failed_runs.groupby([failed_runs["outcome"], failed_runs["losses"].fillna(NOTHING)]):
        azimuth = rates.finite_values(runs, "azimuth_change_max_deg")
        azimuth_text = f"{azimuth.max():.1f}" if azimuth.size else NOTHING
        distance_text = rates.median_text(rates.finite_values(runs, "lost_range_m"), 1)
        loss_text = str(losses).replace("_", " ").lower()
        row = [str(outcome), loss_text, f"{len(runs):,}", distance_text, azimuth_text]
        n_cloudy = rates.flag_fraction(runs, "clear_sky", value=False).hits if has_clouds else 0
        rows.append([*row, f"{n_cloudy:,}"] if has_clouds else row)
    rows.sort(key=lambda row: -int(row[2].replace(",", "")))
    head = ["Outcome", "Lost by", "Runs", "Lost at a range of (m)", "Maximum azimuth change (deg)"]
    return Grid([*head, "With clouds"] if has_clouds else head, rows)


def losses_note(frame: pd.DataFrame) -> str:
    """Describe the table of `losses_grid`, with the meaning of the loss criteria that occur."""
    occurring = ", ".join(frame.loc[~populations.flag_mask(frame, "tracked"), "losses"].dropna().astype(str)).split(
        ", "
    )
    meanings = [
        f"{loss.name.replace('_', ' ').capitalize()}: {loss.value}." for loss in TargetLoss if loss.name in occurring
    ]
    text = (
        'The runs ended without the target within 5 px of its true projection at the goal. "Lost by" gives the '
        "criteria (section 4.6 of the paper) of the first update that lost the target. Ranges are medians, with "
        "minimum to maximum in brackets. The azimuth change is that of the line of sight in the world between two "
        "updates with a match."
    )
    return " ".join([text, *meanings])
