"""Sections that compare landings with the paper: touchdown errors (Table II), run times (Table I), tracking limits.

The paper is Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from marsyard.reports import populations, rates, section
from marsyard.reports.blocks import Quantity, collect_values, flag_rate, rate_block
from marsyard.reports.column_values import numbers
from marsyard.reports.figure_style import MUTED, REQUIREMENT, in_page_style
from marsyard.reports.fits import fit_note
from marsyard.reports.hda.landing_cases import INTERVAL_NOTE, PAPER, landing_rows
from marsyard.reports.hda.sites_section import MIN_CURVE_VALUES
from marsyard.reports.plots import RateLine, cumulative_figure, draw_rates
from marsyard.reports.populations import flag_mask
from marsyard.reports.rates import CONFIDENCE, PooledRate, pooled_rate, rate_text
from marsyard.reports.section import (
    Block,
    Grid,
    Section,
    Subject,
    build_grid,
    create_section,
    drop_empty_columns,
    has_values,
    svg_figure,
)
from marsyard.reports.statistics.samples import mean_interval
from marsyard.reports.wording import NOTHING, count, format_fraction, interval, note_text, number, percent

#: Three measures of the distance from touchdown to site.
TOUCHDOWN_ERRORS = (
    Quantity("touchdown_error_gps_m", "averaged GPS, as in the paper"),
    Quantity("touchdown_error_m", "true touchdown"),
    Quantity("touchdown_error_estimated_m", "navigation filter"),
)
_DEVIATIONS = ("gps_sd_north_m", "gps_sd_east_m")


def _create_error_block(landings: pd.DataFrame) -> Block | None:
    """Create the curves of touchdown errors; None for few landings."""
    errors = collect_values(landings, TOUCHDOWN_ERRORS)
    if max(values.size for values in errors.values()) < MIN_CURVE_VALUES:
        return None
    runs = {"paper, runs 1, 3 and 4": [run["error_m"] for run in PAPER["landings"]]}
    labels = ("distance from touchdown to site (m)", "fraction of landings")
    figure = cumulative_figure(errors, labels, limits=runs)
    return Block(figures=[svg_figure(figure, "touchdown", "Fraction of landings up to each distance.")])


def _create_table_2_block(landings: pd.DataFrame) -> Block:
    """Create the errors of Table II: the paper's runs and their mean, and the landings by `TOUCHDOWN_ERRORS`."""
    runs: Sequence[Mapping[str, float]] = PAPER["landings"]
    columns = ("error_m", "north_m", "east_m")
    paper = {f"run {run['run']}": (1, [run[name] for name in columns]) for run in runs}
    paper["mean"] = len(runs), [float(np.mean([run[name] for run in runs])) for name in columns]
    rows = [
        [f"paper, {name}", str(n), f"{error:.2f}", NOTHING, NOTHING, f"{north:.2f}", f"{east:.2f}"]
        for name, (n, (error, north, east)) in paper.items()
    ]
    deviations = {name: rates.finite_values(landings, name) for name in _DEVIATIONS}
    groups, means, intervals = rates.terrain_groups(landings), {}, {}
    for measure in TOUCHDOWN_ERRORS:
        values = measure.values(landings)
        finite = np.isfinite(values)
        if finite.any():
            lower, upper = mean_interval(values[finite], CONFIDENCE, None if groups is None else groups[finite])
            means[measure.column], intervals[measure.column] = float(values[finite].mean()), (lower, upper)
            quantiles = [rates.quantile(values[finite], probability) for probability in (0.05, 0.95)]
            texts = [number(means[measure.column]), interval(lower, upper), interval(*quantiles)]
            # the receiver's standard deviations belong to its averaged positions
            is_gps = measure is TOUCHDOWN_ERRORS[0]
            texts += [f"{sd.mean():.2f}" if is_gps and sd.size else NOTHING for sd in deviations.values()]
            rows.append([f"this campaign, {measure.title}", f"{int(finite.sum()):,}", *texts])
    mean_heads = ["Mean distance (m)", f"Mean, {format_fraction(CONFIDENCE)} interval (m)"]
    head = ["", "Landings", *mean_heads, "5 % to 95 % quantile (m)", "GPS SD north (m)", "GPS SD east (m)"]
    column = "touchdown_safe"
    safe_fraction = rates.flag_fraction(landings, column).fraction if column in landings else math.nan
    data = {
        "landings": len(landings),
        "mean_m": means,
        "mean_interval_m": intervals,
        "deviations_m": {name: float(values.mean()) for name, values in deviations.items() if values.size},
        "touchdown_safe": safe_fraction,
        "paper_m": {str(run["run"]): run["error_m"] for run in runs},
    }
    grid = drop_empty_columns(Grid(head, rows))
    return Block(
        heading="Distances as in Table II",
        grid=grid,
        note=f"{note_text('hda.touchdown')} {fit_note('hda-table-2')}",
        data=data,
    )


def touchdown_section(subject: Subject) -> Section | None:
    """Compare the distance from touchdown to site with Table II; None without touchdown errors."""
    frame = landing_rows(subject)
    landings = None if frame is None else frame[populations.flag_mask(frame, "landed")]
    if landings is None or not has_values(landings, "touchdown_error_gps_m", "touchdown_error_m"):
        return None
    at_apriori_site = landings[~populations.flag_mask(landings, "site_reported")]
    ground = {
        "true touchdown on safe ground, all landings": flag_rate("touchdown_safe")(landings),
        "true touchdown on safe ground, landings at a reported site": flag_rate("touchdown_safe", "site_reported")(
            landings
        ),
        "true touchdown on safe ground, landings at the a-priori site": flag_rate("touchdown_safe")(at_apriori_site),
        "site of the landing (reported or a-priori) is truly safe": flag_rate("descent_target_safe")(landings),
    }
    return create_section(
        "touchdown",
        "Touchdown",
        "Distance from touchdown to site, compared with Table II of the paper",
        _create_error_block(landings),
        _create_table_2_block(landings),
        rate_block(ground, "Landings", "Safety of the ground at touchdown", INTERVAL_NOTE, "ground"),
    )


def run_times_section(subject: Subject) -> Section | None:
    """Compare the CPU time of the four stages with Table I; None if no case completed all stages."""
    frame, stages = landing_rows(subject), PAPER["stages"]
    if frame is None:
        return None
    durations = np.column_stack([numbers(frame, stage["column"]) for stage in stages])
    is_complete = np.isfinite(durations).all(axis=1)
    durations, rows_with_times, cases = durations[is_complete], frame[is_complete], int(is_complete.sum())
    if not cases or not durations.sum() > 0.0:
        return None
    medians_s, percentiles_95_s = np.median(durations, axis=0), [rates.quantile(column, 0.95) for column in durations.T]
    paper_total_s, total_s = sum(stage["seconds"] for stage in stages), float(medians_s.sum())
    # the factor scales the total run time to that of the paper
    factor, rows, data = paper_total_s / total_s, [], []
    for stage, median_s, p95_s in zip(stages, medians_s.tolist(), percentiles_95_s, strict=True):
        # medians of the columns with the simulated parameters of the stage, such as the number of features
        sizes = [rates.quantile(rates.finite_values(rows_with_times, name), 0.5) for name in stage["ours"]]
        text = NOTHING if np.isnan(sizes).any() else stage["wording"].format(*sizes)
        seconds = {"paper_s": stage["seconds"], "median_s": median_s, "p95_s": p95_s, "scaled_s": factor * median_s}
        data.append({"name": stage["name"], **seconds, "parameters": text})
        fractions = [f"{100.0 * stage['seconds'] / paper_total_s:.0f} %", f"{100.0 * median_s / total_s:.0f} %"]
        times = [f"{stage['seconds']:.2f}", fractions[0], _milliseconds(median_s), fractions[1], _milliseconds(p95_s)]
        rows.append([stage["name"], *times, stage["parameters"], text])
    totals = [f"{paper_total_s:.2f}", "100 %", _milliseconds(total_s), "100 %", NOTHING]
    rows.append(["Total", *totals, NOTHING, NOTHING])
    times_head = ["Paper (s)", "Fraction of total", "Median here (ms)", "Fraction of total", "95 % quantile here (ms)"]
    head = ["Stage", *times_head, "Parameters of the paper", "Parameters here (medians)"]
    note = note_text("hda.run_times", flights=count(cases, "flight"))
    grid = drop_empty_columns(Grid(head, rows))
    block, section_data = Block(grid=grid, note=note), {"factor": factor, "cases": cases, "stages": data}
    title = "Run time by stage, compared with Table I of the paper"
    return Section("run-times", "Run time", title, [block], section_data)


def _milliseconds(seconds: float) -> str:
    return NOTHING if math.isnan(seconds) else f"{1e3 * seconds:,.1f}"


#: Minimum fraction of tracked features for good tracking.
GOOD_FRACTION = 0.9
#: Minimum change divided by the paper's limit; smaller changes are treated as zero.
_MIN_RELATIVE_CHANGE = 0.02
#: Minimum number of distinct sizes of a change for a curve.
_MIN_SIZES = 3


@dataclass(frozen=True)
class SizeResult:
    """Correctly tracked features of the flights with one change between the images.

    - size: signed size of the change, in its unit
    - flights, good: number of flights, and of flights with at least `GOOD_FRACTION` of their features tracked
    """

    size: float
    tracked: PooledRate
    flights: int
    good: int


@dataclass(frozen=True)
class TrackingCurve:
    """Tracked fraction against the size of one change between the images, which is an entry of `paper.toml`.

    - points: results by size, including zero change
    - knee_up, knee_down: sizes of positive and negative change at which the tracked fraction falls below
      `GOOD_FRACTION`, see `find_knee`
    """

    change: Mapping[str, Any]
    points: Sequence[SizeResult]
    knee_up: float
    knee_down: float

    def knee_text(self, value: float, sign: float) -> str:
        """Format a knee with its unit; `sign` is that of its changes."""
        if math.isnan(value):
            return NOTHING
        if math.isinf(value):
            return f"> {max(sign * point.size for point in self.points):g} {self.change['unit']}"
        return f"{value:.1f} {self.change['unit']}"

    @property
    def min_fraction_within_limit(self) -> float:
        """Minimum fraction of tracked features over all sizes up to the paper's limit."""
        # the tolerance of 0.1 % allows for rounding of the sizes
        fractions = [point.tracked.fraction for point in self.points if abs(point.size) <= 1.001 * self.change["paper"]]
        return float(np.nanmin(fractions)) if fractions and not np.all(np.isnan(fractions)) else math.nan


def limits_section(subject: Subject) -> Section | None:
    """Create the section on tracked features by change; None unless each flight changes at most one condition."""
    frame = landing_rows(subject)
    curves = [] if frame is None else tracking_curves(frame)
    if not curves:
        return None
    knee_grid = build_grid(
        curves,
        {
            "Change": lambda curve: curve.change["name"],
            "Paper's limit": lambda curve: f"{curve.change['paper']:g} {curve.change['unit']}",
            "Knee": lambda curve: curve.knee_text(curve.knee_up, 1.0),
            "Knee, negative change": lambda curve: curve.knee_text(curve.knee_down, -1.0),
            "Minimum fraction within the paper's limit": lambda curve: percent(curve.min_fraction_within_limit),
        },
    )
    size_grid = build_grid(
        [(curve.change, point) for curve in curves for point in curve.points],
        {
            "Change": lambda pair: pair[0]["name"],
            "Size": lambda pair: f"{pair[1].size:g} {pair[0]['unit']}",
            "Flights": lambda pair: f"{pair[1].flights:,}",
            "Correctly tracked": lambda pair: rate_text(pair[1].tracked),
            "Flights with at least 90 %": lambda pair: f"{pair[1].good:,}",
        },
    )
    caption = f"Bars are {format_fraction(CONFIDENCE)} intervals. Dashed: limit of the paper. Dotted: 90 %."
    figure = section.svg_figure(limits_figure(curves), "limits", caption, wide=True)
    blocks = [
        Block(text=note_text("hda.limits_text"), figures=[figure]),
        Block(heading="Knees", grid=drop_empty_columns(knee_grid), note=note_text("hda.limits")),
        Block(heading="By size", grid=size_grid),
    ]
    return Section("limits", "Limits", "Tracking by change between the images", blocks, {"curves": curves})


def tracking_curves(frame: pd.DataFrame) -> list[TrackingCurve]:
    """Create a curve for each change with at least three sizes; empty if flights combine several changes."""
    changes = PAPER["changes"]
    if "tracks_correct" not in frame:
        return []
    sizes = [change["scale"] * numbers(frame, change["column"]) for change in changes]
    min_sizes = [_MIN_RELATIVE_CHANGE * change["paper"] for change in changes]
    is_changed = np.stack([np.abs(size) > min_size for size, min_size in zip(sizes, min_sizes, strict=True)])
    is_complete = np.isfinite(np.stack(sizes)).all(axis=0)
    if not is_complete.any() or np.any(is_changed[:, is_complete].sum(axis=0) > 1):
        return []
    is_unchanged = is_complete & ~is_changed.any(axis=0)
    result = []
    for change, size, has_change in zip(changes, sizes, is_changed, strict=True):
        is_selected = is_complete & (has_change | is_unchanged)
        rounded = np.where(has_change, np.round(size, 1), 0.0)
        if np.unique(rounded[is_selected]).size >= _MIN_SIZES:
            points = []
            for value in np.unique(rounded[is_selected]):
                flights = frame[is_selected & (rounded == value)]
                # a flight without tracks counts as zero of its visible features
                tracked_rate = pooled_rate(flights, "tracks_correct", "features_in_view")
                points.append(
                    SizeResult(float(value), tracked_rate, len(flights), int(flag_mask(flights, "tracked_well").sum()))
                )
            result.append(TrackingCurve(change, points, find_knee(points, 1.0), find_knee(points, -1.0)))
    return result


def find_knee(results: Sequence[SizeResult], sign: float) -> float:
    """Find the size of change at which the interpolated fraction falls below `GOOD_FRACTION`.

    `sign` selects positive (1) or negative (-1) changes. Infinite if all fractions are larger; NaN with fewer than two
    sizes in this direction.
    """
    points_by_change = sorted(
        (sign * point.size, point.tracked.fraction) for point in results if sign * point.size >= 0.0
    )
    points_by_change = [point for point in points_by_change if not math.isnan(point[1])]
    if len(points_by_change) < 2:
        return math.nan
    if points_by_change[0][1] < GOOD_FRACTION:
        return points_by_change[0][0]
    for (size, fraction), (next_size, next_fraction) in pairwise(points_by_change):
        if next_fraction < GOOD_FRACTION:
            return size + (next_size - size) * (fraction - GOOD_FRACTION) / (fraction - next_fraction)
    return math.inf


@in_page_style
def limits_figure(results: Sequence[TrackingCurve]) -> Figure:
    """Draw the curves with the paper's limits."""
    figure = Figure(figsize=(9.0, 2.7 if len(results) < 3 else 5.2), layout="constrained")
    columns = min(2, len(results))
    panels = figure.subplots(-(-len(results) // columns), columns, squeeze=False, sharey=True)
    for axes, curve in zip(panels.ravel(), results, strict=False):
        x = [point.size for point in curve.points]
        draw_rates(axes, [RateLine("", x, [point.tracked for point in curve.points])])
        for limit in (-curve.change["paper"], curve.change["paper"]):
            if min(x) <= limit <= max(x):
                axes.axvline(limit, color=REQUIREMENT, linestyle="--", linewidth=1.2)
        axes.axhline(GOOD_FRACTION, color=MUTED, linewidth=0.9, linestyle=":")
        axes.set(title=curve.change["name"], xlabel=f"change ({curve.change['unit']})")
    for axes in panels.ravel()[len(results) :]:
        axes.set_axis_off()
    for axes in panels[:, 0]:
        axes.set_ylabel("features correctly tracked")
    return figure
