"""Figures of one DIMES case, laid out as Figs. 7 to 9 of the field test's paper (`papers/dimes-field-test.txt`).

Top row: the images rectified to a nadir view, with search windows (blue). Middle row: the correlated templates and
windows, which the paper does not show. Bottom row: the images as delivered, with templates (red) and tracked positions
(green). Dashed squares mark tracks that failed a validity check.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.path import Path as Outline
from matplotlib.transforms import Bbox
from scipy import ndimage

from marsyard.reports.images import DASHED, Image, Mark, Panel, draw_images, draw_panels, square
from marsyard.reports.products import Products, array_of_shape, numeric_product, to_matrix

#: Colours of templates, matches and search windows, and of the overlap and the zero-phase point.
TEMPLATE, MATCH, WINDOW, HINT = "#ff4b3e", "#35d46b", "#4aa3ff", "#f2e35a"
#: Side of a template's square on a delivered image if the products do not contain the side, pixels.
_DEFAULT_SIDE_PX = 15.0
_PAIRS = (0, 1)
_MAX_TRACKS = 2
#: Relative heights of the rows of a pair's figure, inches per unit (a figure with all rows is 8.3 in high), and cells
#: of a row.
_ROW_HEIGHTS = {"rectified": 1.95, "templates": 1.0, "delivered": 1.95}
_IN_PER_UNIT, _CELLS = 8.3 / 4.9, 2 * _MAX_TRACKS
#: Side of a rectified image as drawn, pixels.
_RECTIFIED_PX = 384
#: Valid template numbers. The figure shows at most `_MAX_TRACKS` templates per pair; the table lists all.
_TEMPLATE_NUMBERS = range(100)


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
    position: Float[np.ndarray, "2"] | None

    def style(self, colour: str) -> dict[str, Any]:
        """Style of the track's squares of a colour."""
        return {"color": colour, "linewidth": 1.8, "linestyle": "-" if self.valid else DASHED}

    def pixel(self, prefix: str) -> Float[np.ndarray, "2"]:
        """Column and row of the `template` or the `match` in the delivered image; NaN if unknown."""
        return np.array([self.values.get(f"{prefix}_{axis}", np.nan) for axis in "uv"])


def is_dimes_case(products: Products) -> bool:
    """Whether products contain the three images of a DIMES case."""
    return all(to_matrix(products.get(f"image_{number}")) is not None for number in (1, 2, 3))


def read_tracks(products: Products) -> list[Track]:
    """Read the tracks of a case; rows with an unknown pair or template are skipped."""
    table = array_of_shape(products.get("tracks"), None, None)
    names = [str(name) for name in np.asarray(products.get("tracks_columns", ())).ravel()]
    if table is None or table.shape[1] != len(names):
        return []
    tracks = []
    for row in (dict(zip(names, values, strict=True)) for values in table.tolist()):
        if row.get("pair") in _PAIRS and row.get("template") in _TEMPLATE_NUMBERS:
            pair, template = int(row["pair"]), int(row["template"])
            patch, window = (to_matrix(products.get(f"{part}_{pair}_{template}")) for part in ("template", "window"))
            position = array_of_shape(products.get(f"match_{pair}_{template}"), 2)
            tracks.append(Track(pair, template, row.get("valid", 0.0) == 1.0, row, patch, window, position))
    return tracks


def draw_dimes_case(products: Products, pairs: Sequence[int] = _PAIRS) -> Figure:
    """Draw image pairs of a case (0 or 1) side by side; raises ValueError without their images."""
    rows_of_pairs = [_arrange_pair(products, pair) for pair in pairs]
    heights = {name: height for name, height in _ROW_HEIGHTS.items() if any(name in rows for rows in rows_of_pairs)}
    rows = [
        [panel for rows in rows_of_pairs for panel in rows.get(name, [Panel() for _ in range(_CELLS)])]
        for name in heights
    ]
    size_in = (6.0 * len(pairs), _IN_PER_UNIT * sum(heights.values()))
    return draw_panels(rows, size_in, [*heights.values()])


def _arrange_pair(products: Products, pair: int) -> dict[str, list[Panel]]:
    """Create the non-empty rows of panels of a pair, from top to bottom."""
    images = [read_square_image(products, f"image_{number}") for number in (pair + 1, pair + 2)]
    tracks = _drawn_tracks(products, pair)
    lattices = [array_of_shape(products.get(f"rectified_{pair}_{index}"), None, None, 2) for index in (0, 1)]
    rows = {}
    if any(lattice is not None for lattice in lattices):
        panels = [_rectified_panel(products, images[index], lattices[index], tracks, pair, index) for index in (0, 1)]
        rows["rectified"] = _spread(panels)
    if any(track.patch is not None for track in tracks):
        panels = [panel for track in tracks for panel in _template_panels(track)]
        rows["templates"] = panels + [Panel() for _ in range(_CELLS - len(panels))]
    delivered = []
    templates, matches = ("template", TEMPLATE, "templates"), ("match", MATCH, "tracked positions")
    for index, (prefix, colour, name) in enumerate((templates, matches)):
        marks = [mark for track in tracks for mark in _track_marks(track, prefix, colour)]
        marks += _hint_marks(products, pair, index, images[index].shape)
        content = f": {name}" if tracks else ""
        delivered.append(Panel(images[index], f"Image {pair + index + 1}{content}", marks))
    return rows | {"delivered": _spread(delivered)}


def _spread(panels: Sequence[Panel]) -> list[Panel]:
    """Extend panels over the cells of a row."""
    return [panel for panel in panels for _ in range(_CELLS // len(panels))]


def _drawn_tracks(products: Products, pair: int) -> list[Track]:
    return [track for track in read_tracks(products) if track.pair == pair][:_MAX_TRACKS]


def describe_marks(products: Products, pair: int) -> str:
    """Describe the marks in the figure of an image pair; marks that are not in the figure are omitted."""
    earlier, later = pair + 1, pair + 2
    tracks = _drawn_tracks(products, pair)
    texts = [f"Red: templates in image {earlier}."] if tracks else ["No templates."]
    if any(track.window is not None for track in tracks):
        texts.append(f"Blue: search windows in image {later}.")
    if any(track.position is not None or np.isfinite(track.pixel("match")[0]) for track in tracks):
        texts.append(f"Green: tracked positions in image {later}.")
    if not all(track.valid for track in tracks):
        texts.append("Dashed: the template failed a validity check.")
    shapes = [read_square_image(products, f"image_{number}").shape for number in (earlier, later)]
    if _visible_overlap(products, pair, shapes[0]) is not None:
        texts.append(f"Dotted yellow line: border of the overlap with image {later}, if there is no horizontal motion.")
    if any(_visible_zero_phase(products, pair, index, shape) is not None for index, shape in enumerate(shapes)):
        texts.append("Yellow cross: point opposite to the sun; no template is placed near it.")
    return " ".join(texts)


def draw_delivered_images(products: Products) -> Figure:
    """Draw the three images, binned to square pixels; raises ValueError if one is missing."""
    return draw_images([read_square_image(products, f"image_{number}") for number in (1, 2, 3)])


def _rectified_panel(
    products: Products, image: Image, lattice: Float[np.ndarray, "n n 2"] | None, tracks: Sequence[Track], pair: int,
    index: int,
) -> Panel:  # fmt: skip
    """Create the panel of a rectified image with its templates (first image) or windows and matches (second image).

    `rectified_frame_<pair>` contains west and north edge and spacing of the lattice, metres; `gsd_<pair>` is the pixel
    size of templates and windows, metres (`marsyard.algorithms.dimes.products`).
    """
    frame = array_of_shape(products.get(f"rectified_frame_{pair}"), 3)
    gsd = numeric_product(products.get(f"gsd_{pair}"))
    if lattice is None or frame is None:
        return Panel()
    rectified = _rectify(image, lattice)
    west_m, north_m, lattice_spacing_m = frame
    # positions to the right and downwards, as pixels
    corner_m = np.array([west_m, -north_m])
    pixel_m = lattice_spacing_m * (lattice.shape[0] - 1) / (rectified.shape[0] - 1)
    spacing_m = float(gsd[0]) if gsd is not None and gsd.size == 1 else np.nan

    def ground_square(ground_m: Float[np.ndarray, "2"], side_px: int, style: Mapping[str, Any]) -> list[Mark]:
        centre = (ground_m * np.array([1.0, -1.0]) - corner_m) / pixel_m
        return square(centre, side_px * spacing_m / pixel_m, style)

    marks = []
    for track in tracks:
        ground_m = np.array([track.values.get(f"ground_{axis}_m", np.nan) for axis in ("east", "north")])
        if track.patch is None or track.window is None:
            continue
        if index == 0:
            marks += ground_square(ground_m, len(track.patch), track.style(TEMPLATE))
            continue
        marks += ground_square(ground_m, len(track.window), {"color": WINDOW, "linewidth": 1.8})
        if track.position is not None:
            # the window is centred on `ground_m`; rows increase to the south
            offset = (track.position[::-1] - 0.5 * (len(track.window) - 1)) * np.array([1.0, -1.0])
            marks += ground_square(ground_m + spacing_m * offset, len(track.patch), track.style(MATCH))
    content = f": {('templates', 'search windows')[index]}" if tracks else ""
    return Panel(rectified, f"Image {pair + index + 1}, rectified{content}", marks)


def _rectify(image: Image, lattice: Float[np.ndarray, "n n 2"]) -> Float[np.ndarray, "m m"]:
    """Rectify an image by a square lattice of ground points with their pixels (u, v); NaN outside the image."""
    indices = np.linspace(0.0, lattice.shape[0] - 1.0, _RECTIFIED_PX)
    v, u = np.meshgrid(indices, indices, indexing="ij")
    row, column = (
        ndimage.map_coordinates(lattice[..., component], [v, u], order=1, mode="nearest") for component in (1, 0)
    )
    rows, columns = image.shape
    is_inside = (row >= -0.5) & (row <= rows - 0.5) & (column >= -0.5) & (column <= columns - 0.5)
    values = ndimage.map_coordinates(image, np.nan_to_num([row, column], nan=-1.0), order=1, mode="nearest")
    return np.asarray(np.where(is_inside, values, np.nan))


def _template_panels(track: Track) -> list[Panel]:
    """Create the panels of the template and of the search window of a track, with the match in the window."""
    frame: dict[str, Any] = {"edgecolor": TEMPLATE, "linewidth": 2.2, "linestyle": "-" if track.valid else DASHED}
    marks: list[Mark] = []
    if track.position is not None and track.patch is not None:
        marks = square(track.position[::-1], float(len(track.patch)), track.style(MATCH))
    template = Panel(track.patch, f"Template {track.template + 1}", frame=frame)
    window_frame = {"edgecolor": WINDOW, "linewidth": 2.2}
    return [template, Panel(track.window, f"Search window {track.template + 1}", marks, window_frame)]


def _track_marks(track: Track, prefix: str, colour: str) -> list[Mark]:
    """Create the square with the template's number at the `template` or `match` pixel (`prefix`) of a track."""
    side_px = track.values.get("template_side_px", _DEFAULT_SIDE_PX)
    return square(track.pixel(prefix), side_px, track.style(colour), str(track.template + 1))


def _hint_marks(products: Products, pair: int, index: int, shape: tuple[int, ...]) -> list[Mark]:
    """Create the outline of the overlap in the first image, and the zero-phase point (opposite to the sun)."""
    marks = []
    polygon = _visible_overlap(products, pair, shape) if index == 0 else None
    if polygon is not None:
        outline = np.vstack([polygon, polygon[:1]])[:, None]
        marks.append(Mark(outline, {"color": HINT, "linewidth": 0.9, "linestyle": ":"}))
    zero_phase = _visible_zero_phase(products, pair, index, shape)
    if zero_phase is not None:
        marks.append(Mark(zero_phase[None], {"color": HINT, "marker": "x", "markersize": 7}))
    return marks


def _visible_overlap(products: Products, pair: int, shape: tuple[int, ...]) -> Float[np.ndarray, "_ 2"] | None:
    """Return the outline of the overlap (u, v) in the first image of a pair; None if no part of it is in the image."""
    polygon = array_of_shape(products.get(f"overlap_{pair}"), None, 2)
    if polygon is None or not polygon.size or not np.isfinite(polygon).all():
        return None
    image_box = Bbox([[-0.5, -0.5], [shape[1] - 0.5, shape[0] - 0.5]])
    return polygon if Outline(np.vstack([polygon, polygon[:1]])).intersects_bbox(image_box, filled=False) else None


def _visible_zero_phase(
    products: Products, pair: int, index: int, shape: tuple[int, ...]
) -> Float[np.ndarray, "2"] | None:
    """Return the zero-phase point (u, v) in an image of a pair; None if it is not in the image."""
    pixels = array_of_shape(products.get(f"zero_phase_{pair}"), 2, 2)
    if pixels is None:
        return None
    is_inside = ((pixels[index] >= 0.0) & (pixels[index] < shape[::-1])).all()
    return np.asarray(pixels[index]) if is_inside else None


def read_square_image(products: Products, key: str) -> Image:
    """Read an image and average its columns to square pixels; raises ValueError if the image is missing."""
    counts = to_matrix(products.get(key))
    if counts is None:
        raise ValueError(f"the products contain no image '{key}'")
    return np.asarray(counts.reshape(len(counts), -1, column_binning(counts)).mean(axis=2))


def column_binning(counts: Image) -> int:
    """Return the number of columns that are averaged for square pixels."""
    rows, columns = counts.shape
    return columns // rows if columns >= rows and columns % rows == 0 else 1
