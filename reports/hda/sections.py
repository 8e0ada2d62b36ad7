"""Sections on landings: roughness threshold, faults, map errors, and sites.

Figures and "the paper" refer to Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from marsyard.reports import rates, section_kinds
from marsyard.reports.figures import cumulative_figure, scatter_panels
from marsyard.reports.papers import read_paper
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Block, Grid, Subject, in_page_style, svg_figure
from marsyard.reports.statistics.drivers import MIN_CASES
from marsyard.reports.statistics.samples import is_interpolated, quantile_bounds
from marsyard.reports.wording import NOTHING, count, format_fraction, number, numbers
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


@in_page_style
def draw_distribution(
    curves: Mapping[str, Float[np.ndarray, " n"]],
    labels: tuple[str, str],
    *,
    complementary: bool = False,
    limits: Mapping[str, Sequence[float]] | None = None,
) -> Figure:
    """Draw cumulative curves as `cumulative_figure`, with the legend below the axes."""
    figure = cumulative_figure(curves, labels, complementary=complementary, limits=limits)
    figure.axes[0].legend(loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=2)
    return figure


def _threshold_rows(subject: Subject) -> pd.DataFrame | None:
    """Return the rows of landing cases with the additional column `footprints_not_safe`; None for other rows.

    The column is the number of footprints that are not truly safe.
    """
    frame = landing_rows(subject)
    if frame is None:
        return None
    n_unsafe = numbers(frame, "footprints") - numbers(frame, "footprints_truly_safe")
    return frame.assign(footprints_not_safe=n_unsafe)


def _lander_limit_m(subject: Subject) -> float:
    """Return the roughness limit of the campaign's lander, or the default limit."""
    limit = subject.run.parameter("lander", "max_roughness_m")
    return float(limit) if isinstance(limit, int | float) else LanderParameters().max_roughness_m


#: False alarms and misses against the roughness threshold, to check the paper's remark on false positives.
THRESHOLD = section_kinds.SectionDeclaration(
    "threshold",
    "Threshold",
    "False alarms and misses by roughness threshold",
    rows=_threshold_rows,
    requires=("false_alarms",),
    parts=(
        section_kinds.RateByCondition(
            by=section_kinds.Quantity("max_roughness_m", "Roughness threshold (m)"),
            rates=(
                section_kinds.Rate(
                    "false_alarms",
                    "False alarms",
                    section_kinds.pooled_fraction("false_alarms", "footprints_truly_safe"),
                ),
                section_kinds.Rate("missed", "Missed", section_kinds.pooled_fraction("missed", "footprints_not_safe")),
                section_kinds.Rate(
                    "called_safe_unsafe",
                    "Classified as safe, not truly safe",
                    section_kinds.pooled_fraction("footprints_called_safe_unsafe", "footprints_called_safe"),
                ),
                section_kinds.Rate(
                    "site_reported",
                    "Site reported, if a wide safe site exists",
                    section_kinds.flag_rate("site_reported", "wide_site_exists"),
                    in_figure=False,
                ),
                section_kinds.Rate(
                    "safe", "Sites truly safe", section_kinds.flag_rate("site_safe", "site_reported"), in_figure=False
                ),
            ),
            cases="Flights",
            ylabel="fraction of footprints",
            text="According to the paper, both results of its Fig. 7 contain false positive hazards. The causes are a "
            "low roughness threshold and noise of the map. A higher threshold would remove them. The paper gives no "
            "numbers.",
            note="A footprint is the circle that the lander covers around a grid point. A hazard is detected if the "
            "map of slope or roughness exceeds the threshold in at least one cell of the footprint. False "
            "alarms: fraction of the truly safe footprints with a detected hazard. Missed: fraction of the "
            "unsafe footprints without a detected hazard.",
            caption=f"Bars are {format_fraction(CONFIDENCE)} intervals.",
            limit=("the lander's limit", _lander_limit_m),
            data="thresholds",
        ),
    ),
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


FAULT_OUTCOMES = section_kinds.OutcomesBySize(
    outcomes=lambda frame, _: classify_answers(frame),
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
    caption="Fraction of flights by answer, for each fault and size.",
    note="Safe site, unsafe site: a site is reported, and it is truly safe or not. No safe site: the algorithm gives "
    "this answer; it can be correct. Not converged: the algorithm reports this, and the helicopter descends to the "
    f"a-priori site. The interval is at {format_fraction(CONFIDENCE)} confidence. Touchdown error: median distance of "
    "the true touchdown from the site. Sink rate: median vertical speed at touchdown.",
)
FAULTS = section_kinds.SectionDeclaration(
    "landing-faults", "Faults", "Faults by size", (FAULT_OUTCOMES,), rows=landing_rows
)


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
_MAP_ERRORS = (
    section_kinds.Quantity("rms_fraction", "elevation error (% of height)", 100.0),
    section_kinds.Quantity("noise_fraction", "elevation noise (% of height)", 100.0),
    section_kinds.Quantity("slope_error_rms_deg", "slope error (deg)"),
)
_MAP_QUANTILES = section_kinds.Quantiles(
    _MAP_ERRORS,
    {"Minimum": 0.0, "5 %": 0.05, "Median": 0.5, "95 %": 0.95, "Maximum": 1.0},
    heading="Errors of the maps",
    data="maps",
)
_MAP_NOTE = (
    "{maps}: one value per map. Elevation error: RMS difference between the map and the true mean height of each cell. "
    "It includes errors that shift, tilt or scale the whole map. Elevation noise: robust standard deviation "
    "(1.4826 × median absolute deviation) of this difference about its best-fit plane; it affects the roughness. Slope "
    "error: RMS difference between the slope in the map and the true slope of a lander footprint. Height: height above "
    "ground at the first image."
)
#: Dependence of the map errors on conditions.
MAP_EFFECTS = section_kinds.Scatter(
    x=(
        section_kinds.Quantity("baseline_fraction", "baseline / height"),
        section_kinds.Quantity("texture", "texture contrast / nominal contrast"),
        section_kinds.Quantity("grid_px", "grid spacing (px)"),
        section_kinds.Quantity("level_error_deg", "error of the estimated vertical (deg)"),
        section_kinds.Quantity("altimeter_fraction", "|altimeter error| (% of range)", 100.0),
    ),
    y=_MAP_ERRORS,
    caption="Each dot is a map. The vertical axes are logarithmic.",
    logarithmic=True,
)


def _create_map_error_blocks(frame: pd.DataFrame, subject: Subject, key: str) -> section_kinds.BlocksAndData:
    """Create the table of map errors, without quantiles that need more maps."""
    blocks, data = _MAP_QUANTILES.draw(frame, subject, key)
    note = _MAP_NOTE.format(maps=count(len(frame), "map"))
    return [
        replace(block, grid=None if block.grid is None else drop_empty_columns(block.grid), note=note)
        for block in blocks
    ], data


def _create_map_effect_blocks(frame: pd.DataFrame, subject: Subject, key: str) -> section_kinds.BlocksAndData:
    """Create panels and rank correlations of `MAP_EFFECTS`; only dots for fewer than `MIN_CASES` maps."""
    blocks, data = MAP_EFFECTS.draw(frame, subject, key)
    if not blocks:
        return [], {}
    caption, grid = MAP_EFFECTS.caption, blocks[0].grid
    note = f"Medians and rank correlations need {MIN_CASES} maps."
    if len(frame) >= MIN_CASES:
        caption = f"{caption} Lines are medians of bins with equal numbers of maps."
        note = f"Spearman's rank correlations, with their intervals at {format_fraction(CONFIDENCE)} confidence."
    else:
        grid = None
    figure = svg_figure(map_effect_figure(frame, data["effects"]), key, caption, wide=True)
    note += " Baseline: horizontal distance between the cameras of both images."
    return [Block(heading="Dependence on conditions", figures=[figure], grid=grid, note=note)], data


@in_page_style
def map_effect_figure(frame: pd.DataFrame, effects: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the map errors against the conditions; medians of bins for at least `MIN_CASES` maps."""
    values = {quantity.title: quantity.values(frame) for quantity in (*MAP_EFFECTS.x, *MAP_EFFECTS.y)}
    has_medians = len(frame) >= MIN_CASES
    panels = {
        (effect["driver"], effect["error"]): (
            (values[effect["driver"]], values[effect["error"]]),
            (effect["centres"], effect["medians"]) if has_medians else ((), ()),
        )
        for effect in effects
    }
    figure = scatter_panels(panels, logarithmic=True)
    for axes in figure.axes:
        # the unit has its own line, so that labels of adjacent panels do not overlap
        axes.set_ylabel(axes.get_ylabel().replace(" (", "\n("))
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    return figure


MAP_ERRORS = section_kinds.SectionDeclaration(
    "map-errors",
    "Map",
    "Errors of the elevation map",
    rows=map_rows,
    parts=(section_kinds.CustomBlocks(_create_map_error_blocks), section_kinds.CustomBlocks(_create_map_effect_blocks)),
)

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


def create_outcome_blocks(frame: pd.DataFrame, subject: Subject, key: str) -> section_kinds.BlocksAndData:
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
    return [Block(heading="Answers by ground truth", grid=Grid(head, rows), note=note)], {"outcomes": counts}


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


def create_distance_blocks(frame: pd.DataFrame, subject: Subject, key: str) -> section_kinds.BlocksAndData:
    """Create table and curves of the distances to true hazards; no curves for few distances."""
    distances = hazard_distances(frame)
    grid = drop_empty_columns(distance_grid(distances))
    if not grid.rows:
        return [], {}
    all_values = np.concatenate([*distances.values()])
    edge_m = float(np.max(all_values[np.isfinite(all_values)], initial=0.0))
    figures = []
    if edge_m > 0.0 and max(values.size for values in distances.values()) >= MIN_CURVE_VALUES:
        # infinite distances lie beyond the axis
        curves = {name: np.where(np.isinf(values), 2.0 * edge_m, values) for name, values in distances.items()}
        labels = ("distance to the nearest unsafe position (m)", "fraction above this distance")
        figure = draw_distribution(curves, labels, complementary=True)
        figure.axes[0].set_xlim(0.0, 1.02 * edge_m)
        figures.append(svg_figure(figure, key, "The drop at 0 is the fraction on unsafe ground."))
    note = (
        "A position is unsafe if slope or roughness of the lander footprint around it exceeds the limit; the hazard "
        "itself can be at the edge of the footprint. The distance is 0 on unsafe ground. On safe ground, it is the "
        "distance to the nearest unsafe position of a grid over the ground in the first image (the area), or ∞ without "
        "such a position. Reported site: its true position. True touchdown: at the reported or at the a-priori site."
    )
    return [Block(heading="Distance to true hazards", figures=figures, grid=grid, note=note)], {}
