"""Section on the errors of the elevation maps."""

from dataclasses import replace

import numpy as np
import pandas as pd

from marsyard.reports import rates
from marsyard.reports.blocks import Quantity, quantile_block
from marsyard.reports.column_values import numbers
from marsyard.reports.effects import scatter_block
from marsyard.reports.empty_cells import drop_empty_columns
from marsyard.reports.hda.landing_cases import landing_rows
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Section, Subject, create_section
from marsyard.reports.statistics.drivers import MIN_CASES
from marsyard.reports.wording import count, format_fraction

#: Minimum number of cases with a map for the section on map errors.
MIN_MAPS = 8


def map_rows(subject: Subject) -> pd.DataFrame | None:
    """Select cases with a map, and add errors relative to height and range.

    Returns None for fewer than `MIN_MAPS` maps, or if texture or baseline do not vary.
    """
    frame = landing_rows(subject)
    if frame is None or not (rates.varies(frame, "texture") and rates.varies(frame, "baseline_fraction")):
        return None
    fractions = {
        "rms_fraction": numbers(frame, "elevation_rms_m") / numbers(frame, "height_m"),
        "noise_fraction": numbers(frame, "elevation_noise_m") / numbers(frame, "height_m"),
        "altimeter_fraction": np.abs(numbers(frame, "range_error_m")) / numbers(frame, "range_m"),
    }
    rows_with_map = pd.DataFrame(frame.assign(**fractions)[np.isfinite(fractions["rms_fraction"])])
    return rows_with_map if len(rows_with_map) >= MIN_MAPS else None


#: Errors of the map; columns of `map_rows`.
MAP_ERRORS = (
    Quantity("rms_fraction", "elevation error (% of height)", 100.0),
    Quantity("noise_fraction", "elevation noise (% of height)", 100.0),
    Quantity("slope_error_rms_deg", "slope error (deg)"),
)
_QUANTILES = {"Minimum": 0.0, "5 %": 0.05, "Median": 0.5, "95 %": 0.95, "Maximum": 1.0}
_MAP_NOTE = (
    "{maps}: one value per map. Elevation error: RMS difference between the map and the true mean height of each cell. "
    "It includes errors that shift, tilt or scale the whole map. Elevation noise: robust standard deviation "
    "(1.4826 × median absolute deviation) of this difference about its best-fit plane; it affects the roughness. Slope "
    "error: RMS difference between the slope in the map and the true slope of a lander footprint. Height: height above "
    "ground at the first image."
)
#: Conditions that may affect the map errors.
MAP_CONDITIONS = (
    Quantity("baseline_fraction", "baseline / height"),
    Quantity("texture", "texture contrast / nominal contrast"),
    Quantity("hda.grid_px", "grid spacing (px)"),
    Quantity("level_error_deg", "error of the estimated vertical (deg)"),
    Quantity("altimeter_fraction", "|altimeter error| (% of range)", 100.0),
)


def map_section(subject: Subject) -> Section | None:
    """Create the section on map errors, without quantiles and correlations that need more maps."""
    frame = map_rows(subject)
    if frame is None:
        return None
    errors = quantile_block(
        frame, MAP_ERRORS, _QUANTILES, "Errors of the maps", _MAP_NOTE.format(maps=count(len(frame), "map"))
    )
    if errors is not None and errors.grid is not None:
        errors = replace(errors, grid=drop_empty_columns(errors.grid), data={"maps": len(frame)})
    caption = "Each dot is a map. The vertical axes are logarithmic."
    note = f"Medians and rank correlations need {MIN_CASES} maps."
    has_statistics = len(frame) >= MIN_CASES
    if has_statistics:
        caption += " Lines are medians of bins with equal numbers of maps."
        note = f"Spearman's rank correlations, with their intervals at {format_fraction(CONFIDENCE)} confidence."
    note += " Baseline: horizontal distance between the cameras of both images."
    heading, style = "Dependence on conditions", {"logarithmic": True, "statistics": has_statistics}
    effects = scatter_block(frame, "maperrors", MAP_CONDITIONS, MAP_ERRORS, caption, heading, note, **style)
    return create_section("map-errors", "Map", "Errors of the elevation map", errors, effects)
