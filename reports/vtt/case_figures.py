"""Pictures of one tracking case as Figs. 15, 17 and 16b of `papers/visual-target-tracking.txt` show theirs.

Every stop has its left subframe with the search window and the target found, and beside it what was found enlarged
(the next template) and the right subframe with the target found by point stereo. Above it stand distance, azimuth and
elevation of the mast, magnification and roll of the template, and the scores. The second figure shows the way from
above and, enlarged, where the rover believed the target to be at each stop.
"""

from __future__ import annotations

from collections.abc import Mapping
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

from marsyard.reports.presentation import save_figures
from marsyard.reports.svg import GRID, INK, MUTED, SERIES, in_page_style
from marsyard.reports.vtt.products import StopPictures, Way, stops_of, template_px, way_of

#: Orange and blue of Okabe and Ito; the true place is a white cross with a dark rim. No colour is alone in its meaning:
#: the target's square is drawn whole, the window with dashes.
TARGET, WINDOW, TRUTH = "#f0a202", "#56b4e9", "#ffffff"
_RIM = [patheffects.Stroke(linewidth=2.0, foreground="#000000"), patheffects.Normal()]
#: Sides of the enlarged template as drawn, pixels.
_ENLARGED_PX = 126
#: Stops beside each other, at most.
_COLUMNS = 4
#: Size of a stop in a figure, inches.
_CELL = (3.0, 2.35)
#: Stops get a number beside their dot where they are so far from the last that has one, as a share of the axes' width.
_APART = 0.07
#: Height of the way's axes over their width, at least: ways are mostly straight.
_FLATTEST = 0.5


@in_page_style
def draw_stops(products: Mapping[str, Any], most: int | None = None) -> Figure:
    """Subframes of all stops, or of `most` of them spread evenly over the run, the first and the last among them."""
    stops = stops_of(products)
    if most is not None and len(stops) > most:
        stops = [stops[k] for k in np.unique(np.rint(np.linspace(0, len(stops) - 1, most)).astype(np.int64))]
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
def draw_way(products: Mapping[str, Any]) -> Figure:
    """The way from above, and the estimates of the target about the designated point, enlarged.

    Raises
    ------
    ValueError
        Where the products do not hold the way.
    """
    way = way_of(products)
    if way is None:
        raise ValueError("the products hold no way of a rover")
    figure = Figure(figsize=(10.5, 5.0), layout="constrained")
    above, close = figure.subplots(1, 2)
    _draw_above(above, way)
    _draw_close(close, way)
    figure.legend(loc="outside lower center", ncols=3)
    return figure


def write_vtt_figures(directory: Path, products: Mapping[str, Any]) -> list[Path]:
    """Writes `stops.png` and, where the products hold it, `way.png` into a folder; returns their paths."""
    figures = {"stops": draw_stops(products)}
    if way_of(products) is not None:
        figures["way"] = draw_way(products)
    return save_figures(directory, figures)


def _draw_stop(figure: Figure, cell: SubplotSpec, stop: StopPictures, side: float) -> None:
    parts = cell.subgridspec(2, 2, width_ratios=(2.0, 1.0))
    left = figure.add_subplot(parts[:, 0])
    _show(left, stop.left)
    corner = stop.corners[0]
    if np.isfinite([*stop.window, *corner]).all():
        _square(
            left, stop.window[:2] - corner - 0.5, (float(stop.window[2]), float(stop.window[3])), WINDOW, (0, (4, 2))
        )
    if np.isfinite([*stop.point, *corner]).all():
        _cross(left, stop.point - corner)
    if stop.is_found:
        _template(left, stop.found[0] - corner, side)
    left.set_title("\n".join(_words(stop)), fontsize=7.5, fontweight="normal", loc="left", linespacing=1.25)
    enlarged = figure.add_subplot(parts[0, 1])
    if stop.is_found:
        _show(enlarged, _enlarged(stop.left, stop.found[0] - corner, side))
        _frame(enlarged, TARGET)
    else:
        enlarged.set_axis_off()
        enlarged.text(0.5, 0.5, "not found", ha="center", va="center", color=INK, fontsize=9, fontweight="bold")
    right = figure.add_subplot(parts[1, 1])
    if stop.right is None:
        right.set_axis_off()
        return
    _show(right, stop.right)
    if np.isfinite(stop.found[1]).all():
        _template(right, stop.found[1] - stop.corners[1], side)


def _words(stop: StopPictures) -> list[str]:
    """Three lines above a stop's pictures; what there is no number for is left out."""
    kinds = {
        "range_m": "{:.2f} m", "azimuth_deg": "azimuth {:+.1f}°", "elevation_deg": "elevation {:+.1f}°",
        "magnification": "× {:.3f}", "roll_change_deg": "roll {:+.1f}°", "match_score": "NCC {:.2f}",
        "stereo_score": "stereo {:.2f}", "error_px": "off by {:.1f} px",
    }  # fmt: skip
    values = {name: 0.0 if abs(stop.figure(name)) < 0.05 else stop.figure(name) for name in kinds}  # no minus nought
    said = {name: kinds[name].format(value).replace("-", "−") for name, value in values.items() if np.isfinite(value)}
    lines = (
        ("range_m", "azimuth_deg"),
        ("elevation_deg", "magnification", "roll_change_deg"),
        ("match_score", "stereo_score", "error_px"),
    )
    words = [", ".join(said[name] for name in names if name in said) for names in lines]
    state = "" if stop.state in ("", "normal") else f" ({stop.state})"
    return [f"{stop.number}{state}: {words[0]}", *(line or " " for line in words[1:])]


def _enlarged(
    picture: Float[np.ndarray, "_ _"], middle: Float[np.ndarray, "2"], side: float
) -> Float[np.ndarray, "n n"]:
    """A square of the picture about a sub-pixel place, by its nearest pixels."""
    steps = (np.arange(_ENLARGED_PX) + 0.5) / _ENLARGED_PX * side - 0.5 * side
    v, u = np.meshgrid(middle[1] + steps, middle[0] + steps, indexing="ij")
    return np.asarray(ndimage.map_coordinates(picture, [v, u], order=0, mode="nearest"))


def _show(axes: Axes, picture: Float[np.ndarray, "_ _"]) -> None:
    """A picture in grey, its contrast stretched between the 0.5 % and the 99.8 % quantile."""
    low, high = np.quantile(picture, (0.005, 0.998))
    levels = np.clip((picture - low) / max(float(high - low), 1e-9), 0.0, 1.0)
    grey = np.round(255.0 * levels).astype(np.uint8)
    axes.imshow(np.repeat(grey[..., None], 3, axis=2), interpolation="none", aspect="equal")
    axes.set(xticks=[], yticks=[])
    axes.grid(visible=False)
    for spine in axes.spines.values():
        spine.set_visible(False)


def _template(axes: Axes, middle: Float[np.ndarray, "2"], side: float) -> None:
    _square(axes, middle - 0.5 * side, (side, side), TARGET, "-")


def _square(
    axes: Axes,
    corner: Float[np.ndarray, "2"],
    size: tuple[float, float],
    colour: str,
    line: str | tuple[int, tuple[int, int]],
) -> None:
    square = Rectangle(
        (float(corner[0]), float(corner[1])), *size, fill=False, edgecolor=colour, linewidth=1.3, linestyle=line
    )
    axes.add_patch(square)


def _cross(axes: Axes, place: Float[np.ndarray, "2"]) -> None:
    if not all(
        low <= value <= high for value, (low, high) in zip(place, (axes.get_xlim(), axes.get_ylim()[::-1]), strict=True)
    ):
        return
    axes.plot([place[0]], [place[1]], "+", color=TRUTH, markersize=5.5, markeredgewidth=0.9, path_effects=_RIM)


def _frame(axes: Axes, colour: str) -> None:
    for spine in axes.spines.values():
        spine.set(visible=True, edgecolor=colour, linewidth=1.6)


def _draw_above(axes: Axes, way: Way) -> None:
    """The way, north up."""
    for number, (east, north, diameter) in enumerate(way.rocks):
        rock = Circle((east, north), 0.5 * diameter, facecolor=GRID, edgecolor=MUTED, linewidth=0.8)
        rock.set_hatch("" if number == 0 else "////")
        axes.add_patch(rock)
    axes.plot(*way.path.T, "-", color=SERIES[0], linewidth=1.6, label="way driven")
    axes.plot(*way.stops.T, "o", color=SERIES[0], markersize=5, label="stops")
    axes.plot(*way.believed.T, "x", color=SERIES[1], markersize=5.5, markeredgewidth=1.3, label="stops as believed")
    axes.plot(*way.target, "*", color=INK, markersize=12, label="designated target")
    axes.set(xlabel="east (m)", ylabel="north (m)", title="The way from above")
    width = _limits(axes, np.vstack([way.path, way.stops, way.believed, way.target[None]]), 0.5, _FLATTEST)
    ahead = np.column_stack([np.sin(way.heading), np.cos(way.heading)])
    for place, direction in zip(way.stops, 0.045 * width * ahead, strict=True):
        axes.plot(*np.column_stack([place, place + direction]), "-", color=MUTED, linewidth=1.1, zorder=1)
    for number in _numbered(way.stops, width):
        _number(axes, way.stops[number], number + 1)


def _draw_close(axes: Axes, way: Way) -> None:
    """Estimates of the target, centimetres from the designated point, joined in the order of the stops."""
    offsets = 100.0 * (way.estimates - way.target)
    known = np.flatnonzero(np.isfinite(offsets).all(axis=1))
    for east, north, diameter in way.rocks[:1]:
        middle = 100.0 * (np.array([east, north]) - way.target)
        axes.add_patch(Circle((middle[0], middle[1]), 50.0 * diameter, facecolor=GRID, edgecolor=MUTED, linewidth=0.8))
    moved = float(np.linalg.norm(offsets[known[-1]] - offsets[known[0]])) if known.size else 0.0
    axes.plot(*offsets[known].T, "-", color=SERIES[1], linewidth=1.0)
    axes.plot(
        *offsets[known].T,
        "o",
        color=SERIES[1],
        markersize=5,
        label=f"target as estimated ({moved:.0f} cm from first to last)",
    )
    axes.plot(0.0, 0.0, "*", color=INK, markersize=12)
    axes.set(xlabel="east of the target (cm)", ylabel="north of the target (cm)")
    axes.set_title("The target as estimated")
    width = _limits(axes, np.vstack([offsets[known], np.zeros((1, 2))]), 2.0)
    for place in _numbered(offsets[known], width):
        _number(axes, offsets[known[place]], int(known[place]) + 1)


def _numbered(points: Float[np.ndarray, "n 2"], width: float) -> list[int]:
    """Which points get their number written: the first, the last, and those far enough from all others that do."""
    chosen = [0, len(points) - 1] if len(points) > 1 else list(range(len(points)))
    for place in range(1, len(points) - 1):
        if np.linalg.norm(points[chosen] - points[place], axis=1).min() > _APART * width:
            chosen.append(place)
    return chosen


def _number(axes: Axes, place: Float[np.ndarray, "2"], number: int) -> None:
    offset: dict[str, Any] = {"xytext": (5, 4), "textcoords": "offset points"}
    rim = [patheffects.withStroke(linewidth=2.0, foreground="#ffffff")]
    axes.annotate(str(number), (float(place[0]), float(place[1])), fontsize=8, color=INK, path_effects=rim, **offset)


def _limits(axes: Axes, points: Float[np.ndarray, "n 2"], margin: float, flattest: float = 1.0) -> float:
    """Sets limits of one scale that hold all points, about as high as wide or flatter; their width."""
    low, high = points.min(axis=0), points.max(axis=0)
    half = 0.5 * (high - low) * 1.1 + margin
    half = np.maximum(half, flattest * half.max())
    middle = 0.5 * (low + high)
    axes.set(xlim=(middle[0] - half[0], middle[0] + half[0]), ylim=(middle[1] - half[1], middle[1] + half[1]))
    axes.set_aspect("equal")
    return float(2.0 * half.max())
