"""Figures of one tracking case as Figs. 15, 17 and 16b of `papers/visual-target-tracking.txt`.

First figure: for every stop the left subframe with search window and match, the match enlarged (the next template), and
the right subframe with the stereo match; above them the numbers of the update. Second figure: the path from above, and
the target's estimated positions, enlarged.
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
from matplotlib.patches import Circle, Rectangle
from scipy import ndimage

from marsyard.reports.presentation import check_shape, numeric_product, plane, save_figures
from marsyard.reports.section import GRID, INK, MUTED, SERIES, in_page_style, show_subframe

Picture = Float[np.ndarray, "_ _"]
Point = Float[np.ndarray, "2"]
#: Orange and blue of Okabe and Ito; the true position is a white cross with a dark rim. The target's square is solid,
#: the window dashed: colour is never the only distinction.
TARGET, WINDOW, TRUTH = "#f0a202", "#56b4e9", "#ffffff"
_RIM = [patheffects.Stroke(linewidth=2.0, foreground="#000000"), patheffects.Normal()]
#: Side of the enlarged template as drawn, pixels.
_ENLARGED_PX = 126
#: Maximum number of stops in a row, and the size of one, inches.
_COLUMNS, _CELL = 4, (3.0, 2.35)
#: Minimum distance between numbered stops as a fraction of the axes' width.
_APART = 0.07
#: Quantiles between which the contrast of a subframe is stretched.
_CONTRAST = (0.005, 0.998)
#: Minimum height of the path's axes over their width: paths are mostly straight.
_FLATTEST = 0.5
#: Valid numbers of stops.
_STOPS = range(1, 1000)


@dataclass(frozen=True)
class StopPictures:
    """Subframes of a stop with search window and matches, full-frame (u, v) pixels; NaN where missing.

    number: from 1
    state: of the tracker, in words
    corners: upper left pixels of the subframes
    window: upper left pixel, columns and rows of the search window in the left frame
    found: matches in the left and the right frame
    point: true projection of the designated point in the left frame
    figures: numbers of the update by name
    """

    number: int
    state: str
    left: Picture
    right: Picture | None
    corners: Float[np.ndarray, "2 2"]
    window: Float[np.ndarray, "4"]
    found: Float[np.ndarray, "2 2"]
    point: Float[np.ndarray, "2"]
    figures: Mapping[str, float]

    @property
    def is_found(self) -> bool:
        """Whether the target was reported."""
        return bool(np.isfinite(self.found[0]).all())

    def figure(self, name: str) -> float:
        """A number of the update; NaN if missing."""
        return self.figures.get(name, float("nan"))


@dataclass(frozen=True)
class RoverPath:
    """A run seen from above, world metres (east, north).

    path: of the rover's origin
    stops, believed: true position at each stop, and the rover's own estimate
    heading: at each stop, radians clockwise from north; NaN if unknown
    target: the designated point
    estimates: the target's estimate at each stop in the rover's own world frame; NaN where not found
    rocks: east, north and diameter, the target's first
    """

    path: Float[np.ndarray, "points 2"]
    stops: Float[np.ndarray, "stops 2"]
    believed: Float[np.ndarray, "stops 2"]
    heading: Float[np.ndarray, "stops"]
    target: Float[np.ndarray, "2"]
    estimates: Float[np.ndarray, "stops 2"]
    rocks: Float[np.ndarray, "rocks 3"]


def is_vtt_case(products: Mapping[str, Any]) -> bool:
    """Whether products hold the picture of a stop and a template's size."""
    return plane(products.get("stop_1_left")) is not None and template_px(products) is not None


def template_px(products: Mapping[str, Any]) -> float | None:
    """Side of the template; None if unknown."""
    side = numeric_product(products.get("template_px"))
    return float(side) if side is not None and side.ndim == 0 and np.isfinite(side) else None


def list_stops(products: Mapping[str, Any]) -> list[StopPictures]:
    """The stops in order, up to the first without a left subframe."""
    pictures: list[StopPictures] = []
    states, table = products.get("states"), products.get("figures")
    columns = (
        {str(name): numeric_product(values) for name, values in table.items()} if isinstance(table, Mapping) else {}
    )
    arrays = {name: values for name, values in columns.items() if values is not None and values.ndim == 1}
    for number in _STOPS:
        left = plane(products.get(f"stop_{number}_left"))
        if left is None:
            return pictures
        state = states[number - 1] if isinstance(states, list) and number <= len(states) else ""
        shapes = {"corners": (2, 2), "window": (4,), "found": (2, 2), "point": (2,)}
        pictures.append(
            StopPictures(
                number=number,
                state=str(state).replace("_", " ").lower(),
                left=left,
                right=plane(products.get(f"stop_{number}_right")),
                figures={name: float(a[number - 1]) for name, a in arrays.items() if number <= a.size},
                **{part: _shaped_or_nan(products.get(f"stop_{number}_{part}"), *of) for part, of in shapes.items()},
            )
        )
    return pictures


def rover_path(products: Mapping[str, Any]) -> RoverPath | None:
    """The run seen from above; None if missing."""
    target = numeric_product(products.get("target_m"))
    stops, believed = _positions(products.get("rover_true_m")), _positions(products.get("rover_believed_m"))
    estimates = _positions(products.get("target_believed_m"))
    if target is None or target.shape != (3,) or not stops.size or not stops.shape == estimates.shape == believed.shape:
        return None
    path, rocks = _positions(products.get("path_true_m")), check_shape(products.get("rocks_m"), None, 3)
    rocks = np.empty((0, 3)) if rocks is None else rocks
    heading = np.radians(_shaped_or_nan(products.get("heading_deg"), len(stops)))
    return RoverPath(path if path.size else stops, stops, believed, heading, target[:2], estimates, rocks)


def _shaped_or_nan(value: object, *shape: int) -> Float[np.ndarray, "..."]:
    values = check_shape(value, *shape)
    return np.full(shape, np.nan) if values is None else values


def _positions(value: object) -> Float[np.ndarray, "n 2"]:
    """East and north of world positions, shape (0, 2) if the product is something else."""
    values = next((one for width in (2, 3) if (one := check_shape(value, None, width)) is not None), np.empty((0, 2)))
    return np.asarray(values[:, :2])


@in_page_style
def draw_stops(products: Mapping[str, Any], max_stops: int | None = None) -> Figure:
    """Subframes of all stops, or of `max_stops` of them, spread evenly from the first to the last."""
    stops = list_stops(products)
    if max_stops is not None and len(stops) > max_stops:
        stops = [stops[k] for k in np.unique(np.rint(np.linspace(0, len(stops) - 1, max_stops)).astype(np.int64))]
    side = template_px(products)
    if not stops or side is None:
        raise ValueError("the products hold no picture of a stop")
    columns = min(_COLUMNS, len(stops))
    rows = -(-len(stops) // columns)
    layout = ConstrainedLayoutEngine(w_pad=0.03, h_pad=0.06, wspace=0.02, hspace=0.02)
    figure = Figure(figsize=(_CELL[0] * columns, _CELL[1] * rows), layout=layout)
    grid = figure.add_gridspec(rows, columns)
    for place, stop in enumerate(stops):
        _draw_stop(figure, grid[place // columns, place % columns], stop, side)
    return figure


@in_page_style
def draw_path(products: Mapping[str, Any]) -> Figure:
    """The path from above, and the target's estimates around the designated point; ValueError if missing."""
    way = rover_path(products)
    if way is None:
        raise ValueError("the products hold no way of a rover")
    figure = Figure(figsize=(10.5, 5.0), layout="constrained")
    above, close = figure.subplots(1, 2)
    _draw_above(above, way)
    _draw_close(close, way)
    figure.legend(loc="outside lower center", ncols=3)
    return figure


def write_vtt_figures(directory: Path, products: Mapping[str, Any]) -> list[Path]:
    """Write `stops.png` and, if the products hold the path, `way.png` into a folder; returns their paths."""
    figures = {"stops": draw_stops(products)}
    if rover_path(products) is not None:
        figures["way"] = draw_path(products)
    return save_figures(directory, figures)


def _draw_stop(figure: Figure, cell: SubplotSpec, stop: StopPictures, side: float) -> None:
    parts = cell.subgridspec(2, 2, width_ratios=(2.0, 1.0))
    left = figure.add_subplot(parts[:, 0])
    show_subframe(left, stop.left, _CONTRAST)
    corner = stop.corners[0]
    if np.isfinite([*stop.window, *corner]).all():
        _draw_rectangle(left, stop.window[:2] - corner - 0.5, stop.window[2:], WINDOW, (0, (4, 2)))
    point, limits = stop.point - corner, (left.get_xlim(), left.get_ylim()[::-1])
    if all(low <= value <= high for value, (low, high) in zip(point, limits, strict=True)):
        style: dict[str, Any] = {"color": TRUTH, "markersize": 5.5, "markeredgewidth": 0.9, "path_effects": _RIM}
        left.plot(*point[:, None], "+", **style)
    if stop.is_found:
        _draw_target(left, stop.found[0] - corner, side)
    left.set_title("\n".join(_stop_lines(stop)), fontsize=7.5, fontweight="normal", loc="left", linespacing=1.25)
    enlarged = figure.add_subplot(parts[0, 1])
    if stop.is_found:
        steps = (np.arange(_ENLARGED_PX) + 0.5) / _ENLARGED_PX * side - 0.5 * side
        u, v = (stop.found[0] - corner)[:, None] + steps
        pixels = np.meshgrid(v, u, indexing="ij")
        show_subframe(enlarged, ndimage.map_coordinates(stop.left, pixels, order=0, mode="nearest"), _CONTRAST)
        enlarged.spines[:].set(visible=True, edgecolor=TARGET, linewidth=1.6)
    else:
        enlarged.set_axis_off()
        enlarged.text(0.5, 0.5, "not found", ha="center", va="center", color=INK, fontsize=9, fontweight="bold")
    right = figure.add_subplot(parts[1, 1])
    if stop.right is None:
        right.set_axis_off()
        return
    show_subframe(right, stop.right, _CONTRAST)
    if np.isfinite(stop.found[1]).all():
        _draw_target(right, stop.found[1] - stop.corners[1], side)


def _stop_lines(stop: StopPictures) -> list[str]:
    """Three lines above a stop's pictures; unknown numbers are left out."""
    kinds = {
        "range_m": "{:.2f} m", "azimuth_deg": "azimuth {:+.1f}°", "elevation_deg": "elevation {:+.1f}°",
        "magnification": "× {:.3f}", "roll_change_deg": "roll {:+.1f}°", "match_score": "NCC {:.2f}",
        "stereo_score": "stereo {:.2f}", "error_px": "off by {:.1f} px",
    }  # fmt: skip
    values = {name: 0.0 if abs(stop.figure(name)) < 0.05 else stop.figure(name) for name in kinds}  # no -0.0
    texts = {name: kinds[name].format(value).replace("-", "−") for name, value in values.items() if np.isfinite(value)}
    lines = (
        ("range_m", "azimuth_deg"),
        ("elevation_deg", "magnification", "roll_change_deg"),
        ("match_score", "stereo_score", "error_px"),
    )
    words = [", ".join(texts[name] for name in names if name in texts) for names in lines]
    state = "" if stop.state in ("", "normal") else f" ({stop.state})"
    return [f"{stop.number}{state}: {words[0]}", *(line or " " for line in words[1:])]


def _draw_target(axes: Axes, centre: Float[np.ndarray, "2"], side: float) -> None:
    _draw_rectangle(axes, centre - 0.5 * side, np.full(2, side), TARGET, "-")


def _draw_rectangle(axes: Axes, corner: Point, size: Point, colour: str, line: Any) -> None:
    (x, y), (width, height) = corner.tolist(), size.tolist()
    axes.add_patch(Rectangle((x, y), width, height, fill=False, edgecolor=colour, linewidth=1.3, linestyle=line))


def _draw_above(axes: Axes, way: RoverPath) -> None:
    """The path, north up."""
    for number, (east, north, diameter) in enumerate(way.rocks):
        rock = Circle((east, north), 0.5 * diameter, facecolor=GRID, edgecolor=MUTED, linewidth=0.8)
        rock.set_hatch("" if number == 0 else "////")
        axes.add_patch(rock)
    axes.plot(*way.path.T, "-", color=SERIES[0], linewidth=1.6, label="path driven")
    axes.plot(*way.stops.T, "o", color=SERIES[0], markersize=5, label="stops")
    axes.plot(*way.believed.T, "x", color=SERIES[1], markersize=5.5, markeredgewidth=1.3, label="stops as believed")
    axes.plot(*way.target, "*", color=INK, markersize=12, label="designated target")
    axes.set(xlabel="east (m)", ylabel="north (m)", title="The path from above")
    width = _set_limits(axes, np.vstack([way.path, way.stops, way.believed, way.target[None]]), 0.5, _FLATTEST)
    ahead = np.column_stack([np.sin(way.heading), np.cos(way.heading)])
    for place, direction in zip(way.stops, 0.045 * width * ahead, strict=True):
        axes.plot(*np.column_stack([place, place + direction]), "-", color=MUTED, linewidth=1.1, zorder=1)
    for number in _choose_numbered(way.stops, width):
        _write_number(axes, way.stops[number], number + 1)


def _draw_close(axes: Axes, way: RoverPath) -> None:
    """Estimates of the target relative to the designated point, joined in the order of the stops."""
    offsets = 100.0 * (way.estimates - way.target)
    finite = np.flatnonzero(np.isfinite(offsets).all(axis=1))
    for east, north, diameter in way.rocks[:1]:
        middle = 100.0 * (np.array([east, north]) - way.target)
        axes.add_patch(Circle((middle[0], middle[1]), 50.0 * diameter, facecolor=GRID, edgecolor=MUTED, linewidth=0.8))
    moved = float(np.linalg.norm(offsets[finite[-1]] - offsets[finite[0]])) if finite.size else 0.0
    axes.plot(*offsets[finite].T, "-", color=SERIES[1], linewidth=1.0)
    text = f"target as estimated ({moved:.0f} cm from first to last)"
    axes.plot(*offsets[finite].T, "o", color=SERIES[1], markersize=5, label=text)
    axes.plot(0.0, 0.0, "*", color=INK, markersize=12)
    axes.set(xlabel="east of the target (cm)", ylabel="north of the target (cm)")
    axes.set_title("The target as estimated")
    width = _set_limits(axes, np.vstack([offsets[finite], np.zeros((1, 2))]), 2.0)
    for place in _choose_numbered(offsets[finite], width):
        _write_number(axes, offsets[finite[place]], int(finite[place]) + 1)


def _choose_numbered(points: Float[np.ndarray, "n 2"], width: float) -> list[int]:
    """Choose points to number: the first, the last, and those far enough from all chosen ones."""
    chosen = [0, len(points) - 1] if len(points) > 1 else list(range(len(points)))
    for place in range(1, len(points) - 1):
        if np.linalg.norm(points[chosen] - points[place], axis=1).min() > _APART * width:
            chosen.append(place)
    return chosen


def _write_number(axes: Axes, place: Point, number: int) -> None:
    offset: dict[str, Any] = {"xytext": (5, 4), "textcoords": "offset points"}
    rim = [patheffects.withStroke(linewidth=2.0, foreground="#ffffff")]
    axes.annotate(str(number), (float(place[0]), float(place[1])), fontsize=8, color=INK, path_effects=rim, **offset)


def _set_limits(axes: Axes, points: Float[np.ndarray, "n 2"], margin: float, flattest: float = 1.0) -> float:
    """Set limits of equal scale around all points; returns the width of the axes."""
    low, high = points.min(axis=0), points.max(axis=0)
    half = 0.5 * (high - low) * 1.1 + margin
    half = np.maximum(half, flattest * half.max())
    middle = 0.5 * (low + high)
    axes.set(xlim=(middle[0] - half[0], middle[0] + half[0]), ylim=(middle[1] - half[1], middle[1] + half[1]))
    axes.set_aspect("equal")
    return float(2.0 * half.max())
