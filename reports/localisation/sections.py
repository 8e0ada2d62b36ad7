"""Sections on the position on the map, and on the influence of light and texture."""

import numpy as np
import pandas as pd

from marsyard.reports.blocks import (
    Quantity,
    Rate,
    collect_values,
    condition_blocks,
    distribution_block,
    flag_rate,
    quantile_block,
    rate_block,
)
from marsyard.reports.column_values import numbers
from marsyard.reports.effects import scatter_block
from marsyard.reports.rates import CaseFraction, fraction_of
from marsyard.reports.section import Section, Subject, create_section, has_values

#: Required position error: the bound of a false fix.
_MAX_POSITION_ERROR_M = 40.0
_FIXED_IN_TIME = Rate("fixed_in_time", "Position reported within 10 s", flag_rate("fixed_in_time"))
#: Error of the published coarse stage, m.
_MAX_COARSE_ERROR_M = 200.0


def _compute_coarse_rate(frame: pd.DataFrame) -> CaseFraction:
    """Return the fraction of descents with a correct coarse position; of no descent without a coarse stage."""
    errors_m = numbers(frame, "coarse_error_m")
    rows = frame if np.isfinite(errors_m).any() else frame[:0]
    return fraction_of(numbers(rows, "coarse_error_m") <= _MAX_COARSE_ERROR_M, rows)


_COARSE = Rate("coarse", "Coarse position within 200 m", _compute_coarse_rate)
_FALSE_FIX = Rate("false_fix", "A reported position is wrong by more than 40 m", flag_rate("false_fix"))
_QUANTITIES = (
    Quantity("coarse_error_m", "horizontal error of the coarse position (m)"),
    Quantity("position_error_at_10_s_m", "horizontal position error after 10 s (m)"),
    Quantity("position_error_m", "last horizontal position error (m)"),
    Quantity("position_error_up_m", "last error of the height (m)"),
    Quantity("velocity_error_m_s", "last velocity error (m/s)"),
    Quantity("attitude_error_deg", "last attitude error (deg)"),
    Quantity("fix_after_s", "time of the first reported position (s)"),
    Quantity("inliers_median", "landmarks used in an image (median)"),
    Quantity("inliers_min", "landmarks used in an image (minimum)"),
    Quantity("image_time_max_s", "processor time of the slowest image (s)"),
    Quantity("image_time_median_s", "processor time of an image (s, median)"),
)
_ERRORS = (
    Quantity("position_error_at_10_s_m", "after 10 s"),
    Quantity("position_error_m", "last"),
    Quantity("position_error_world_m", "last, relative to the world"),
)


def position_section(subject: Subject) -> Section | None:
    """Create the section on the position on the map; None for cases of another system."""
    frame = subject.frame
    if not has_values(frame, "fixed_in_time"):
        return None
    rates_by_name = {rate.name: rate.compute(frame) for rate in (_COARSE, _FIXED_IN_TIME, _FALSE_FIX)}
    distribution = distribution_block(
        "localisation",
        collect_values(frame, _ERRORS),
        ("horizontal position error (m)", "fraction of reported positions"),
        "Cumulative distribution of the horizontal position error. The error relative to the world contains the map's "
        "registration and distortion.",
        "Position error",
        bound=_MAX_POSITION_ERROR_M,
    )
    return create_section(
        "localisation",
        "Localisation",
        "Position on the map",
        rate_block(rates_by_name, "Descents", "Positions"),
        distribution,
        quantile_block(frame, _QUANTITIES, {"5 %": 0.05, "Median": 0.5, "95 %": 0.95, "99 %": 0.99}, "Distributions"),
    )


def conditions_section(subject: Subject) -> Section | None:
    """Create the section on light and texture; None for cases of another system."""
    frame = subject.frame
    if not has_values(frame, "sun_difference_deg", "fixed_in_time"):
        return None
    blocks = condition_blocks(
        frame,
        "suns",
        Quantity("sun_difference_deg", "Angle between the suns of map and landing (deg)"),
        (_COARSE, _FIXED_IN_TIME, Rate("answered", "Position reported at the end", flag_rate("answered"))),
        cases="Descents",
        ylabel="fraction of descents",
        caption="Descents with a reported position against the angle between the suns of map and landing.",
    )
    conditions = (
        Quantity("sun_difference_deg", "angle between the suns (deg)"),
        Quantity("image_contrast", "contrast of the first image"),
        Quantity("initial_error_m", "initial position error (m)"),
    )
    responses = (
        Quantity("position_error_m", "last horizontal position error (m)"),
        Quantity("inliers_median", "landmarks used in an image"),
    )
    caption = "Position error and number of landmarks against the conditions."
    causes = scatter_block(frame, "causes", conditions, responses, caption, "Causes")
    return create_section("localisation-conditions", "Light", "Light and texture", *blocks, causes)
