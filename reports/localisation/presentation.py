"""Presentation of localisation on a map: report sections, view of a case, and cause of an error."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.figure import Figure

from marsyard.algorithms.localisation.interface import PositionOutcome
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
from marsyard.reports.column_values import numbers, to_float
from marsyard.reports.effects import scatter_block
from marsyard.reports.figure_style import INK, MUTED, REQUIREMENT, SERIES, in_page_style
from marsyard.reports.images import Mark, Panel, draw_panels
from marsyard.reports.presentation import AnswerFlags, CaseFigure, CaseKind, CaseView, Cause, Presentation, TableRow
from marsyard.reports.products import Products, array_of_shape, read_arrays, to_matrix
from marsyard.reports.rates import CaseFraction, fraction_of
from marsyard.reports.section import Section, Subject, create_section, has_values
from marsyard.reports.wording import number

#: Maximum position error of a correct fix, and error of the published coarse stage, metres.
_MAX_POSITION_ERROR_M, _MAX_COARSE_ERROR_M = 40.0, 200.0


def _compute_coarse_rate(frame: pd.DataFrame) -> CaseFraction:
    """Return the fraction of descents with a correct coarse position; of no descent without a coarse stage."""
    errors_m = numbers(frame, "coarse_error_m")
    rows = frame if np.isfinite(errors_m).any() else frame[:0]
    return fraction_of(numbers(rows, "coarse_error_m") <= _MAX_COARSE_ERROR_M, rows)


_COARSE = Rate("coarse", f"Coarse position within {_MAX_COARSE_ERROR_M:g} m", _compute_coarse_rate)
_FIXED_IN_TIME = Rate("fixed_in_time", "Last answer within 10 s is a position", flag_rate("fixed_in_time"))
_FALSE_FIX = Rate(
    "false_fix", f"A reported position is wrong by more than {_MAX_POSITION_ERROR_M:g} m", flag_rate("false_fix")
)
_QUANTITIES = (
    Quantity("coarse_error_m", "horizontal error of the coarse position (m)"),
    Quantity("position_error_at_10_s_m", "horizontal position error of the last answer within 10 s (m)"),
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
    Quantity("position_error_at_10_s_m", "last answer within 10 s"),
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


def light_section(subject: Subject) -> Section | None:
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


#: Enlargement of the landmarks' residuals in the figure.
_RESIDUAL_SCALE = 20.0


class Track(NamedTuple):
    """Estimates after each image and at the end of a case; NaN for a refusal.

    - times_s: times after the start
    - errors_m, deviations_m: position errors (east, north, up), and the standard deviations that the algorithm reports
    """

    times_s: Float[np.ndarray, " n"]
    errors_m: Float[np.ndarray, "n 3"]
    deviations_m: Float[np.ndarray, "n 3"]


def is_localisation_case(products: Products) -> bool:
    """Return whether products contain the track of a localisation case and its map, with the outcomes of the track."""
    shapes = {"track": ("n", 7), "inliers": ("n",), "true_xy_m": (None, 2), "estimated_xy_m": (None, 2)}
    arrays = read_arrays(products, shapes)
    extent = read_arrays(products, {"map_extent_m": (4,)}, finite=True)
    if arrays is None or extent is None or to_matrix(products.get("map")) is None:
        return False
    outcomes = products.get("outcomes")
    names = [str(name) for name in outcomes] if isinstance(outcomes, list | tuple | np.ndarray) else []
    return len(arrays[0]) == len(names) and set(names) <= set(PositionOutcome.__members__)


def read_track(products: Products) -> Track:
    """Read the track of a localisation case."""
    times_s, errors_m, deviations_m = np.split(np.asarray(products["track"], dtype=np.float64), (1, 4), axis=1)
    return Track(times_s[:, 0], errors_m, deviations_m)


@in_page_style
def draw_errors(products: Products) -> Figure:
    """Draw the position error of each component over time, with bands of three standard deviations."""
    track = read_track(products)
    times_s, errors_m, deviations_m = (values[np.isfinite(track.times_s)] for values in track)
    figure = Figure(figsize=(12.0, 3.2), layout="constrained")
    for component, (name, axes) in enumerate(zip(("east", "north", "up"), figure.subplots(1, 3), strict=True)):
        band = 3.0 * deviations_m[:, component]
        axes.fill_between(times_s, -band, band, color=MUTED, alpha=0.25, linewidth=0.0)
        axes.axhline(0.0, color=INK, linewidth=0.8)
        axes.plot(times_s, errors_m[:, component], marker="o", color=SERIES[component])
        axes.set(xlabel="Time after the start (s)", ylabel=f"Position error {name} (m)")
    return figure


@in_page_style
def draw_map(products: Products) -> Figure:
    """Draw the map with true and estimated positions."""
    figure = Figure(figsize=(6.0, 6.0), layout="constrained")
    axes = figure.add_subplot()
    extent = np.asarray(products["map_extent_m"], dtype=np.float64) / 1e3
    axes.imshow(products["map"], cmap="gray", origin="lower", extent=tuple(extent), interpolation="antialiased")
    true, estimated = (np.asarray(products[name], dtype=np.float64) / 1e3 for name in ("true_xy_m", "estimated_xy_m"))
    initial = array_of_shape(products.get("initial_xy_m"), 2)
    if initial is not None:
        axes.plot(*initial / 1e3, marker="X", color=SERIES[3], linestyle="none", markersize=9.0, label="initial")
    axes.plot(*true.T, color=SERIES[0], linewidth=3.0, label="true")
    axes.plot(*estimated.T, marker="o", color=SERIES[1], linestyle="none", markersize=4.0, label="estimated")
    axes.set(xlabel="East (km)", ylabel="North (km)")
    axes.grid(visible=False)
    axes.legend(frameon=True, facecolor="white", framealpha=1.0, labelcolor="black")
    return figure


def draw_landmarks(products: Products) -> Figure | None:
    """Draw the last image with its landmarks and their residuals; None without landmarks."""
    shapes = {"landmarks_px": ("n", 2), "landmarks_residual_px": ("n", 2), "landmarks_used": ("n",)}
    arrays, image = read_arrays(products, shapes), to_matrix(products.get("image_2"))
    if arrays is None or image is None:
        return None
    pixels, residuals, flags = arrays
    used = flags > 0.5
    marks = []
    for mask, colour, marker in ((used, SERIES[2], "o"), (~used, REQUIREMENT, "x")):
        style = {"marker": marker, "linestyle": "none", "markersize": 4.0, "fillstyle": "none"}
        segments = np.stack([pixels[mask], pixels[mask] + _RESIDUAL_SCALE * residuals[mask]])
        marks += [Mark(pixels[mask], style | {"color": colour}), Mark(segments, {"color": colour, "linewidth": 0.8})]
    return draw_panels([[Panel(image, marks=marks)]], (6.0, 6.0))


_LEGEND = "The blue line is the true position; the bands are three standard deviations that the algorithm reports."


def view(products: Products, _complete: bool = False) -> CaseView:
    """Create the view of a localisation case: error over time, map, landmarks, and a table of the estimates."""
    drawn = [
        CaseFigure("errors", draw_errors(products), "Position error over time."),
        CaseFigure("map", draw_map(products), "True and estimated positions on the map.", wide=False),
    ]
    landmarks = draw_landmarks(products)
    if landmarks is not None:
        caption = "Landmarks in the last image: used (green), rejected (red); residuals enlarged twenty times."
        drawn.append(CaseFigure("landmarks", landmarks, caption, wide=False))
    rows = []
    track, outcomes, inliers = read_track(products), products["outcomes"], products["inliers"]
    for index, outcome in enumerate(outcomes):
        is_valid = bool(np.isfinite(track.times_s[index]))
        name = f"image {index + 1}" if index < len(outcomes) - 1 else "end"
        used = "" if not np.isfinite(inliers[index]) else f"{inliers[index]:.0f}"
        text = PositionOutcome[str(outcome)].value
        deviation_east_m, deviation_north_m, _ = track.deviations_m[index]
        lengths = (*track.errors_m[index], np.hypot(deviation_east_m, deviation_north_m))
        texts = [number(float(length)) if is_valid else "" for length in lengths]
        rows.append(TableRow([name, text, used, *texts], is_valid))
    head = ["Estimate", "Outcome", "Landmarks used", "Error east (m)", "north (m)", "up (m)", "Reported sd (m)"]
    return CaseView(drawn, head=head, rows=rows)


#: Number of inliers of an image below which landmarks are named as the cause.
_MIN_INLIERS = 15


def explain(row: Mapping[str, Any], metric: str) -> Cause | None:
    """Return the cause of a wrong or missing position: few or biased landmarks, with the difference of the suns."""
    if "position_error" not in metric and metric != "fixed_in_time":
        return None
    inliers, suns_deg = to_float(row.get("inliers_median")), to_float(row.get("sun_difference_deg"))
    # without a landmark, the number is NaN
    name = "biased landmarks" if inliers >= _MIN_INLIERS else "few landmarks"
    text = "no landmarks matched" if math.isnan(inliers) else f"{inliers:.0f} landmarks per image (median)"
    return Cause(name, f"{text}, suns of map and image differ by {number(suns_deg)} deg")


LOCALISATION = Presentation(
    cases=(CaseKind(is_localisation_case, view, _LEGEND),),
    first=(position_section,),
    sections=(light_section,),
    outcomes=(PositionOutcome,),
    answer_flags=AnswerFlags(reported="position_reported", wrong="false_fix"),
    explain=explain,
)
