"""Figures of one tracking case, as Figs. 15, 17 and 16b of Kim et al., "Targeted Driving Using Visual Tracking".

A subframe is the part of an image that the cameras deliver at a stop.

The first figure contains for every stop the left subframe with search window and match, the enlarged match (the next
template), and the right subframe around the stereo match. The title contains the quantities of the update. The second
figure contains a top view of the path, and an enlarged view of the target's estimated positions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle
from scipy import ndimage

from marsyard.reports.presentation import check_shape, numeric_product, save_figures, to_matrix
from marsyard.reports.section import GRID, INK, MUTED, SERIES, in_page_style, show_subframe

Image = Float[np.ndarray, "_ _"]
Point = Float[np.ndarray, "2"]
#: Orange and blue of Okabe and Ito; the true position is a white cross with a dark outline. The target's square is
#: solid and the window is dashed, since colour must not be the only distinction.
TARGET, WINDOW, TRUTH = "#f0a202", "#56b4e9", "#ffffff"
_OUTLINE = [patheffects.Stroke(linewidth=2.0, foreground="#000000"), patheffects.Normal()]
#: Styles of the marks in the subframes.
_WINDOW_STYLE: dict[str, Any] = {"edgecolor": WINDOW, "linewidth": 1.3, "linestyle": (0, (4, 2)), "fill": False}
_TARGET_STYLE: dict[str, Any] = {"edgecolor": TARGET, "linewidth": 1.3, "linestyle": "-", "fill": False}
_TRUTH_STYLE: dict[str, Any] = {
    "color": TRUTH, "marker": "+", "markersize": 5.5, "markeredgewidth": 0.9, "path_effects": _OUTLINE, "linestyle": "",
}  # fmt: skip
#: Side of the enlarged template as drawn, pixels.
_ENLARGED_PX = 126
#: Maximum number of stops in a row, and the size of a stop, inches.
_MAX_COLUMNS, _CELL_SIZE_IN = 4, (3.0, 2.35)
#: Minimum distance between stops with a number, as a fraction of the width of the axes.
_MIN_SPACING = 0.07
#: Quantiles of a subframe's values that are drawn as black and as white.
_CONTRAST_QUANTILES = (0.005, 0.998)
#: Minimum ratio of height to width of the path's axes, since paths are mostly straight.
_MIN_ASPECT = 0.5
#: Valid numbers of stops.
_STOP_NUMBERS = range(1, 1000)


@dataclass(frozen=True)
class StopImages:
    """Subframes of a stop with search window and matches, full-frame (u, v) pixels; NaN where missing.

    - number: number of the stop, from 1; state: state of the tracker
    - corners: upper left pixels of the left and the right subframe
    - window: upper left pixel, columns and rows of the search window in the left frame
    - matches: positions of the match in the left and the right frame
    - point: true projection of the designated point in the left frame
    - quantities: quantities of the update by name
    """

    number: int
    state: str
    left: Image
    right: Image | None
    corners: Float[np.ndarray, "2 2"]
    window: Float[np.ndarray, "4"]
    matches: Float[np.ndarray, "2 2"]
    point: Float[np.ndarray, "2"]
    quantities: Mapping[str, float]

    @property
    def is_matched(self) -> bool:
        """Whether the tracker reported the target."""
        return bool(np.isfinite(self.matches[0]).all())

    def quantity(self, name: str) -> float:
        """Return a quantity of the update; NaN if missing."""
        return self.quantities.get(name, float("nan"))


@dataclass(frozen=True)
class RoverPath:
    """Top view of a run, world metres (east, north).

    - path: positions of the rover's origin
    - stops, estimated: true and estimated position of the rover at each stop
    - heading: heading at each stop, radians clockwise from north; NaN if unknown
    - target: the designated point
    - estimates: estimated target at each stop in the rover's estimated world frame; NaN without a match
    - rocks: east, north and diameter; the first rock is that of the target
    """

    path: Float[np.ndarray, "points 2"]
    stops: Float[np.ndarray, "stops 2"]
    estimated: Float[np.ndarray, "stops 2"]
    heading: Float[np.ndarray, "stops"]
    target: Float[np.ndarray, "2"]
    estimates: Float[np.ndarray, "stops 2"]
    rocks: Float[np.ndarray, "rocks 3"]


def is_vtt_case(products: Mapping[str, Any]) -> bool:
    """Whether products contain the image of a stop and a template's size."""
    return to_matrix(products.get("stop_1_left")) is not None and read_template_px(products) is not None


def read_template_px(products: Mapping[str, Any]) -> float | None:
    """Read the side of the template, pixels; None if unknown."""
    side = numeric_product(products.get("template_px"))
    return float(side) if side is not None and side.ndim == 0 and np.isfinite(side) else None


def read_stops(products: Mapping[str, Any]) -> list[StopImages]:
    """Read the stops in order, up to the first stop without a left subframe."""
    stops: list[StopImages] = []
    states, table = products.get("states"), products.get("figures")
    items = table.items() if isinstance(table, Mapping) else ()
    columns = {str(name): numeric_product(values) for name, values in items}
    arrays = {name: values for name, values in columns.items() if values is not None and values.ndim == 1}
    for number in _STOP_NUMBERS:
        left = to_matrix(products.get(f"stop_{number}_left"))
        if left is None:
            return stops
        state = states[number - 1] if isinstance(states, list) and number <= len(states) else ""
        shapes = {"corners": (2, 2), "window": (4,), "matches": (2, 2), "point": (2,)}
        pixels = [_read_or_nan(products.get(f"stop_{number}_{name}"), *shape) for name, shape in shapes.items()]
        stops.append(
            StopImages(
                number=number,
                state=str(state).replace("_", " ").lower(),
                left=left,
                right=to_matrix(products.get(f"stop_{number}_right")),
                quantities={name: float(array[number - 1]) for name, array in arrays.items() if number <= array.size},
                **dict(zip(shapes, pixels, strict=True)),
            )
        )
    return stops


def read_rover_path(products: Mapping[str, Any]) -> RoverPath | None:
    """Read the top view of the run; None if missing."""
    target = numeric_product(products.get("target_m"))
    stops, estimated = _read_positions(products.get("rover_true_m")), _read_positions(products.get("rover_estimated_m"))
    estimates = _read_positions(products.get("target_estimated_m"))
    if target is None or target.shape != (3,) or not stops.size or len({*map(len, (stops, estimates, estimated))}) > 1:
        return None
    path, rocks = _read_positions(products.get("path_true_m")), check_shape(products.get("rocks_m"), None, 3)
    rocks = np.empty((0, 3)) if rocks is None else rocks
    heading = np.radians(_read_or_nan(products.get("heading_deg"), len(stops)))
    return RoverPath(path if path.size else stops, stops, estimated, heading, target[:2], estimates, rocks)


def _read_or_nan(value: object, *shape: int) -> Float[np.ndarray, "..."]:
    values = check_shape(value, *shape)
    return np.full(shape, np.nan) if values is None else values


def _read_positions(value: object) -> Float[np.ndarray, "n 2"]:
    """Read east and north of world positions; shape (0, 2) if the product is invalid."""
    arrays = [array for width in (2, 3) if (array := check_shape(value, None, width)) is not None]
    return np.asarray(arrays[0][:, :2]) if arrays else np.empty((0, 2))


@in_page_style
def draw_stops(products: Mapping[str, Any], max_stops: int | None = None) -> Figure:
    """Draw the subframes of all stops, or of `max_stops` evenly spaced stops including the first and the last."""
    stops = read_stops(products)
    if max_stops is not None and len(stops) > max_stops:
        stops = [
            stops[index] for index in np.unique(np.rint(np.linspace(0, len(stops) - 1, max_stops)).astype(np.int64))
        ]
    side_px = read_template_px(products)
    if not stops or side_px is None:
        raise ValueError("the products contain no image of a stop")
    columns = min(_MAX_COLUMNS, len(stops))
    rows = -(-len(stops) // columns)
    layout = ConstrainedLayoutEngine(w_pad=0.03, h_pad=0.06, wspace=0.02, hspace=0.02)
    figure = Figure(figsize=(_CELL_SIZE_IN[0] * columns, _CELL_SIZE_IN[1] * rows), layout=layout)
    grid = figure.add_gridspec(rows, columns)
    for index, stop in enumerate(stops):
        _draw_stop(figure, grid[index // columns, index % columns], stop, side_px)
    marks: list[Any] = []
    if any(np.isfinite([*stop.window, *stop.corners[0]]).all() for stop in stops):
        marks.append(Rectangle((0, 0), 1, 1, label="search window", **_WINDOW_STYLE))
    if any(stop.is_matched for stop in stops):
        marks.append(Rectangle((0, 0), 1, 1, label="tracked target", **_TARGET_STYLE))
    if any(np.isfinite(stop.point).all() for stop in stops):
        marks.append(Line2D([], [], label="true projection of the designated point", **_TRUTH_STYLE))
    if marks:
        figure.legend(handles=marks, loc="outside lower center", ncols=len(marks), fontsize=7.5)
    return figure


@in_page_style
def draw_path(products: Mapping[str, Any]) -> Figure:
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


def write_vtt_figures(directory: Path, products: Mapping[str, Any]) -> list[Path]:
    """Write `stops.png` and, if the products contain the path, `way.png` into a folder; returns their paths."""
    figures = {"stops": draw_stops(products)}
    if read_rover_path(products) is not None:
        figures["way"] = draw_path(products)
    return save_figures(directory, figures)


def _draw_stop(figure: Figure, cell: SubplotSpec, stop: StopImages, side_px: float) -> None:
    """Draw the subframes of a stop and the enlarged match; `side_px` is the side of the template, pixels."""
    cells = cell.subgridspec(2, 2, width_ratios=(2.0, 1.0))
    left = figure.add_subplot(cells[:, 0])
    show_subframe(left, stop.left, _CONTRAST_QUANTILES)
    corner = stop.corners[0]
    if np.isfinite([*stop.window, *corner]).all():
        _draw_rectangle(left, stop.window[:2] - corner - 0.5, stop.window[2:], _WINDOW_STYLE)
    point, limits = stop.point - corner, (left.get_xlim(), left.get_ylim()[::-1])
    if all(low <= value <= high for value, (low, high) in zip(point, limits, strict=True)):
        left.plot(*point[:, None], **_TRUTH_STYLE)
    if stop.is_matched:
        _draw_target(left, stop.matches[0] - corner, side_px)
    left.set_title("\n".join(_title_lines(stop)), fontsize=7.5, fontweight="normal", loc="left", linespacing=1.25)
    enlarged = figure.add_subplot(cells[0, 1])
    if stop.is_matched:
        steps = (np.arange(_ENLARGED_PX) + 0.5) / _ENLARGED_PX * side_px - 0.5 * side_px
        u, v = (stop.matches[0] - corner)[:, None] + steps
        pixels = np.meshgrid(v, u, indexing="ij")
        show_subframe(
            enlarged, ndimage.map_coordinates(stop.left, pixels, order=0, mode="nearest"), _CONTRAST_QUANTILES
        )
        enlarged.spines[:].set(visible=True, edgecolor=TARGET, linewidth=1.6)
    else:
        enlarged.set_axis_off()
        enlarged.text(0.5, 0.5, "not found", ha="center", va="center", color=INK, fontsize=9, fontweight="bold")
    right = figure.add_subplot(cells[1, 1])
    if stop.right is None:
        right.set_axis_off()
        return
    match = stop.matches[1] - stop.corners[1]
    columns = _select_columns(stop.right.shape[1], stop.left.shape[1], float(match[0]))
    show_subframe(right, stop.right[:, columns], _CONTRAST_QUANTILES)
    if np.isfinite(match).all():
        _draw_target(right, match - [columns.start, 0.0], side_px)


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


def _draw_target(axes: Axes, centre: Float[np.ndarray, "2"], side_px: float) -> None:
    _draw_rectangle(axes, centre - 0.5 * side_px, np.full(2, side_px), _TARGET_STYLE)


def _draw_rectangle(axes: Axes, corner: Point, size: Point, style: Mapping[str, Any]) -> None:
    (x, y), (width, height) = corner.tolist(), size.tolist()
    axes.add_patch(Rectangle((x, y), width, height, **style))


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
