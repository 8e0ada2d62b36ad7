"""Section on the limits of tracking: features correctly tracked against the size of one change between the images.

The knee of a change is the size at which the tracked fraction falls below 90 %. The paper, Johnson, Montgomery &
Matthies, "Vision Guided Landing", names a limit for each change.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from marsyard.reports.column_values import numbers
from marsyard.reports.figure_style import MUTED, REQUIREMENT, in_page_style
from marsyard.reports.hda.landing_cases import PAPER, landing_rows
from marsyard.reports.plots import RateLine, draw_rates
from marsyard.reports.populations import flag_mask
from marsyard.reports.rates import CONFIDENCE, PooledRate, pooled_rate, rate_text
from marsyard.reports.section import Block, Grid, Section, Subject, build_grid, drop_empty_columns, svg_figure
from marsyard.reports.wording import NOTHING, format_fraction, note_text, percent

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
    good_text = format_fraction(GOOD_FRACTION)
    rows = [
        [
            curve.change["name"],
            f"{point.size:g} {curve.change['unit']}",
            f"{point.flights:,}",
            rate_text(point.tracked),
            f"{point.good:,}",
        ]
        for curve in curves
        for point in curve.points
    ]
    size_grid = Grid(["Change", "Size", "Flights", "Correctly tracked", f"Flights with at least {good_text}"], rows)
    caption = f"Bars are {format_fraction(CONFIDENCE)} intervals. Dashed: limit of the paper. Dotted: {good_text}."
    figure = svg_figure(limits_figure(curves), "limits", caption, wide=True)
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
    fractions_by_size = sorted(
        (sign * point.size, point.tracked.fraction)
        for point in results
        if sign * point.size >= 0.0 and not math.isnan(point.tracked.fraction)
    )
    if len(fractions_by_size) < 2:
        return math.nan
    smallest_size, first_fraction = fractions_by_size[0]
    if first_fraction < GOOD_FRACTION:
        return smallest_size
    for (size, fraction), (next_size, next_fraction) in pairwise(fractions_by_size):
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
