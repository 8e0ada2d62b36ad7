"""Figures of a campaign's rows: scatter and distribution of errors, errors and rates against conditions, outcomes."""

import math
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse
from matplotlib.ticker import MaxNLocator

from marsyard.campaigns.outcomes import ENGINE_FAILURES
from marsyard.reports import figure_style
from marsyard.reports.column_selection import axis_columns, category_column
from marsyard.reports.column_values import numbers
from marsyard.reports.figure_style import BARS, INK, MARKERS, MUTED, REQUIREMENT, SERIES, in_page_style, new_axes
from marsyard.reports.plots import axis_edge, note_beyond
from marsyard.reports.populations import answered_outcomes, outcome_counts
from marsyard.reports.rates import finite_values
from marsyard.reports.statistics.error_summary import error_ellipse
from marsyard.reports.wording import format_fraction, label, magnitude_label, plain_value
from marsyard.scenarios.columns import split_unit

#: Probability of the ellipse about the errors.
ELLIPSE = 0.95
#: If all errors are below this fraction of the bound, an axis does not include the bound.
_MIN_BOUND_FRACTION = 0.6
#: Number of cases per point of the curves of median and 95 % quantile; minimum and maximum number of points.
_CASES_PER_POINT, _MIN_POINTS, _MAX_POINTS = 25, 4, 16
#: Number of steps of a distribution; more cannot be distinguished.
_MAX_STEPS = 2000
#: Positions of marks above the largest magnitude drawn to scale, relative to it: hollow markers of errors beyond the
#: axis, and at the upper edge of the axes strokes of cases without an error.
_HOLLOW_POSITION, _TOP = 1.06, 1.12
_LEGEND_BELOW: Mapping[str, Any] = {"loc": "upper center", "ncols": 2, "handletextpad": 0.2}
#: Limit of a scatter relative to the largest error, to the end of the axis if larger errors lie beyond it, and to the
#: radius of the requirement's circle.
_ERROR_MARGIN, _EDGE_MARGIN, _CIRCLE_MARGIN = 1.08, 1.05, 1.15
#: Half width of a scatter's axes relative to its limit, at which the hollow markers of larger errors are drawn.
_HOLLOW_MARGIN = 1.04


@dataclass(frozen=True)
class CaseCategory:
    """A category of cases: name, mask, colour and marker."""

    name: str
    mask: Bool[np.ndarray, " n"]
    colour: str
    marker: str


def categories(frame: pd.DataFrame, metric: str, bound: float | None) -> list[CaseCategory]:
    """Divide the cases into categories: by a column of few values, else within and beyond the bound."""
    column = category_column(frame)
    if column is not None:
        values = sorted(frame[column].dropna().unique(), key=lambda value: (isinstance(value, str), value))
        names = [f"{label(column)} {plain_value(value)}" for value in values]
        masks = [frame[column].eq(value).fillna(False).to_numpy(dtype=np.bool_) for value in values]
    elif bound is not None:
        magnitude = np.abs(numbers(frame, metric))
        pairs = [("within the bound", magnitude <= bound), ("beyond the bound", magnitude > bound)]
        pairs = [(name, mask) for name, mask in pairs if mask.any()]
        names, masks = [name for name, _ in pairs], [mask for _, mask in pairs]
    else:
        names, masks = ["cases"], [np.ones(len(frame), dtype=np.bool_)]
    return [CaseCategory(name, masks[index], SERIES[index], MARKERS[index]) for index, name in enumerate(names)]


@in_page_style
def error_scatter(frame: pd.DataFrame, metric: str, bound: float | None, *, enlarged: bool = False) -> Figure | None:
    """Draw signed errors x against y with the requirement's circle (as DIMES Fig. 10); None without x and y errors.

    enlarged: fit the axes to the errors, even if the circle lies outside the axes
    """
    components = axis_columns(metric, [str(column) for column in frame.columns])[:2]
    if len(components) < 2:
        return None
    points = np.column_stack([numbers(frame, component) for component in components])
    finite = np.isfinite(points).all(axis=1)
    if not finite.any():
        return None
    ellipse = error_ellipse(points, ELLIPSE)
    limit = _scatter_limit(np.abs(points[finite]).max(axis=1), None if enlarged else bound)
    if enlarged and ellipse is not None:
        limit = max(limit, ellipse.half_extent)
    figure, axes = new_axes(5.0, 4.9)
    is_inside = (np.abs(points) <= limit).all(axis=1)
    for category in categories(frame, metric, bound):
        x, y = points[category.mask & finite & is_inside].T
        _draw_points(axes, x, y, category)
        x, y = np.clip(points[category.mask & finite & ~is_inside], -limit, limit).T
        _draw_points(axes, x, y, category, hollow=True)
    if (finite & ~is_inside).any():
        axes.plot(
            [], [], "o", markerfacecolor="none", color=INK, label=f"{(finite & ~is_inside).sum():,} beyond the axes"
        )
    if bound is not None:
        axes.add_patch(Circle((0, 0), bound, fill=False, color=REQUIREMENT, linewidth=1.6, linestyle="--", zorder=3))
        if bound <= limit * math.sqrt(2.0):  # else the circle lies outside the axes
            axes.plot([], [], "--", color=REQUIREMENT, label=f"requirement {bound:g} {split_unit(metric)[1]}")
    if ellipse is not None:
        outline: dict[str, Any] = {"fill": False, "color": INK, "linewidth": 1.4, "linestyle": ":", "zorder": 3}
        size = (2.0 * ellipse.semi_major, 2.0 * ellipse.semi_minor)
        axes.add_patch(Ellipse(ellipse.centre, *size, angle=ellipse.angle_deg, **outline))
        axes.plot([], [], ":", color=INK, label=f"{format_fraction(ELLIPSE)} ellipse")
    axes.axhline(0.0, color=MUTED, linewidth=0.8, zorder=1)
    axes.axvline(0.0, color=MUTED, linewidth=0.8, zorder=1)
    half_width = limit * _HOLLOW_MARGIN
    axes.set(xlim=(-half_width, half_width), ylim=(-half_width, half_width), aspect="equal")
    axes.set(xlabel=label(components[0]), ylabel=label(components[1]))
    axes.legend(bbox_to_anchor=(0.5, -0.14), **_LEGEND_BELOW)
    return figure


def _scatter_limit(magnitudes: Float[np.ndarray, " n"], bound: float | None) -> float:
    """Compute the largest x or y that a scatter draws to scale.

    Without a bound, all errors are inside. With a bound, the requirement's circle is inside, and errors are inside up
    to `axis_edge`.

    magnitudes: the larger one of |x| and |y| of each case
    """
    limit = _ERROR_MARGIN * float(magnitudes.max()) or 1.0
    if bound is None or bound <= 0.0:
        return limit
    circle_limit = _CIRCLE_MARGIN * bound
    return circle_limit if limit <= circle_limit else min(limit, _EDGE_MARGIN * axis_edge(magnitudes, bound))


def needs_enlarged_figure(frame: pd.DataFrame, metric: str, bound: float | None) -> bool:
    """Whether all errors are so far below the bound that an enlarged figure is needed."""
    magnitudes = np.abs(finite_values(frame, metric))
    return bound is not None and 0.0 < float(magnitudes.max(initial=0.0)) < _MIN_BOUND_FRACTION * bound


@in_page_style
def error_histogram(frame: pd.DataFrame, metric: str, bound: float | None) -> Figure | None:
    """Draw a histogram of error magnitudes with a bar for errors beyond the axis; None without errors."""
    magnitude, edge = _finite_magnitudes(frame, metric, bound)
    if magnitude.size == 0:
        return None
    figure, axes = new_axes(5.0, 2.7)
    on_axis = magnitude[magnitude <= edge]
    largest = float(on_axis.max()) if on_axis.size else edge
    bins = np.linspace(0.0, largest or 1.0, 1 + int(np.clip(2 * math.sqrt(magnitude.size), 6, 60)))
    axes.hist(on_axis, bins=list(bins), color=SERIES[0], alpha=0.85)
    n_beyond = magnitude.size - on_axis.size
    axes.set(xlabel=magnitude_label(metric), ylabel="cases", xlim=(0.0, edge * 1.02))
    if n_beyond:  # a hatched bar beyond the axis, separated by a line; positions are relative to the end of the axis
        axes.bar(1.11 * edge, n_beyond, width=0.07 * edge, color="none", edgecolor=SERIES[1], hatch="////")
        axes.axvline(1.04 * edge, color=MUTED, linewidth=0.8)
        text, position = f"{n_beyond:,}\n> {edge:.3g}", (1.11 * edge, n_beyond)
        _annotate(axes, text, position, (0, 2), ha="center", va="bottom", fontsize=8)
        axes.set_xticks([tick for tick in axes.get_xticks() if 0.0 <= tick <= edge])
        axes.set_xlim(0.0, 1.18 * edge)
        axes.margins(y=0.25)
    _draw_bound(axes, metric, bound, 0.98)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


@in_page_style
def error_distribution(frame: pd.DataFrame, metric: str, bound: float | None) -> Figure | None:
    """Draw the fraction of cases with an error up to each magnitude; None without errors."""
    magnitude, edge = _finite_magnitudes(frame, metric, bound)
    if magnitude.size == 0:
        return None
    figure, axes = new_axes(5.0, 2.7)
    ordered = np.sort(magnitude)
    if ordered.size > _MAX_STEPS:
        ordered = np.quantile(ordered, np.linspace(0.0, 1.0, _MAX_STEPS))
    fraction = np.arange(1, ordered.size + 1) / ordered.size
    steps = np.concatenate([[0.0], ordered, [max(edge, float(ordered[-1]))]])
    axes.plot(steps, np.concatenate([[0.0], fraction, [1.0]]), drawstyle="steps-post", color=SERIES[0], linewidth=1.8)
    axes.set(xlabel=magnitude_label(metric), ylabel="fraction of cases with an error", xlim=(0.0, edge * 1.02))
    _draw_bound(axes, metric, bound, 0.2)
    axes.set_ylim(0.0, 1.03)
    note_beyond(axes, int((magnitude > edge).sum()))
    return figure


@in_page_style
def error_scatter_against(frame: pd.DataFrame, metric: str, condition: str, bound: float | None) -> Figure | None:
    """Draw errors against a condition (a column); None without cases that have a number for the condition.

    Vertical strokes at the upper edge are cases without an error. Hollow markers just below that edge are errors beyond
    the axis.
    """
    x, magnitude = numbers(frame, condition), np.abs(numbers(frame, metric))
    finite = np.isfinite(x) & np.isfinite(magnitude)
    unanswered = np.isfinite(x) & ~np.isfinite(magnitude)
    if not (finite | unanswered).any():
        return None
    figure, axes = new_axes(4.2, 3.2)
    edge = _scatter_edge(magnitude[finite], bound)
    hollow_position, top = _HOLLOW_POSITION * edge, _TOP * edge
    groups = categories(frame, metric, bound)
    for group in groups:
        on_axis, beyond_axis = (group.mask & finite & on_scale for on_scale in (magnitude <= edge, magnitude > edge))
        _draw_points(axes, x[on_axis], magnitude[on_axis], group)
        _draw_points(axes, x[beyond_axis], np.full(beyond_axis.sum(), hollow_position), group, hollow=True)
    if len(groups) > 1 and not axis_columns(metric, [str(name) for name in frame.columns]):
        # otherwise the scatter figure has the legend
        axes.legend(bbox_to_anchor=(0.5, -0.18), **_LEGEND_BELOW)
    bins = min(int(finite.sum()) // _CASES_PER_POINT, _MAX_POINTS)
    if bins >= _MIN_POINTS:  # median (solid) and 95 % quantile (dotted) of bins with equal numbers of cases
        finite_x, limited_magnitude = x[finite], np.minimum(magnitude[finite], hollow_position)
        bin_indices = np.array_split(np.argsort(finite_x, kind="stable"), bins)
        centres = [float(np.median(finite_x[indices])) for indices in bin_indices]
        for quantile, line in ((0.5, "-"), (0.95, ":")):
            values = [float(np.quantile(limited_magnitude[indices], quantile)) for indices in bin_indices]
            axes.plot(centres, values, line, color=INK, zorder=4)
    if bound is not None and bound <= top:
        axes.axhline(bound, color=REQUIREMENT, linewidth=1.4, linestyle="--", zorder=3)
    strokes: dict[str, Any] = {"color": INK, "markersize": 9, "clip_on": False}
    strokes["rasterized"] = bool(unanswered.sum() > figure_style.MAX_VECTOR_POINTS)
    axes.plot(x[unanswered], np.full(unanswered.sum(), top), "|", **strokes)
    axes.set(xlabel=label(condition), ylabel=textwrap.fill(magnitude_label(metric), 32), ylim=(0.0, top))
    axes.xaxis.set_major_locator(MaxNLocator(5))
    return figure


def _scatter_edge(magnitudes: Float[np.ndarray, " n"], bound: float | None) -> float:
    """Compute the largest magnitude drawn to scale; the axis includes the bound if the errors approach the bound."""
    edge = axis_edge(magnitudes, bound)
    largest = float(magnitudes.max()) if magnitudes.size else 0.0
    includes_bound = bound is not None and _TOP * largest > _MIN_BOUND_FRACTION * bound
    return edge if includes_bound or largest == 0.0 else largest


def count_beyond_axis(frame: pd.DataFrame, metric: str, condition: str, bound: float | None) -> int:
    """Count the hollow markers of `error_scatter_against`."""
    x, magnitude = numbers(frame, condition), np.abs(numbers(frame, metric))
    finite = magnitude[np.isfinite(x) & np.isfinite(magnitude)]
    return int((finite > _scatter_edge(finite, bound)).sum())


@in_page_style
def outcome_bars(frame: pd.DataFrame) -> Figure | None:
    """Draw the number of cases by outcome; None without rows."""
    counts = outcome_counts(frame)
    if not counts:
        return None
    outcomes_with_answer = answered_outcomes(frame)
    figure, axes = new_axes(6.4, 0.75 + 0.36 * len(counts))
    for row, (name, count) in enumerate(counts):
        style = "crossed" if name in ENGINE_FAILURES else "full" if name in outcomes_with_answer else "hatched"
        axes.barh(row, count, height=0.66, **BARS[style])
        _annotate(axes, f"{count:,}", (count, row), (4, 0), va="center")
    axes.set_yticks(range(len(counts)), [name for name, _ in counts])
    axes.set(xlabel="cases", xlim=(0.0, 1.12 * max(count for _, count in counts)))
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def _annotate(axes: Axes, text: str, position: tuple[Any, Any], offset: tuple[int, int], **style: Any) -> None:
    """Write a text at a position, shifted by an offset in points."""
    style = {"fontsize": 9, **style}
    axes.annotate(text, position, xytext=offset, textcoords="offset points", color=INK, **style)


def _finite_magnitudes(
    frame: pd.DataFrame, metric: str, bound: float | None
) -> tuple[Float[np.ndarray, " finite"], float]:
    """Return the finite error magnitudes, and the end of their axis."""
    magnitudes = np.abs(finite_values(frame, metric))
    return magnitudes, axis_edge(magnitudes, bound)


def _draw_points(
    axes: Axes, x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"], category: CaseCategory, *, hollow: bool = False
) -> None:
    is_dense = x.size > figure_style.MAX_VECTOR_POINTS
    axes.plot(
        x, y, linestyle="", marker=category.marker, markersize=3.0 if is_dense else 5.5,
        alpha=0.55 if is_dense else 0.85, markeredgewidth=1.0 if hollow else 0.0,
        markerfacecolor="none" if hollow else category.colour, color=category.colour,
        label="_beyond" if hollow else category.name, rasterized=is_dense, zorder=2,
    )  # fmt: skip


def _draw_bound(axes: Axes, metric: str, bound: float | None, height: float) -> None:
    """Draw the requirement's bound as a vertical line, with its text at a height in fractions of the axes."""
    if bound is None:
        return
    axes.axvline(bound, color=REQUIREMENT, linewidth=1.6, linestyle="--", zorder=3)
    # the text is left of the line unless the line is too close to the y axis
    is_left = bound > 0.3 * axes.get_xlim()[1]
    text, side = f"requirement {bound:g} {split_unit(metric)[1]}", "right" if is_left else "left"
    shift = (-5 if is_left else 5, 0)
    _annotate(axes, text, (bound, height), shift, xycoords=("data", "axes fraction"), ha=side, va="top")
