"""Figures of one tracking case, as Figs. 15, 17 and 16b of Kim et al., "Targeted Driving Using Visual Tracking".

A subframe is the part of an image that the cameras deliver at a stop.

The first figure contains for every stop the left subframe with search window and match, the enlarged match (the next
template), and the right subframe around the stereo match. The title contains the quantities of the update. The second
figure contains a top view of the path, and an enlarged view of the target's estimated positions.
"""

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from scipy import ndimage

from marsyard.reports.figure_style import GRID, INK, MUTED, SERIES, in_page_style
from marsyard.reports.images import Mark, Panel, box, draw_panels, square
from marsyard.reports.products import Products
from marsyard.reports.vtt.case_products import RoverPath, StopImages, read_rover_path, read_stops, read_template_px

Point = Float[np.ndarray, "2"]
#: Orange and blue of Okabe and Ito; the true position is a white cross with a dark outline. The target's square is
#: solid and the window is dashed, since colour must not be the only distinction.
TARGET, WINDOW, TRUTH = "#f0a202", "#56b4e9", "#ffffff"
_OUTLINE = [patheffects.Stroke(linewidth=2.0, foreground="#000000"), patheffects.Normal()]
#: Styles of the marks in the subframes.
_WINDOW_STYLE: dict[str, Any] = {"color": WINDOW, "linewidth": 1.3, "linestyle": (0, (4, 2)), "label": "search window"}
_TARGET_STYLE: dict[str, Any] = {"color": TARGET, "linewidth": 1.3, "label": "tracked target"}
_TRUTH_STYLE: dict[str, Any] = {
    "color": TRUTH, "marker": "+", "markersize": 5.5, "markeredgewidth": 0.9, "path_effects": _OUTLINE, "linestyle": "",
    "label": "true projection of the designated point",
}  # fmt: skip
#: Side of the enlarged template as drawn, pixels.
_ENLARGED_PX = 126
#: Maximum number of stops in a row, and the size of a stop, inches.
_MAX_COLUMNS, _CELL_SIZE_IN = 4, (3.0, 2.35)
#: Minimum distance between stops with a number, as a fraction of the width of the axes.
_MIN_SPACING = 0.07
#: Quantiles of a subframe's values that are drawn as black and as white.
_CONTRAST_QUANTILES = (0.005, 0.998)
_TITLE_STYLE = {"fontsize": 7.5, "fontweight": "normal", "loc": "left", "linespacing": 1.25}
#: Minimum ratio of height to width of the path's axes, since paths are mostly straight.
_MIN_ASPECT = 0.5


@in_page_style
def draw_stops(products: Products, max_stops: int | None = None) -> Figure:
    """Draw the subframes of all stops, or of `max_stops` evenly spaced stops including the first and the last."""
    stops = read_stops(products)
    if max_stops is not None and len(stops) > max_stops:
        indices = np.unique(np.rint(np.linspace(0, len(stops) - 1, max_stops)).astype(np.int64))
        stops = [stops[index] for index in indices]
    side_px = read_template_px(products)
    if not stops or side_px is None:
        raise ValueError("the products contain no image of a stop")
    columns = min(_MAX_COLUMNS, len(stops))
    rows: list[list[Panel]] = []
    for first in range(0, len(stops), columns):
        panels = [_stop_panels(stop, side_px) for stop in stops[first : first + columns]]
        panels += [(Panel(), Panel(), Panel()) for _ in range(columns - len(panels))]
        # a stop has two rows of three cells: the left subframe extends over two columns and both rows
        rows.append([panel for left, enlarged, _ in panels for panel in (left, left, enlarged)])
        rows.append([panel for left, _, right in panels for panel in (left, left, right)])
    figure = draw_panels(rows, (_CELL_SIZE_IN[0] * columns, 0.5 * _CELL_SIZE_IN[1] * len(rows)))
    labels = {mark.style["label"] for row in rows for panel in row for mark in panel.marks}
    styles = (_WINDOW_STYLE, _TARGET_STYLE, _TRUTH_STYLE)
    handles = [Line2D([], [], **style) for style in styles if style["label"] in labels]
    if handles:
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=7.5)
    return figure


@in_page_style
def draw_path(products: Products) -> Figure:
    """Draw the top view of the path, and the target's estimates; raises ValueError if the path is missing."""
    rover_path = read_rover_path(products)
    if rover_path is None:
        raise ValueError("the products contain no path of a rover")
    figure = Figure(figsize=(10.5, 5.0), layout="constrained")
    path_axes, estimate_axes = figure.subplots(1, 2)
    _draw_path_axes(path_axes, rover_path)
    _draw_estimates(estimate_axes, rover_path)
    figure.legend(loc="outside lower center", ncols=3)
    return figure


def _stop_panels(stop: StopImages, side_px: float) -> tuple[Panel, Panel, Panel]:
    """Create the panels of the left subframe of a stop, of the enlarged match, and of the right subframe.

    side_px: side of the template, pixels
    """
    corner, target = stop.corners[0], stop.matches[0] - stop.corners[0]
    marks = square(target, side_px, _TARGET_STYLE)
    if np.isfinite([*stop.window_corner, *stop.window_size, *corner]).all():
        # the edge of a pixel is half a pixel from its centre
        marks.insert(0, box(stop.window_corner - corner - 0.5, stop.window_size, _WINDOW_STYLE))
    point = stop.point - corner
    if ((point >= -0.5) & (point <= np.array(stop.left.shape[::-1]) - 0.5)).all():
        marks.append(Mark(point[None], _TRUTH_STYLE))
    title = "\n".join(_title_lines(stop))
    left = Panel(stop.left, title, marks, contrast=_CONTRAST_QUANTILES, title_style=_TITLE_STYLE)
    enlarged = Panel(text="not found")
    if stop.is_matched:
        steps = (np.arange(_ENLARGED_PX) + 0.5) / _ENLARGED_PX * side_px - 0.5 * side_px
        u, v = target[:, None] + steps
        pixels = np.meshgrid(v, u, indexing="ij")
        template = ndimage.map_coordinates(stop.left, pixels, order=0, mode="nearest")
        frame = {"edgecolor": TARGET, "linewidth": 1.6}
        enlarged = Panel(template, frame=frame, contrast=_CONTRAST_QUANTILES)
    if stop.right is None:
        return left, enlarged, Panel()
    match = stop.matches[1] - stop.corners[1]
    columns = _select_columns(stop.right.shape[1], stop.left.shape[1], float(match[0]))
    marks = square(match - np.array([columns.start, 0.0]), side_px, _TARGET_STYLE)
    return left, enlarged, Panel(stop.right[:, columns], marks=marks, contrast=_CONTRAST_QUANTILES)


def _select_columns(available: int, shown: int, centre: float) -> slice:
    """Select `shown` of the available columns around a column, by default around the middle."""
    first = (centre if np.isfinite(centre) else 0.5 * available) - 0.5 * shown
    start = int(np.clip(first, 0, max(0, available - shown)))
    return slice(start, min(start + shown, available))


def _title_lines(stop: StopImages) -> list[str]:
    """Format the three lines above a stop's images; unknown quantities are omitted."""
    formats = {
        "range_m": "{:.2f} m", "magnification": "magnification {:.3f}", "roll_change_deg": "roll {:+z.1f}°",
        "match_score": "NCC {:.2f}", "stereo_score": "stereo {:.2f}", "error_px": "error {:.1f} px",
    }  # fmt: skip
    values = {name: stop.quantity(name) for name in formats}
    texts = {
        name: formats[name].format(value).replace("-", "−") for name, value in values.items() if np.isfinite(value)
    }
    names_of_lines = (("magnification", "roll_change_deg"), ("match_score", "stereo_score", "error_px"))
    lines = [", ".join(texts[name] for name in names if name in texts) for names in names_of_lines]
    # empty lines at the end keep the images of a row aligned
    lines.sort(key=lambda line: not line)
    state = "" if stop.state in ("", "normal") else f" ({stop.state})"
    first_line = f"Stop {stop.number}{state}: {texts.get('range_m', '')}".rstrip(": ")
    return [first_line, *(line or " " for line in lines)]


def _draw_path_axes(axes: Axes, rover_path: RoverPath) -> None:
    """Draw the top view of the path; north is up."""
    axes.plot(*rover_path.path.T, "-", color=SERIES[0], linewidth=1.6, label="path driven")
    axes.plot(*rover_path.stops.T, "o", color=SERIES[0], markersize=5, label="true stops")
    axes.plot(
        *rover_path.estimated.T, "x", color=SERIES[1], markersize=5.5, markeredgewidth=1.3, label="estimated stops"
    )
    axes.plot(*rover_path.target, "*", color=INK, markersize=12, label="designated point")
    axes.set(xlabel="east (m)", ylabel="north (m)", title="Top view of the path")
    width = _set_limits(
        axes,
        np.vstack([rover_path.path, rover_path.stops, rover_path.estimated, rover_path.target[None]]),
        0.5,
        _MIN_ASPECT,
    )
    _draw_rocks(axes, rover_path.rocks)
    # lines of 4.5 % of the width show the heading
    has_heading = np.isfinite(rover_path.heading)
    directions = np.column_stack([np.sin(rover_path.heading), np.cos(rover_path.heading)])[has_heading]
    for index, position in enumerate(rover_path.stops[has_heading]):
        line = np.column_stack([position, position + 0.045 * width * directions[index]])
        name = "true heading" if index == 0 else None
        axes.plot(*line, "-", color=MUTED, linewidth=1.1, zorder=1, label=name)
    for number in _choose_numbered_points(rover_path.stops, width):
        _annotate_number(axes, rover_path.stops[number], number + 1)


def _draw_rocks(axes: Axes, rocks: Float[np.ndarray, "rocks 3"]) -> None:
    """Draw the outlines of the target's rock and of the obstacles, and label those within the axes' limits."""
    names = {"": "rock of the target", "////": "other rocks"}
    (low_east, high_east), (low_north, high_north) = axes.get_xlim(), axes.get_ylim()
    for index, (east, north, diameter) in enumerate(rocks):
        hatch, radius = "" if index == 0 else "////", 0.5 * diameter
        within_east = low_east - radius < east < high_east + radius
        label = names.pop(hatch, None) if within_east and low_north - radius < north < high_north + radius else None
        rock = Circle((east, north), radius, facecolor=GRID, edgecolor=MUTED, linewidth=0.8, hatch=hatch, label=label)
        axes.add_patch(rock)


def _draw_estimates(axes: Axes, rover_path: RoverPath) -> None:
    """Draw the estimates of the target relative to the designated point, joined in the order of the stops."""
    # centimetres
    offsets = 100.0 * (rover_path.estimates - rover_path.target)
    finite = np.flatnonzero(np.isfinite(offsets).all(axis=1))
    if finite.size:
        change_cm = float(np.linalg.norm(offsets[finite[-1]] - offsets[finite[0]]))
        text = f"estimated target ({change_cm:.0f} cm from first to last estimate)"
        axes.plot(*offsets[finite].T, "-", color=SERIES[1], linewidth=1.0)
        axes.plot(*offsets[finite].T, "o", color=SERIES[1], markersize=5, label=text)
    axes.plot(0.0, 0.0, "*", color=INK, markersize=12)
    axes.set(xlabel="east of the designated point (cm)", ylabel="north of the designated point (cm)")
    axes.set_title("Estimated positions of the target")
    width = _set_limits(axes, np.vstack([offsets[finite], np.zeros((1, 2))]), 2.0)
    for index in _choose_numbered_points(offsets[finite], width):
        _annotate_number(axes, offsets[finite[index]], int(finite[index]) + 1)


def _choose_numbered_points(points: Float[np.ndarray, "n 2"], width: float) -> list[int]:
    """Choose the points that get a number: the first, the last, and points far enough from other numbered points."""
    indices = [0, len(points) - 1] if len(points) > 1 else list(range(len(points)))
    for index in range(1, len(points) - 1):
        if np.linalg.norm(points[indices] - points[index], axis=1).min() > _MIN_SPACING * width:
            indices.append(index)
    return indices


def _annotate_number(axes: Axes, point: Point, number: int) -> None:
    offset: dict[str, Any] = {"xytext": (5, 4), "textcoords": "offset points"}
    outline = [patheffects.withStroke(linewidth=2.0, foreground="#ffffff")]
    axes.annotate(str(number), (point[0], point[1]), fontsize=8, color=INK, path_effects=outline, **offset)


def _set_limits(axes: Axes, points: Float[np.ndarray, "n 2"], margin: float, min_aspect: float = 1.0) -> float:
    """Set limits of equal scale around all points: their extent plus 10 % and a margin; return the axes' width."""
    low, high = points.min(axis=0), points.max(axis=0)
    half_size = 0.5 * (high - low) * 1.1 + margin
    half_size = np.maximum(half_size, min_aspect * half_size.max())
    lower, upper = 0.5 * (low + high) - half_size, 0.5 * (low + high) + half_size
    axes.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]))
    axes.set_aspect("equal")
    return float(2.0 * half_size.max())
