"""Tables and figures of hazard detection: missed hazards by size, and tracked features by the change between images.

"The paper" is Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from marsyard.reports import section
from marsyard.reports.blocks import Rows
from marsyard.reports.column_values import numbers
from marsyard.reports.figure_style import MUTED, REQUIREMENT, in_page_style
from marsyard.reports.hda.sections import PAPER, drop_empty_columns, landing_rows
from marsyard.reports.plots import RateLine, draw_rates
from marsyard.reports.rates import CONFIDENCE, PooledRate, flag_mask, pooled_rate, rate_text
from marsyard.reports.section import Block, Grid, Section, Subject, build_grid
from marsyard.reports.wording import NOTHING, format_fraction, note_text, percent
from marsyard.scenarios.landing.map_errors import CLASS_BOUNDS, CLASS_NAMES


@dataclass(frozen=True)
class HazardClass:
    """Hazards of one size class.

    - kind: `roughness` (the height of the hazard) or `slope`
    - low, high: bounds of the class divided by the lander's limit
    - called_safe: fraction of footprints that the map classifies as safe
    - unflagged: fraction of footprints without a detected hazard before hazard growth
    """

    kind: str
    low: float
    high: float
    called_safe: PooledRate
    unflagged: PooledRate

    @property
    def is_hazard(self) -> bool:
        """Whether the footprints exceed the limit."""
        return self.low >= 1.0

    @property
    def name(self) -> str:
        """Text of the bounds."""
        if self.low == 0.0:
            return f"< {self.high:g}"
        return f"> {self.low:g}" if math.isinf(self.high) else f"{self.low:g} to {self.high:g}"


#: Rates of footprints over all flights: columns of the counted and of all footprints, by name. A large hazard has at
#: least twice the roughness limit and a diameter of at least three map cells.
RATES: Mapping[str, tuple[str, str]] = {
    "truly safe footprints that are classified as safe": ("footprints_called_safe_rightly", "footprints_truly_safe"),
    "truly safe footprints with a detected hazard (false alarms)": ("false_alarms", "footprints_truly_safe"),
    "footprints classified as safe that are not truly safe": (
        "footprints_called_safe_unsafe",
        "footprints_called_safe",
    ),
    "footprints with a large hazard that are classified as safe": ("gross_hazards_called_safe", "gross_hazards"),
    "footprints with a large hazard, but without a detected hazard": ("gross_hazards_unflagged", "gross_hazards"),
}
_CLASS_NOTE = (
    "A footprint is the circle that the lander covers around a grid point. Only footprints that both images show "
    "completely and that have values in the map are counted. The grid spacing is one tenth of the lander diameter, so "
    "footprints overlap. The roughness of a footprint is the height of its highest obstacle. Detected: the map of "
    "slope or roughness exceeds the limit in at least one cell of the footprint. Classified as safe: the safe landing "
    "map marks the centre of the footprint as safe. Footprints within the limit of the quantity are not in the first "
    "table."
)
_RATE_NOTE = (
    "A truly safe footprint without a detected hazard is still not classified as safe if it is close to a hazard, to "
    "a hole or to the border of the map, or if a further check of the algorithm rejects it. A large hazard is at "
    "least three cells wide and at least twice as high as the roughness limit. The intervals are "
    f"{format_fraction(CONFIDENCE)} bootstrap intervals over flights, or over terrains if flights share terrains. "
    "There is no interval if the rate is 0."
)


def count_hazard_classes(frame: Rows) -> list[HazardClass]:
    """Count missed hazards by size; empty if the rows do not contain the counts."""
    edges = (0.0, *CLASS_BOUNDS, math.inf)
    classes = []
    for kind in ("roughness", "slope"):
        for class_name, low, high in zip(CLASS_NAMES, edges[:-1], edges[1:], strict=True):
            column = f"footprints_{kind}_{class_name}"
            if column in frame:
                called_safe, unflagged = (
                    pooled_rate(frame, f"{column}_{ending}", column) for ending in ("safe", "unflagged")
                )
                classes.append(HazardClass(kind, low, high, called_safe, unflagged))
    return classes


def create_class_blocks(frame: Rows) -> list[Block]:
    """Create figure and tables of missed hazards by size, and of rates of footprints; nothing without the counts."""
    classes = count_hazard_classes(frame)
    if not classes:
        return []
    n_safe_rightly = numbers(frame, "footprints_called_safe") - numbers(frame, "footprints_called_safe_unsafe")
    rate_rows = frame.assign(footprints_called_safe_rightly=n_safe_rightly)
    rates = {name: pooled_rate(rate_rows, *columns) for name, columns in RATES.items()}
    hazards = [item for item in classes if item.is_hazard and item.called_safe.total]
    class_grid = build_grid(
        hazards,
        {
            "Quantity": lambda item: item.kind,
            "Size divided by limit": lambda item: item.name,
            "Footprints": lambda item: f"{item.called_safe.total:,}",
            "Flights": lambda item: f"{item.called_safe.flights:,}",
            "Classified as safe": lambda item: rate_text(item.called_safe),
            "Not detected": lambda item: rate_text(item.unflagged),
            "Flights with an undetected hazard": lambda item: f"{item.unflagged.flights_hit:,}",
        },
    )
    rows = [
        [name, f"{item.hits:,} of {item.total:,}", rate_text(item)] for name, item in rates.items() if item.total > 0
    ]
    rate_grid = Grid(["", "Footprints", f"Fraction ({format_fraction(CONFIDENCE)} interval)"], rows)
    figures = []
    if any(item.called_safe.hits or item.unflagged.hits for item in hazards):
        caption = "Bars are the intervals of the table. There is no bar if the rate is 0."
        figures.append(section.svg_figure(class_figure(hazards), "classes", caption))
    blocks = [Block(heading="Missed hazards by size", figures=figures, grid=class_grid)] if hazards else []
    data = {"rates": rates, "classes": classes}
    heading, note = "Safe footprints and large hazards", f"{_CLASS_NOTE} {_RATE_NOTE}"
    return [*blocks, Block(heading=heading, grid=rate_grid, note=note, data=data)]


@in_page_style
def class_figure(classes: Sequence[HazardClass]) -> Figure:
    """Draw the fractions of missed hazards against their size, by roughness and by slope."""
    figure = Figure(figsize=(7.2, 3.3), layout="constrained")
    rates = [rate for item in classes for rate in (item.called_safe, item.unflagged)]
    top = float(np.nanmax([(rate.fraction, rate.upper) for rate in rates], initial=0.0)) or 1.0
    for axes, kind in zip(figure.subplots(1, 2, sharey=True), ("roughness", "slope"), strict=True):
        kind_classes = [item for item in classes if item.kind == kind]
        positions = np.arange(len(kind_classes))
        called_safe = RateLine(
            "classified as safe", (positions - 0.08).tolist(), [item.called_safe for item in kind_classes]
        )
        unflagged = RateLine("not detected", (positions + 0.08).tolist(), [item.unflagged for item in kind_classes])
        draw_rates(axes, (called_safe, unflagged), linestyle="")
        axes.set_xticks(positions, [item.name for item in kind_classes])
        axes.set(title=kind, xlabel="size divided by the lander's limit", ylim=(-0.03 * top, 1.05 * top))
    figure.axes[0].set_ylabel("fraction of footprints")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


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
