"""Figures as SVG in the style of the page, and charts: cumulative curves, rates, stacked bars, scatter panels."""

from __future__ import annotations

import functools
import io
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import matplotlib as mpl
import matplotlib.style
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter, PercentFormatter

from marsyard.reports.figures import axis_edge, note_beyond
from marsyard.reports.rates import PooledRate, Share

P = ParamSpec("P")
R = TypeVar("R")

#: Colours that figures are drawn with, and the page's colours that replace them.
INK, MUTED, GRID = "#10161d", "#5a6672", "#d3d9e0"
_THEME = {INK: "var(--ink)", MUTED: "var(--muted)", GRID: "var(--line)"}

#: Colours and markers of categories, after Okabe & Ito's palette for colour-blind readers, in tones with a contrast of
#: 3:1 on the light and on the dark page; colour is never the only distinction.
SERIES = ("#2f83d6", "#cf6a14", "#1c9a76", "#b262b2", "#9c7f12", "#78838f")
MARKERS = ("o", "^", "s", "D", "v", "P")
REQUIREMENT = "#d0392f"

#: Styles of bars of outcomes; colour is never the only distinction.
BARS: Mapping[str, Mapping[str, Any]] = {
    "full": {"color": SERIES[0]},
    "hatched": {"color": "none", "edgecolor": SERIES[1], "hatch": "////"},
    "dotted": {"color": "none", "edgecolor": SERIES[5], "hatch": "...."},
    "crossed": {"color": "none", "edgecolor": REQUIREMENT, "hatch": "xxxx"},
}

#: More points than this are drawn as pixels instead of vectors, to keep pages small.
LARGEST_VECTOR_SAMPLE = 800
#: Dots per inch of parts drawn as pixels: twice the size on a screen.
RASTER_DPI = 160

_STYLE_FILE = Path(__file__).parent / "templates" / "page.mplstyle"
_STYLE: Any = mpl.rc_params_from_file(_STYLE_FILE, use_default_template=False)


def in_page_style(draw: Callable[P, R]) -> Callable[P, R]:
    """Decorate a drawing function to use the page's style instead of the user's matplotlib settings."""

    @functools.wraps(draw)
    def styled(*args: P.args, **kwargs: P.kwargs) -> R:
        with _page_style():
            return draw(*args, **kwargs)

    return styled


@contextmanager
def _page_style(**further: str) -> Iterator[None]:
    """The page's style; warnings about letters that the font lacks are ignored."""
    with mpl.style.context(["default", _STYLE, further]), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def new_axes(width: float, height: float) -> tuple[Figure, Axes]:
    """A figure with one pair of axes, size in inches; call it in the page's style."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.add_subplot()


def svg_markup(figure: Figure, key: str, description: str) -> str:
    """The figure as an SVG element of a page; its texts must have been set through matplotlib, which escapes them.

    key: letters and digits, unique on the page, as prefix of the identifiers inside
    description: text for readers who cannot see the figure
    """
    buffer = io.StringIO()
    metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    with _page_style(**{"svg.hashsalt": key, "svg.fonttype": "none"}):
        figure.savefig(buffer, format="svg", dpi=RASTER_DPI, metadata=metadata)
    markup = buffer.getvalue()
    body = markup[markup.index("<svg") :]
    view_box = re.search(r'viewBox="[^"]*"', body)
    inner = re.sub(r' id="([^"]*)"', rf' id="{key}-\1"', body[body.index(">") + 1 :])
    inner = re.sub(r'(href="|url\()#', rf"\1#{key}-", inner)
    for stand_in, colour in _THEME.items():
        inner = inner.replace(stand_in, colour)
    head = (
        f'<svg role="img" aria-label="{escape(description, quote=True)}" {view_box[0] if view_box else ""} '
        'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink">'
    )
    return head + inner.strip()


def show_picture(axes: Axes, picture: Float[np.ndarray, "_ _"]) -> None:
    """Draw a picture in grey, its contrast stretched between the 1 % and the 99 % quantile."""
    finite = picture[np.isfinite(picture)]
    low, high = np.quantile(finite, (0.01, 0.99)) if finite.size else (0.0, 1.0)
    axes.imshow(picture, cmap="gray", vmin=low, vmax=max(high, low + 1e-9), interpolation="antialiased")
    axes.set_facecolor(INK)
    axes.autoscale(enable=False)
    _hide_frame(axes)


def show_subframe(axes: Axes, picture: Float[np.ndarray, "_ _"], quantiles: tuple[float, float] = (0.01, 0.99)) -> None:
    """Draw a picture in grey pixel by pixel, its contrast stretched between two quantiles."""
    finite = picture[np.isfinite(picture)]
    low, high = np.quantile(finite, quantiles) if finite.size else (0.0, 1.0)
    levels = np.clip((np.nan_to_num(picture, nan=low) - low) / max(float(high - low), 1e-9), 0.0, 1.0)
    grey = np.round(255.0 * levels).astype(np.uint8)
    axes.imshow(np.repeat(grey[..., None], 3, axis=2), interpolation="none", aspect="equal")
    _hide_frame(axes)


def _hide_frame(axes: Axes) -> None:
    axes.set(xticks=[], yticks=[])
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)


@in_page_style
def draw_pictures(pictures: Sequence[Float[np.ndarray, "_ _"]]) -> Figure:
    """Numbered pictures in a row, as delivered: for a case whose algorithm left no details to draw."""
    rows, columns = pictures[0].shape
    height = 12.0 / len(pictures) * rows / columns + 0.35
    figure = Figure(figsize=(12.0, height), layout="constrained")
    for number, (axes, picture) in enumerate(zip(figure.subplots(1, len(pictures)), pictures, strict=True), start=1):
        show_picture(axes, picture)
        axes.set_title(f"Picture {number}", fontsize=9)
    return figure


Values = Float[np.ndarray, " n"]
_LINES = ("-", "--", ":", "-.")
_BELOW: Mapping[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.17), "ncols": 2}


@in_page_style
def cumulative_figure(
    curves: Mapping[str, Values],
    labels: tuple[str, str],
    *,
    falling: bool = False,
    bound: float | None = None,
    limits: Mapping[str, Sequence[float]] | None = None,
) -> Figure:
    """Fraction of cases up to each value, or beyond it if `falling`; curves without values are left out.

    labels: of the x and the y axis
    bound: a requirement; the x axis ends near it, and values beyond are counted
    limits: further vertical lines by name
    """
    figure, axes = new_axes(6.4, 3.4)
    every = np.concatenate([*curves.values()])
    edge = None if bound is None else max(1.25 * bound, axis_edge(every, bound))
    for (name, values), colour, line in zip(curves.items(), SERIES, _LINES * 2, strict=False):
        if values.size:
            x, share = np.concatenate([[0.0], np.sort(values)]), np.arange(values.size + 1) / values.size
            if edge is not None:
                x, share = np.append(x, max(edge, x[-1])), np.append(share, 1.0)
            y = 1.0 - share if falling else share
            axes.plot(x, y, drawstyle="steps-post", color=colour, linestyle=line, label=name)
    for name, places in (limits or {}).items():
        for number, place in enumerate(places):
            label = name if number == 0 else None
            axes.axvline(place, color=REQUIREMENT, linewidth=0.9, linestyle="-.", label=label)
    axes.set(xlabel=labels[0], ylabel=labels[1], ylim=(0.0, 1.03))
    axes.set_xlim(left=0.0)
    if bound is None or edge is None:
        axes.legend(loc="upper right" if falling else "lower right")
        return figure
    axes.axvline(bound, color=REQUIREMENT, linewidth=1.5, linestyle="--")
    axes.set_xlim(0.0, 1.02 * edge)
    note_beyond(axes, int((every > edge).sum()))
    axes.legend(**_BELOW)
    return figure


@dataclass(frozen=True)
class RateLine:
    """Rates at values of a condition, and a paper's rates by value."""

    name: str
    x: Sequence[float]
    rates: Sequence[Share | PooledRate]
    paper: Mapping[float, float] = field(default_factory=dict)


def draw_rates(axes: Axes, lines: Sequence[RateLine], linestyle: str = "-") -> None:
    """Draw rates with their intervals; rates of a paper are open marks."""
    for place, line in enumerate(lines):
        style: dict[str, Any] = {"color": SERIES[place % len(SERIES)], "marker": MARKERS[place % len(MARKERS)]}
        shares = np.array([one.share for one in line.rates])
        bounds = np.array([[one.lower, one.upper] for one in line.rates]).reshape(-1, 2)
        spread = np.abs(np.nan_to_num(bounds - shares[:, None])).T
        bars: dict[str, Any] = {"capsize": 2.5, "elinewidth": 0.9, "markersize": 5.0, "linestyle": linestyle}
        axes.errorbar(line.x, shares, spread, label=line.name or None, **bars, **style)
        if line.paper:
            name = f"{line.name}, paper" if len(lines) > 1 else "paper"
            hollow: dict[str, Any] = {"markersize": 10, "markerfacecolor": "none", "markeredgewidth": 1.5}
            axes.plot([*line.paper], [*line.paper.values()], label=name, linestyle="", **hollow, **style)
    axes.set_ylim(-0.03, 1.05)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, symbol=" %"))


@in_page_style
def rate_figure(lines: Sequence[RateLine], labels: tuple[str, str], limit: tuple[str, float] | None = None) -> Figure:
    """Rates against a condition; `limit` is the name and position of a vertical line."""
    figure, axes = new_axes(6.4, 3.7)
    draw_rates(axes, lines)
    if limit is not None:
        axes.axvline(limit[1], color=REQUIREMENT, linestyle="--", linewidth=1.2, label=limit[0])
    axes.set(xlabel=labels[0], ylabel=labels[1])
    axes.legend(**_BELOW)
    return figure


@in_page_style
def stacked_bars(names: Sequence[str], shares: Mapping[str, tuple[str, Sequence[float]]], xlabel: str) -> Figure:
    """A bar of percentages for each name; `shares` has a style of `BARS` and the percentages by outcome."""
    figure, axes = new_axes(7.4, 1.0 + 0.27 * len(names))
    places, left = np.arange(len(names)), np.zeros(len(names))
    for name, (style, values) in shares.items():
        axes.barh(places, values, left=left, height=0.7, label=name, **BARS[style])
        left = left + np.asarray(values)
    axes.set_yticks(places, list(names))
    axes.set(xlabel=xlabel, xlim=(0.0, 100.0))
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(shares))
    return figure


#: The x and y of points, or of the medians of their bins.
Points = tuple[Sequence[float] | Values, Sequence[float] | Values]


@in_page_style
def scatter_panels(panels: Mapping[tuple[str, str], tuple[Points, Points]], *, logarithmic: bool = False) -> Figure:
    """Panels of cases and of medians of their bins by x and y labels: a row for each y, a column for each x."""
    columns, rows = (list(dict.fromkeys(pair[k] for pair in panels)) for k in (0, 1))
    size = (5.0, 3.4) if len(panels) == 1 else (11.0, 0.4 + 2.0 * len(rows))
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(len(rows), len(columns), squeeze=False, sharex="col", sharey="row")
    for (x, y), (points, medians) in panels.items():
        axes = grid[rows.index(y), columns.index(x)]
        axes.plot(*points, ".", color=SERIES[5], markersize=3, rasterized=True)
        axes.plot(*medians, "o-", color=SERIES[0], markersize=4.5)
        if logarithmic:
            axes.set_yscale("log")
            # the page's style does not typeset powers of ten
            axes.yaxis.set_major_formatter(LogFormatter())
            axes.yaxis.set_minor_formatter(LogFormatter(labelOnlyBase=False))
        if y == rows[-1]:
            axes.set_xlabel(x, fontsize=8)
        if x == columns[0]:
            axes.set_ylabel(y, fontsize=8)
    return figure
