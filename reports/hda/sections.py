"""Sections on landings: roughness threshold, faults, map errors, and sites.

Figures and "the paper" refer to Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from marsyard.reports import rates
from marsyard.reports.blocks import (
    OutcomesBySize,
    Quantity,
    Rate,
    condition_blocks,
    flag_rate,
    pooled_fraction,
    quantile_block,
    scatter_block,
)
from marsyard.reports.column_values import numbers
from marsyard.reports.papers import read_paper
from marsyard.reports.plots import cumulative_figure
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Block, Grid, Section, Subject, create_section, has_values, svg_figure
from marsyard.reports.statistics.drivers import MIN_CASES
from marsyard.reports.statistics.samples import is_interpolated, quantile_bounds
from marsyard.reports.wording import NOTHING, count, format_fraction, number
from marsyard.scenarios.landing.parameters import LanderParameters

PAPER = read_paper(Path(__file__).with_name("paper.toml"))
#: Columns by which rows of landing cases are recognized.
_REQUIRED_COLUMNS = ("site_safe", "site_reported", "no_site_reported", "true_safe_fraction")
#: Minimum number of cases with a map for the section on map errors.
MIN_MAPS = 8
#: Minimum number of values for a cumulative curve.
MIN_CURVE_VALUES = 5
#: Meaning of the intervals of fractions of flights.
INTERVAL_NOTE = (
    "The intervals are two-sided Clopper-Pearson intervals, corrected for flights on shared terrains. They are wider "
    "than the one-sided bounds of the section Verdict at the same confidence."
)


def landing_rows(subject: Subject) -> pd.DataFrame | None:
    """Return the rows if they are those of landing cases; None for other rows."""
    frame = subject.frame
    return frame if all(name in frame for name in _REQUIRED_COLUMNS) and len(frame) > 0 else None


def drop_empty_columns(grid: Grid) -> Grid:
    """Remove the columns after the first that contain only dashes."""
    kept = [0, *(index for index in range(1, len(grid.head)) if any(row[index] != NOTHING for row in grid.rows))]
    return replace(
        grid, head=[grid.head[index] for index in kept], rows=[[row[index] for index in kept] for row in grid.rows]
    )


def _lander_limit_m(subject: Subject) -> float:
    """Return the roughness limit of the campaign's lander, or the default limit."""
    limit = subject.run.parameter("lander", "max_roughness_m")
    return float(limit) if isinstance(limit, int | float) else LanderParameters().max_roughness_m


def threshold_section(subject: Subject) -> Section | None:
    """Create the section on false alarms and misses by threshold, to check the paper's remark on false positives."""
    frame = landing_rows(subject)
    if frame is None or not has_values(frame, "false_alarms"):
        return None
    n_unsafe = numbers(frame, "footprints") - numbers(frame, "footprints_truly_safe")
    blocks = condition_blocks(
        frame.assign(footprints_not_safe=n_unsafe),
        "threshold",
        Quantity("max_roughness_m", "Roughness threshold (m)"),
        _THRESHOLD_RATES,
        cases="Flights",
        ylabel="fraction of footprints",
        text=_THRESHOLD_TEXT,
        note=_THRESHOLD_NOTE,
        caption=f"Bars are {format_fraction(CONFIDENCE)} intervals.",
        limit=("the lander's limit", _lander_limit_m(subject)),
        data="thresholds",
    )
    return create_section("threshold", "Threshold", "False alarms and misses by roughness threshold", *blocks)


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
_THRESHOLD_TEXT = (
    "According to the paper, both results of its Fig. 7 contain false positive hazards. The causes are a low roughness "
    "threshold and noise of the map. A higher threshold would remove them. The paper gives no numbers."
)
_THRESHOLD_NOTE = (
    "A footprint is the circle that the lander covers around a grid point. A hazard is detected if the map of slope or "
    "roughness exceeds the threshold in at least one cell of the footprint. False alarms: fraction of the truly safe "
    "footprints with a detected hazard. Missed: fraction of the unsafe footprints without a detected hazard."
)


def _describe_fault(fault: str, size: float) -> tuple[str, str]:
    """Return the name of a fault, and its size with the unit; the size is empty if it is NaN, or without a unit."""
    description = PAPER["fault_names"].get(fault, {"name": fault.replace("_", " "), "unit": "number"})
    name, unit = description["name"], description.get("unit")
    if unit is None or math.isnan(size):
        return name, ""
    if unit == "fraction":
        return name, f"{100.0 * size:g} %"
    return name, f"{size:g}" if unit == "number" else f"{size:g} {unit}"


def classify_answers(frame: pd.DataFrame) -> dict[str, Bool[np.ndarray, " n"]]:
    """Create a mask for each outcome of the search, in the order of `ANSWERS`; each row has exactly one outcome.

    `unconverged`: finished, but the algorithm reported neither a site nor that no site is safe.
    """
    is_reported, is_safe, is_refused = (
        rates.flag_mask(frame, name) for name in ("site_reported", "site_safe", "no_site_reported")
    )
    is_finished = frame["site_reported"].notna().to_numpy(dtype=np.bool_)
    return {
        "safe": is_reported & is_safe,
        "wrong": is_reported & ~is_safe,
        "refused": is_refused,
        "unconverged": is_finished & ~is_reported & ~is_refused,
        "unfinished": ~is_finished,
    }


def _median(frame: pd.DataFrame, column: str) -> float:
    return rates.quantile(rates.finite_values(frame, column), 0.5)


def _two_decimals(value: float) -> str:
    return NOTHING if math.isnan(value) else f"{value:.2f}"


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
        ("Touchdown error (m)", "off_m", lambda rows: _median(rows, "touchdown_error_m"), _two_decimals),
        ("Sink rate (m/s)", "sink_m_s", lambda rows: _median(rows, "touchdown_sink_m_s"), _two_decimals),
    ),
)
_FAULT_NOTE = (
    "Safe site, unsafe site: a site is reported, and it is truly safe or not. No safe site: the algorithm gives "
    "this answer; it can be correct. Not converged: the algorithm reports this, and the helicopter descends to the "
    f"a-priori site. The interval is at {format_fraction(CONFIDENCE)} confidence. Touchdown error: median distance of "
    "the true touchdown from the site. Sink rate: median vertical speed at touchdown."
)


def faults_section(subject: Subject) -> Section | None:
    """Create the section on answers by fault and size; None without faults."""
    frame = landing_rows(subject)
    caption = "Fraction of flights by answer, for each fault and size."
    blocks = [] if frame is None else FAULT_OUTCOMES.blocks(frame, "landingfaults", caption, _FAULT_NOTE)
    return create_section("landing-faults", "Faults", "Faults by size", *blocks)


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


#: Classes of the true ground that both images show, best first. All positions within one lander radius of a wide safe
#: site are also safe.
GROUNDS = ("wide safe site", "narrow safe site", "no safe site")
#: Names of the outcomes of `classify_answers`, in the same order; "crashed" means every case that did not finish.
ANSWERS = ("truly safe site", "unsafe site", "'no safe site'", "not converged", "crashed")
_GROUND_TEXTS = dict(
    zip(GROUNDS, ("a wide safe site exists", "only narrow safe sites exist", "no safe site exists"), strict=True)
)


def site_fractions(frame: pd.DataFrame) -> dict[str, rates.CaseFraction]:
    """Compute fractions of correct answers by class of the true ground; classes without cases are omitted."""
    is_reported, has_no_safe_site, has_wide_site = (
        rates.flag_mask(frame, name) for name in ("site_reported", "no_safe_site_exists", "wide_site_exists")
    )
    is_refused, is_safe = rates.flag_mask(frame, "no_site_reported"), rates.flag_mask(frame, "site_safe")
    has_narrow_site = rates.flag_mask(frame, "safe_site_exists") & ~has_wide_site
    is_correct = is_refused | (is_reported & is_safe)
    fractions = {
        "reported sites that are truly safe": rates.fraction_of(is_safe[is_reported], frame[is_reported]),
        "site reported if a wide safe site exists": rates.fraction_of(is_reported[has_wide_site], frame[has_wide_site]),
        "truly safe site or 'no safe site' if only narrow safe sites exist": rates.fraction_of(
            is_correct[has_narrow_site], frame[has_narrow_site]
        ),
        "answer 'no safe site' if no safe site exists": rates.fraction_of(
            is_refused[has_no_safe_site], frame[has_no_safe_site]
        ),
    }
    return {name: fraction for name, fraction in fractions.items() if fraction.n}


def outcome_counts(frame: pd.DataFrame) -> dict[str, dict[str, int]]:
    """Count flights by true ground (`GROUNDS`) and outcome (`ANSWERS`)."""
    has_wide_site, has_safe_site, has_no_safe_site = (
        rates.flag_mask(frame, name) for name in ("wide_site_exists", "safe_site_exists", "no_safe_site_exists")
    )
    answer_masks = dict(zip(ANSWERS, classify_answers(frame).values(), strict=True))
    ground_masks = dict(zip(GROUNDS, (has_wide_site, has_safe_site & ~has_wide_site, has_no_safe_site), strict=True))
    return {
        ground: {answer: int((ground_mask & mask).sum()) for answer, mask in answer_masks.items()}
        for ground, ground_mask in ground_masks.items()
    }


def create_outcome_block(frame: pd.DataFrame) -> Block:
    """Create the table of the outcomes of the search by class of the true ground."""
    counts = outcome_counts(frame)
    rows = [
        [_GROUND_TEXTS[ground], *(f"{answer_counts[name]:,}" for name in ANSWERS)]
        for ground, answer_counts in counts.items()
    ]
    head = ["Ground truth", "safe site reported", "unsafe site reported", *ANSWERS[2:]]
    note = (
        "Numbers of flights. Rows: what truly exists in the area that both images show. Columns: the answer of the "
        "algorithm; 'no safe site' is an answer. Wide: all positions within one lander radius of the site are also "
        "safe. Narrow: all other safe sites. If the algorithm does not converge, the helicopter descends to the "
        "a-priori site, which is set before the images are processed."
    )
    grid, data = Grid(head, rows), {"outcomes": counts}
    return Block(heading="Answers by ground truth", grid=grid, note=note, data=data)


def hazard_distances(frame: pd.DataFrame) -> dict[str, Float[np.ndarray, " n"]]:
    """Collect the distances of reported sites and of true touchdowns to the nearest unsafe grid position, metres.

    The distance of an unsafe position is 0. It is infinite if the grid has no unsafe position.
    """
    rows_with_site = frame[rates.flag_mask(frame, "site_reported")]
    distances = {}
    for name, rows, prefix in (("reported site", rows_with_site, "site"), ("true touchdown", frame, "touchdown")):
        values = numbers(rows, f"{prefix}_hazard_distance_m")
        if f"{prefix}_safe" in rows:
            is_unsafe = rows[f"{prefix}_safe"].eq(False).fillna(False).to_numpy(dtype=np.bool_)
            values = np.where(is_unsafe & ~np.isnan(values), 0.0, values)
        distances[name] = values[~np.isnan(values)]
    return distances


def distance_grid(curves: Mapping[str, Float[np.ndarray, " n"]]) -> Grid:
    """Create a table of minimum distance, median, 5 % quantile, and lower bound of the 5 % quantile."""
    rows = []
    for name, values in curves.items():
        if values.size:
            bound = quantile_bounds(values, 0.05, CONFIDENCE)[0]
            # the method does not interpolate, since values can be infinite
            low, median = (float(np.quantile(values, probability, method="lower")) for probability in (0.05, 0.5))
            texts = [_distance_text(float(values.min()))]
            texts.append(_distance_text(median) if values.size >= MIN_CURVE_VALUES else NOTHING)
            texts.append(_distance_text(low) if is_interpolated(values.size, 0.05) else NOTHING)
            counts = [f"{n:,}" for n in (values.size, int((values == 0.0).sum()), int(np.isinf(values).sum()))]
            rows.append([name, *counts, *texts, NOTHING if math.isinf(bound) else _distance_text(bound)])
    bound_head = f"5 % quantile, lower bound at {format_fraction(CONFIDENCE)} confidence (m)"
    count_heads = ["Flights", "On unsafe ground", "No unsafe position in the area"]
    return Grid(["", *count_heads, "Minimum distance (m)", "Median (m)", "5 % quantile (m)", bound_head], rows)


def _distance_text(distance_m: float) -> str:
    return "0" if distance_m == 0.0 else number(distance_m)


def create_distance_block(frame: pd.DataFrame) -> Block | None:
    """Create table and curves of the distances to true hazards; no curves for few distances."""
    distances = hazard_distances(frame)
    grid = drop_empty_columns(distance_grid(distances))
    if not grid.rows:
        return None
    all_values = np.concatenate([*distances.values()])
    edge_m = float(np.max(all_values[np.isfinite(all_values)], initial=0.0))
    figures = []
    if edge_m > 0.0 and max(values.size for values in distances.values()) >= MIN_CURVE_VALUES:
        # infinite distances lie beyond the axis
        curves = {name: np.where(np.isinf(values), 2.0 * edge_m, values) for name, values in distances.items()}
        labels = ("distance to the nearest unsafe position (m)", "fraction above this distance")
        figure = cumulative_figure(curves, labels, complementary=True)
        figure.axes[0].set_xlim(0.0, 1.02 * edge_m)
        figures.append(svg_figure(figure, "distances", "The drop at 0 is the fraction on unsafe ground."))
    note = (
        "A position is unsafe if slope or roughness of the lander footprint around it exceeds the limit; the hazard "
        "itself can be at the edge of the footprint. The distance is 0 on unsafe ground. On safe ground, it is the "
        "distance to the nearest unsafe position of a grid over the ground in the first image (the area), or ∞ without "
        "such a position. Reported site: its true position. True touchdown: at the reported or at the a-priori site."
    )
    return Block(heading="Distance to true hazards", figures=figures, grid=grid, note=note)
