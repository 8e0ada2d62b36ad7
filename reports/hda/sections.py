"""Sections on landings in which conditions vary: threshold, faults, and errors of the elevation maps.

"The paper" is Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

import math
from dataclasses import replace

import numpy as np
import pandas as pd

from marsyard.reports import rates
from marsyard.reports.blocks import Quantity, Rate, condition_blocks, flag_rate, pooled_fraction, quantile_block
from marsyard.reports.column_values import numbers
from marsyard.reports.effects import scatter_block
from marsyard.reports.hda.landing_cases import PAPER, classify_answers, landing_rows
from marsyard.reports.outcomes_by_size import ExtraColumn, OutcomesBySize
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Section, Subject, create_section, drop_empty_columns, has_values
from marsyard.reports.statistics.drivers import MIN_CASES
from marsyard.reports.wording import NOTHING, count, format_fraction, note_text
from marsyard.scenarios.landing.parameters import LanderParameters

_THRESHOLD_RATES = (
    Rate("false_alarms", "False alarms", pooled_fraction("false_alarms", "footprints_truly_safe")),
    Rate("missed", "Missed", pooled_fraction("missed", "footprints_not_safe")),
    Rate(
        "called_safe_unsafe",
        "Classified as safe, not truly safe",
        pooled_fraction("footprints_called_safe_unsafe", "footprints_called_safe"),
    ),
    Rate(
        "site_reported",
        "Site reported, if a wide safe site exists",
        flag_rate("site_reported", "wide_site_exists"),
        in_figure=False,
    ),
    Rate("safe", "Sites truly safe", flag_rate("site_safe", "site_reported"), in_figure=False),
)


def threshold_section(subject: Subject) -> Section | None:
    """Create the section on false alarms and misses by threshold, to check the paper's remark on false positives."""
    frame = landing_rows(subject)
    if frame is None or not has_values(frame, "false_alarms"):
        return None
    n_unsafe = numbers(frame, "footprints") - numbers(frame, "footprints_truly_safe")
    limit = subject.run.parameter("lander", "max_roughness_m")
    limit_m = float(limit) if isinstance(limit, int | float) else LanderParameters().max_roughness_m
    blocks = condition_blocks(
        frame.assign(footprints_not_safe=n_unsafe),
        "threshold",
        Quantity("max_roughness_m", "Roughness threshold (m)"),
        _THRESHOLD_RATES,
        cases="Flights",
        ylabel="fraction of footprints",
        text=note_text("hda.threshold_text"),
        note=note_text("hda.threshold"),
        caption=f"Bars are {format_fraction(CONFIDENCE)} intervals.",
        limit=("the lander's limit", limit_m),
        data="thresholds",
    )
    return create_section("threshold", "Threshold", "False alarms and misses by roughness threshold", *blocks)


def _describe_fault(fault: str, size: float) -> tuple[str, str]:
    """Return the name of a fault, and its size with the unit; the size is empty if it is NaN, or without a unit."""
    description = PAPER["fault_names"].get(fault, {"name": fault.replace("_", " "), "unit": "number"})
    name, unit = description["name"], description.get("unit")
    if unit is None or math.isnan(size):
        return name, ""
    if unit == "fraction":
        return name, f"{100.0 * size:g} %"
    return name, f"{size:g}" if unit == "number" else f"{size:g} {unit}"


def _median(frame: pd.DataFrame, column: str) -> float:
    return rates.quantile(rates.finite_values(frame, column), 0.5)


def _two_decimals(value: float) -> str:
    return NOTHING if math.isnan(value) else f"{value:.2f}"


#: Outcomes in the order of the bars, of which the last has an interval. Unfinished flights count, but have no bar.
FAULT_OUTCOMES = OutcomesBySize(
    outcomes=classify_answers,
    styles={
        "safe": ("safe site", "full"),
        "refused": ("no safe site", "hatched"),
        "unconverged": ("not converged", "dotted"),
        "wrong": ("unsafe site", "crossed"),
    },
    cases="Flights",
    wording=_describe_fault,
    extra_columns=(
        ExtraColumn("Touchdown error (m)", "off_m", lambda rows: _median(rows, "touchdown_error_m"), _two_decimals),
        ExtraColumn("Sink rate (m/s)", "sink_m_s", lambda rows: _median(rows, "touchdown_sink_m_s"), _two_decimals),
    ),
)


def faults_section(subject: Subject) -> Section | None:
    """Create the section on answers by fault and size; None without faults."""
    frame = landing_rows(subject)
    caption = "Fraction of flights by answer, for each fault and size."
    blocks = (
        []
        if frame is None
        else FAULT_OUTCOMES.blocks(
            frame, "landingfaults", caption, note_text("hda.faults", confidence=format_fraction(CONFIDENCE))
        )
    )
    return create_section("landing-faults", "Faults", "Faults by size", *blocks)


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
        frame, MAP_ERRORS, _QUANTILES, "Errors of the maps", note_text("hda.map_errors", maps=count(len(frame), "map"))
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
