"""Figures of one DIMES case, laid out as Figs. 7 to 9 of the field test's paper (`papers/dimes-field-test.txt`).

The two image pairs are drawn side by side. Top row: the images rectified to a nadir view, with search windows (blue).
Middle row: the correlated templates and windows, which the paper does not show. Bottom row: the images as delivered,
with templates (red) and tracked positions (green). Dashed squares mark tracks that failed a validity check.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.patches import Polygon, Rectangle
from matplotlib.path import Path as Outline
from matplotlib.transforms import Bbox
from scipy import ndimage

from marsyard.reports.presentation import numeric_product, save_figures, to_matrix
from marsyard.reports.section import INK, draw_images, in_page_style, show_subframe

Image = Float[np.ndarray, "_ _"]
#: Colours of templates, matches and search windows.
TEMPLATE, MATCH, WINDOW = "#ff4b3e", "#35d46b", "#4aa3ff"
#: Side of a template's square on a delivered image if the products do not contain the side, pixels.
_DEFAULT_SIDE_PX = 15.0
_PAIRS = (0, 1)
_MAX_TRACKS = 2
#: Relative heights of the rows of a pair's figure, and inches per unit: a figure with all rows is 8.3 in high.
_ROW_HEIGHTS = {"rectified": 1.95, "templates": 1.0, "delivered": 1.95}
_IN_PER_UNIT = 8.3 / 4.9
#: Side of a rectified image as drawn, pixels.
_RECTIFIED_PX = 384
#: Valid template numbers. The figure shows at most `_MAX_TRACKS` templates per pair; the table lists all.
_TEMPLATE_NUMBERS = range(100)
#: Matplotlib line style of tracks that failed a validity check: offset, and lengths of dash and gap.
_DASHED = (0, (2, 1.5))


@dataclass(frozen=True)
class Track:
    """One template and its track.

    - pair, template: indices from 0; valid: whether the track passed the validity checks
    - values: row of the track in the table `tracks` of the products, by column name
    - patch, window: rectified template and search window; position: row and column of the match in the window
    """

    pair: int
    template: int
    valid: bool
    values: Mapping[str, float]
    patch: Image | None
    window: Image | None
    position: tuple[float, float] | None


def is_dimes_case(products: Mapping[str, Any]) -> bool:
    """Whether products contain the three images of a DIMES case."""
    return all(to_matrix(products.get(f"image_{number}")) is not None for number in (1, 2, 3))


def read_tracks(products: Mapping[str, Any]) -> list[Track]:
    """Read the tracks of a case; rows with an unknown pair or template are skipped."""
    try:
        table = np.atleast_2d(np.asarray(products.get("tracks", ()), dtype=np.float64))
        names = [str(name) for name in np.asarray(products.get("tracks_columns", ())).ravel()]
    except (TypeError, ValueError):
        return []
    if table.size == 0 or table.shape[1] != len(names):
        return []
    case_tracks = []
    for row in (dict(zip(names, (float(value) for value in values), strict=True)) for values in table):
        if row.get("pair") not in _PAIRS or row.get("template") not in _TEMPLATE_NUMBERS:
            continue
        pair, template = int(row["pair"]), int(row["template"])
        patch, window = (to_matrix(products.get(f"{part}_{pair}_{template}")) for part in ("template", "window"))
        match = numeric_product(products.get(f"match_{pair}_{template}"))
        position = (float(match[0]), float(match[1])) if match is not None and match.size == 2 else None
        case_tracks.append(Track(pair, template, row.get("valid", 0.0) == 1.0, row, patch, window, position))
    return case_tracks


@in_page_style
def draw_dimes_case(products: Mapping[str, Any]) -> Figure:
    """Draw both image pairs of a case, side by side; raises ValueError without the three images."""
    figure = Figure(figsize=(12.0, max(_figure_height_in(products, pair) for pair in _PAIRS)), layout="constrained")
    columns = figure.add_gridspec(1, 2)
    for pair in _PAIRS:
        _draw_pair(figure.add_subfigure(columns[pair]), products, pair)
    return figure


@in_page_style
def draw_dimes_pair(products: Mapping[str, Any], pair: int) -> Figure:
    """Draw one image pair of a case, 0 or 1; raises ValueError without its images."""
    figure = Figure(figsize=(6.0, _figure_height_in(products, pair)), layout="constrained")
    _draw_pair(figure, products, pair)
    return figure


def describe_marks(products: Mapping[str, Any], pair: int) -> str:
    """Describe the marks in the figure of an image pair; marks that are not in the figure are omitted."""
    earlier, later = pair + 1, pair + 2
    pair_tracks = [track for track in read_tracks(products) if track.pair == pair][:_MAX_TRACKS]
    texts = [f"Red: templates in image {earlier}."] if pair_tracks else ["No templates."]
    if any(track.window is not None for track in pair_tracks):
        texts.append(f"Blue: search windows in image {later}.")
    if any(track.position is not None or np.isfinite(track.values.get("match_u", np.nan)) for track in pair_tracks):
        texts.append(f"Green: tracked positions in image {later}.")
    if not all(track.valid for track in pair_tracks):
        texts.append("Dashed: the template failed a validity check.")
    shapes = [_read_image(products, f"image_{number}").shape for number in (earlier, later)]
    if _visible_overlap(products, pair, shapes[0]) is not None:
        texts.append(f"Dotted yellow line: border of the overlap with image {later}, if there is no horizontal motion.")
    if any(_visible_zero_phase(products, pair, index, shape) is not None for index, shape in enumerate(shapes)):
        texts.append("Yellow cross: point opposite to the sun; no template is placed near it.")
    return " ".join(texts)


def draw_delivered_images(products: Mapping[str, Any]) -> Figure:
    """Draw the three images, binned to square pixels; raises ValueError if one is missing."""
    return draw_images([_read_image(products, f"image_{number}") for number in (1, 2, 3)])


def write_dimes_figures(directory: Path, products: Mapping[str, Any]) -> list[Path]:
    """Write `dimes.png` into a folder, or `images.png` if the algorithm has no DIMES details; returns the path."""
    if "tracks" in products:
        return save_figures(directory, {"dimes": draw_dimes_case(products)})
    return save_figures(directory, {"images": draw_delivered_images(products)})


def _row_heights(products: Mapping[str, Any], pair: int) -> dict[str, float]:
    """Return the relative heights of the non-empty rows of a pair's figure, from top to bottom."""
    has_content = {
        "rectified": any(
            numeric_product(products.get(f"rectified_{pair}_{image_index}")) is not None for image_index in (0, 1)
        ),
        "templates": any(track.pair == pair and track.patch is not None for track in read_tracks(products)),
        "delivered": True,
    }
    return {name: _ROW_HEIGHTS[name] for name, is_drawn in has_content.items() if is_drawn}


def _figure_height_in(products: Mapping[str, Any], pair: int) -> float:
    return _IN_PER_UNIT * sum(_row_heights(products, pair).values())


def _draw_pair(figure: FigureBase, products: Mapping[str, Any], pair: int) -> None:
    images = [_read_image(products, f"image_{number}") for number in (pair + 1, pair + 2)]
    pair_tracks = [track for track in read_tracks(products) if track.pair == pair][:_MAX_TRACKS]
    heights = _row_heights(products, pair)
    cells = figure.add_gridspec(len(heights), 1, height_ratios=[*heights.values()])
    grid = {name: cells[index] for index, name in enumerate(heights)}
    if "rectified" in grid:
        rectified_cells = grid["rectified"].subgridspec(1, 2)
        for image_index, image in enumerate(images):
            _draw_rectified(
                figure.add_subplot(rectified_cells[image_index]), products, image, pair_tracks, pair, image_index
            )
    if "templates" in grid:
        template_cells = grid["templates"].subgridspec(1, 2 * _MAX_TRACKS)
        for index in range(_MAX_TRACKS):
            panels = [figure.add_subplot(template_cells[2 * index + column]) for column in (0, 1)]
            if index < len(pair_tracks):
                _draw_template_window(panels, pair_tracks[index])
            else:
                for axes in panels:
                    axes.set_axis_off()
    delivered_cells = grid["delivered"].subgridspec(1, 2)
    for image_index, (image, prefix, colour) in enumerate(
        zip(images, ("template", "match"), (TEMPLATE, MATCH), strict=True)
    ):
        axes = figure.add_subplot(delivered_cells[image_index])
        show_subframe(axes, image)
        axes.set_facecolor(INK)
        _mark_tracks(axes, pair_tracks, prefix, colour)
        _outline_overlap(axes, products, pair, image_index)
        content = f": {('templates', 'tracked positions')[image_index]}" if pair_tracks else ""
        axes.set_title(f"Image {pair + image_index + 1}{content}", fontsize=9)


def _draw_rectified(
    axes: Axes, products: Mapping[str, Any], image: Image, pair_tracks: Sequence[Track], pair: int, image_index: int
) -> None:
    """Draw an image of a pair, rectified, with its templates (first image) or windows and matches (second image).

    `rectified_frame_<pair>` contains west and north edge and spacing of the lattice, metres; `gsd_<pair>` is the pixel
    size of templates and windows, metres (`marsyard.algorithms.dimes.details`).
    """
    lattice = numeric_product(products.get(f"rectified_{pair}_{image_index}"))
    frame, gsd = numeric_product(products.get(f"rectified_frame_{pair}")), numeric_product(products.get(f"gsd_{pair}"))
    if lattice is None or lattice.ndim != 3 or lattice.shape[2] != 2 or frame is None or frame.size != 3:
        axes.set_axis_off()
        return
    rectified = _rectify(image, lattice)
    show_subframe(axes, rectified)
    axes.set_facecolor(INK)
    west, north, lattice_spacing_m = (float(value) for value in frame.ravel())
    pixel_m = lattice_spacing_m * (lattice.shape[0] - 1) / (rectified.shape[0] - 1)
    spacing_m = float(gsd[0]) if gsd is not None and gsd.size == 1 else np.nan

    def draw_ground_square(ground: Float[np.ndarray, "2"], side_px: int, colour: str, is_valid: bool) -> None:
        centre = ((ground[0] - west) / pixel_m, (north - ground[1]) / pixel_m)
        _draw_square(axes, centre, side_px * spacing_m / pixel_m, colour, is_valid)

    for track in pair_tracks:
        ground = np.array([track.values.get(f"ground_{axis}_m", np.nan) for axis in ("east", "north")])
        if track.patch is None or track.window is None:
            continue
        if image_index == 0:
            draw_ground_square(ground, len(track.patch), TEMPLATE, track.valid)
        else:
            draw_ground_square(ground, len(track.window), WINDOW, True)
            if track.position is not None:
                # the window is centred on `ground`
                centre = 0.5 * (len(track.window) - 1)
                offset = np.array([track.position[1] - centre, centre - track.position[0]])
                draw_ground_square(ground + spacing_m * offset, len(track.patch), MATCH, track.valid)
    content = f": {('templates', 'search windows')[image_index]}" if pair_tracks else ""
    axes.set_title(f"Image {pair + image_index + 1}, rectified{content}", fontsize=9)


def _rectify(image: Image, lattice: Float[np.ndarray, "n n 2"]) -> Float[np.ndarray, "m m"]:
    """Rectify an image by a square lattice of ground points with their pixels (u, v); NaN outside the image."""
    indices = np.linspace(0.0, lattice.shape[0] - 1.0, _RECTIFIED_PX)
    v, u = np.meshgrid(indices, indices, indexing="ij")
    pixels = [ndimage.map_coordinates(lattice[..., component], [v, u], order=1, mode="nearest") for component in (1, 0)]
    rows, columns = image.shape
    is_inside = (pixels[0] >= -0.5) & (pixels[0] <= rows - 0.5) & (pixels[1] >= -0.5) & (pixels[1] <= columns - 0.5)
    values = ndimage.map_coordinates(image, np.nan_to_num(pixels, nan=-1.0), order=1, mode="nearest")
    return np.asarray(np.where(is_inside, values, np.nan))


def _draw_template_window(axes: Sequence[Axes], track: Track) -> None:
    """Draw the template and the search window of a track on two axes, and the match in the window."""
    line = "-" if track.valid else _DASHED
    template_title, window_title = (f"{name} {track.template + 1}" for name in ("Template", "Search window"))
    parts = ((track.patch, template_title, TEMPLATE, line), (track.window, window_title, WINDOW, "-"))
    for panel, (image, title, colour, style) in zip(axes, parts, strict=True):
        if image is None:
            panel.set_axis_off()
            continue
        show_subframe(panel, image)
        panel.set_facecolor(INK)
        panel.spines[:].set(visible=True, edgecolor=colour, linewidth=2.2, linestyle=style)
        panel.set_title(title, fontsize=9)
    if track.position is not None and track.patch is not None and track.window is not None:
        _draw_square(axes[1], track.position[::-1], float(len(track.patch)), MATCH, track.valid)


def _mark_tracks(axes: Axes, pair_tracks: Sequence[Track], prefix: str, colour: str) -> None:
    """Draw squares with template numbers at the `template` or `match` pixels (`prefix`) of the tracks."""
    box = {"facecolor": "#000000", "alpha": 0.55, "pad": 1.0, "linewidth": 0.0}
    for track in pair_tracks:
        u, v = track.values.get(f"{prefix}_u", np.nan), track.values.get(f"{prefix}_v", np.nan)
        side_px = track.values.get("template_side_px", _DEFAULT_SIDE_PX)
        if np.isfinite((u, v)).all():
            _draw_square(axes, (u, v), side_px, colour, track.valid)
            axes.annotate(
                str(track.template + 1), (u, v - side_px / 2), xytext=(0, 3), textcoords="offset points", ha="center",
                va="bottom", color=colour, fontsize=9, fontweight="bold", annotation_clip=True, bbox=box,
            )  # fmt: skip


def _outline_overlap(axes: Axes, products: Mapping[str, Any], pair: int, image_index: int) -> None:
    """Outline the overlap in the first image, and mark the zero-phase point (direction opposite to the sun)."""
    shape = axes.get_images()[0].get_size()
    polygon = _visible_overlap(products, pair, shape) if image_index == 0 else None
    if polygon is not None:
        axes.add_patch(Polygon(polygon, fill=False, edgecolor="#f2e35a", linewidth=0.9, linestyle=":"))
    zero_phase = _visible_zero_phase(products, pair, image_index, shape)
    if zero_phase is not None:
        axes.plot([zero_phase[0]], [zero_phase[1]], marker="x", color="#f2e35a", markersize=7)


def _visible_overlap(products: Mapping[str, Any], pair: int, shape: tuple[int, ...]) -> Float[np.ndarray, "_ 2"] | None:
    """Return the outline of the overlap (u, v) in the first image of a pair; None if no part of it is in the image."""
    polygon = to_matrix(products.get(f"overlap_{pair}"))
    if polygon is None or polygon.shape[1] != 2 or not np.isfinite(polygon).all():
        return None
    outline, image_box = (
        Outline(np.vstack([polygon, polygon[:1]])),
        Bbox([[-0.5, -0.5], [shape[1] - 0.5, shape[0] - 0.5]]),
    )
    return polygon if outline.intersects_bbox(image_box, filled=False) else None


def _visible_zero_phase(
    products: Mapping[str, Any], pair: int, image_index: int, shape: tuple[int, ...]
) -> tuple[float, float] | None:
    """Return the zero-phase point (u, v) in an image of a pair; None if it is not in the image."""
    pixels = to_matrix(products.get(f"zero_phase_{pair}"))
    if pixels is None or pixels.shape != (2, 2):
        return None
    u, v = (float(value) for value in pixels[image_index])
    return (u, v) if 0 <= u < shape[1] and 0 <= v < shape[0] else None


def _draw_square(axes: Axes, centre: tuple[float, float], side: float, colour: str, is_valid: bool) -> None:
    if np.isfinite([*centre, side]).all():
        corner, line = (centre[0] - side / 2, centre[1] - side / 2), "-" if is_valid else _DASHED
        axes.add_patch(Rectangle(corner, side, side, fill=False, edgecolor=colour, linewidth=1.8, linestyle=line))


def _read_image(products: Mapping[str, Any], key: str) -> Image:
    """Read an image and average its columns to square pixels; raises ValueError if the image is missing."""
    counts = to_matrix(products.get(key))
    if counts is None:
        raise ValueError(f"the products contain no image '{key}'")
    rows, binning = len(counts), column_binning(counts)
    if binning == 1:
        return counts
    return np.asarray(counts.reshape(rows, rows, binning).mean(axis=2), dtype=np.float64)


def column_binning(counts: Image) -> int:
    """Return the number of columns that are averaged for square pixels."""
    rows, columns = counts.shape
    return columns // rows if columns >= rows and columns % rows == 0 else 1
