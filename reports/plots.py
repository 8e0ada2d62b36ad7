"""General plots: cumulative distributions, rates, stacked bars, and panels of points."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, PercentFormatter

from marsyard.reports.figure_style import BARS, INK, MARKERS, REQUIREMENT, SERIES, in_page_style, new_axes
from marsyard.reports.rates import CaseFraction, PooledRate
from marsyard.reports.wording import count as count_text

#: Maximum end of an error axis divided by the requirement's bound; larger errors are counted, not drawn to scale.
_MAX_EDGE_RATIO = 3.0
#: If more than this fraction of the errors exceeds `_MAX_EDGE_RATIO` times the bound, the axis ends at this quantile.
_MAX_FRACTION_BEYOND, _EDGE_QUANTILE = 0.25, 0.95
_LEGEND_BELOW_AXES: Mapping[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.17), "ncols": 2}
_LINE_STYLES = ("-", "--", ":", "-.")
Values = Float[np.ndarray, " n"]


def axis_edge(magnitudes: Float[np.ndarray, " n"], bound: float | None) -> float:
    """Compute the end of an axis of magnitudes: the maximum, limited to 1.1 to 3 times the bound.

    If more than a quarter of the magnitudes exceed 3 times the bound, the axis ends at their 95 % quantile.
    """
    if magnitudes.size == 0:
        return bound or 1.0
    largest = float(magnitudes.max())
    if bound is None or bound <= 0.0:
        return largest or 1.0
    if float(np.mean(magnitudes > _MAX_EDGE_RATIO * bound)) > _MAX_FRACTION_BEYOND:
        return float(np.quantile(magnitudes, _EDGE_QUANTILE, method="higher"))
    return min(max(largest, 1.1 * bound), _MAX_EDGE_RATIO * bound)


def note_beyond(axes: Axes, n_beyond: int) -> None:
    """Write the number of cases beyond the axis at the right edge of a cumulative curve, if there are any."""
    if n_beyond:
        text = f"{count_text(n_beyond, 'case')} beyond →"
        axes.annotate(text, (0.985, 0.04), xycoords="axes fraction", ha="right", va="bottom", color=INK, fontsize=9)


@in_page_style
def cumulative_figure(
    curves: Mapping[str, Values],
    labels: tuple[str, str],
    *,
    complementary: bool = False,
    bound: float | None = None,
    limits: Mapping[str, Sequence[float]] | None = None,
) -> Figure:
    """Draw the fraction of cases up to each value, or above it if `complementary`; curves without values are omitted.

    - labels: labels of the x and y axes
    - bound: bound of a requirement; the x axis ends close to it, and values beyond the axis are counted
    - limits: positions of additional vertical lines by name
    """
    figure, axes = new_axes(6.4, 3.4)
    all_values = np.concatenate([*curves.values()])
    edge = None if bound is None else max(1.25 * bound, axis_edge(all_values, bound))
    for (name, values), colour, line in zip(curves.items(), SERIES, _LINE_STYLES * 2, strict=False):
        if values.size:
            x, fraction = np.concatenate([[0.0], np.sort(values)]), np.arange(values.size + 1) / values.size
            if edge is not None:
                x, fraction = np.append(x, max(edge, x[-1])), np.append(fraction, 1.0)
            y = 1.0 - fraction if complementary else fraction
            axes.plot(x, y, drawstyle="steps-post", color=colour, linestyle=line, label=name)
    for name, positions in (limits or {}).items():
        for index, position in enumerate(positions):
            line_label = name if index == 0 else None
            axes.axvline(position, color=REQUIREMENT, linewidth=0.9, linestyle="-.", label=line_label)
    axes.set(xlabel=labels[0], ylabel=labels[1], ylim=(0.0, 1.03))
    axes.set_xlim(left=0.0)
    if bound is not None and edge is not None:
        axes.axvline(bound, color=REQUIREMENT, linewidth=1.5, linestyle="--")
        axes.set_xlim(0.0, 1.02 * edge)
        note_beyond(axes, int((all_values > edge).sum()))
    axes.legend(**_LEGEND_BELOW_AXES)
    return figure


@dataclass(frozen=True)
class RateLine:
    """Rates at the values `x` of a condition; `paper` contains the rates of a paper, by value of the condition."""

    name: str
    x: Sequence[float]
    rates: Sequence[CaseFraction | PooledRate]
    paper: Mapping[float, float] = field(default_factory=dict)


def draw_rates(axes: Axes, lines: Sequence[RateLine], linestyle: str = "-") -> None:
    """Draw rates with their intervals; rates of a paper are open markers."""
    for index, line in enumerate(lines):
        style: dict[str, Any] = {"color": SERIES[index % len(SERIES)], "marker": MARKERS[index % len(MARKERS)]}
        fractions = np.array([rate.fraction for rate in line.rates])
        bounds = np.array([[rate.lower, rate.upper] for rate in line.rates]).reshape(-1, 2)
        error_bars = np.abs(np.nan_to_num(bounds - fractions[:, None])).T
        bars: dict[str, Any] = {"capsize": 2.5, "elinewidth": 0.9, "markersize": 5.0, "linestyle": linestyle}
        axes.errorbar(line.x, fractions, error_bars, label=line.name or None, **bars, **style)
        if line.paper:
            name = f"{line.name}, paper" if len(lines) > 1 else "paper"
            hollow: dict[str, Any] = {"markersize": 10, "markerfacecolor": "none", "markeredgewidth": 1.5}
            axes.plot([*line.paper], [*line.paper.values()], label=name, linestyle="", **hollow, **style)
    axes.set_ylim(-0.03, 1.05)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, symbol=" %"))


@in_page_style
def rate_figure(lines: Sequence[RateLine], labels: tuple[str, str], limit: tuple[str, float] | None = None) -> Figure:
    """Draw rates against a condition; `limit` is the name and position of a vertical line."""
    figure, axes = new_axes(6.4, 3.7)
    draw_rates(axes, lines)
    if limit is not None:
        axes.axvline(limit[1], color=REQUIREMENT, linestyle="--", linewidth=1.2, label=limit[0])
    axes.set(xlabel=labels[0], ylabel=labels[1])
    axes.legend(**_LEGEND_BELOW_AXES)
    return figure


@in_page_style
def stacked_bars(names: Sequence[str], percentages: Mapping[str, tuple[str, Sequence[float]]], xlabel: str) -> Figure:
    """Draw a bar of percentages for each name; `percentages` contains a style of `BARS` and the values by outcome."""
    figure, axes = new_axes(7.4, 1.0 + 0.27 * len(names))
    positions, left = np.arange(len(names)), np.zeros(len(names))
    for name, (style, values) in percentages.items():
        axes.barh(positions, values, left=left, height=0.7, label=name, **BARS[style])
        left = left + np.asarray(values)
    axes.set_yticks(positions, list(names))
    axes.set(xlabel=xlabel, xlim=(0.0, 100.0))
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(percentages))
    return figure


#: x and y coordinates of points.
Points = tuple[Sequence[float] | Values, Sequence[float] | Values]


@in_page_style
def scatter_panels(panels: Mapping[tuple[str, str], tuple[Points, Points]], *, logarithmic: bool) -> Figure:
    """Draw panels with cases and medians of bins, by x and y labels: a row for each y, a column for each x."""
    x_labels, y_labels = list(dict.fromkeys(x for x, _ in panels)), list(dict.fromkeys(y for _, y in panels))
    size = (5.0, 3.4) if len(panels) == 1 else (11.0, 0.4 + 2.0 * len(y_labels))
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(len(y_labels), len(x_labels), squeeze=False, sharex="col", sharey="row")
    for (x, y), (points, medians) in panels.items():
        axes = grid[y_labels.index(y), x_labels.index(x)]
        axes.plot(*points, ".", color=SERIES[5], markersize=3, rasterized=True)
        axes.plot(*medians, "o-", color=SERIES[0], markersize=4.5)
        if logarithmic:
            axes.set_yscale("log")
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            # the page's style does not support superscripts of powers of ten
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.yaxis.set_minor_formatter(NullFormatter())
        if y == y_labels[-1]:
            axes.set_xlabel(x, fontsize=8)
        if x == x_labels[0]:
            # the unit has its own line, so that labels of adjacent panels do not overlap
            axes.set_ylabel(y.replace(" (", "\n("), fontsize=8)
    return figure
