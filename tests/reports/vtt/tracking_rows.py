"""Synthetic rows and products of tracking cases."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from marsyard.reports.section import Block, Section, Subject
from tests.reports import synthetic_run


def make_rows(cases: int, **columns: Any) -> pd.DataFrame:
    """Return completed runs from 10 m to 2 m that track selectable targets; `columns` replaces default values."""
    defaults: dict[str, Any] = {
        "case": np.arange(cases),
        "outcome": "COMPLETED",
        **dict.fromkeys(("answered", "tracked", "target_held", "no_false_track", "selectable", "clear_sky"), True),
        **dict.fromkeys(("not_tracked", "stuck", "visual_odometry", "autonav"), False),
        "position_error_m": 0.004,
        "range_error_m": 0.003,
        "cross_error_m": 0.002,
        "drift_px": 2.0,
        "losses": "none",
        "lost_range_m": np.nan,
        "camera": "research-navcam",
        "incline": "flat ground",
        "azimuth_change_max_deg": 3.0,
        "slip_max": 0.1,
        "range_start_m": 10.0,
        "range_end_m": 2.0,
        "designation_error_m": 0.1,
        "designation_3_sigma_m": 0.388,
        "pose_error_m": 0.05,
        "autonav_updates": 0,
        "rock_height_m": 0.4,
    }
    return pd.DataFrame(defaults | columns, index=range(cases))


def make_subject(
    frame: pd.DataFrame, name: str = "a-campaign", legs: Sequence[Mapping[str, Any]] | None = None
) -> Subject:
    """Return the subject of a report on these rows, for a campaign with this name and these legs of the drive."""
    parameters = {"drive": {"legs": legs}} if legs else {}
    definition = {"parameters": parameters}
    return synthetic_run.make_subject(frame, "position_error_m", 0.03, name=name, definition=definition)


def set_values(frame: pd.DataFrame, index: int, **values: Any) -> None:
    """Set values of one row."""
    for name, value in values.items():
        frame.loc[index, name] = value


def read_table(section: Section | None, block: int = 0) -> list[dict[str, str]]:
    """Return the rows of a section's table number `block` as dictionaries from heading to cell."""
    blocks = [entry for entry in section.blocks if isinstance(entry, Block)]
    grids = [entry.grid for entry in blocks if entry.grid is not None]
    return [dict(zip(grids[block].head, row, strict=True)) for row in grids[block].rows]


def make_products(stops: int = 3) -> dict[str, Any]:
    """Return products of a case that loses the target at the last stop.

    Left subframes of 161 px have their corner at pixel (400, 300); the target is at pixel (80, 70) of the subframe.
    """
    rng = np.random.default_rng(3)
    case_products: dict[str, Any] = {"template_px": 21}
    for number in range(1, stops + 1):
        is_lost = number == stops
        case_products[f"stop_{number}_left"] = rng.integers(500, 3000, (161, 161)).astype(np.uint16)
        case_products[f"stop_{number}_right"] = rng.integers(500, 3000, (105, 161)).astype(np.uint16)
        case_products[f"stop_{number}_corners"] = np.array([[400.0, 300.0], [380.0, 302.0]])
        case_products[f"stop_{number}_window"] = np.array([410.0, 310.0, 141.0, 141.0])
        case_products[f"stop_{number}_matches"] = (
            np.full((2, 2), np.nan) if is_lost else np.array([[480.0, 370.0], [450.0, 371.0]])
        )
        case_products[f"stop_{number}_point"] = np.array([481.5, 369.0])
    east = np.linspace(0.0, 8.0, stops)
    rover = np.column_stack([east, np.zeros(stops), np.zeros(stops)])
    target_estimates = np.full((stops, 3), np.nan)
    target_estimates[:-1] = np.column_stack(
        [10.0 + 0.03 * np.arange(stops - 1), np.zeros(stops - 1), np.zeros(stops - 1)]
    )
    return case_products | {
        "figures": {
            "range_m": 10.0 - east,
            "azimuth_deg": np.full(stops, -0.04),
            "match_score": np.array([np.nan] + [0.9] * (stops - 1)),
        },
        "states": ["NORMAL"] * (stops - 1) + ["LOST"],
        "rover_true_m": rover,
        "rover_estimated_m": rover + 0.05,
        "heading_deg": np.full(stops, 90.0),
        "target_m": np.array([10.0, 0.0, 0.2]),
        "target_estimated_m": target_estimates,
        "path_true_m": rover[:, :2],
        "rocks_m": np.array([[10.1, 0.0, 0.4]]),
    }
