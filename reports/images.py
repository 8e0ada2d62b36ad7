"""Images of a case: panels, which a system fills with images, points, lines and labels, and a preview."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase

from marsyard.reports.figure_style import INK, hide_frame, in_page_style
from marsyard.reports.products import Products

Image = Float[np.ndarray, "_ _"]
Pixels = Float[np.ndarray, "... 2"]
#: Pixels of an image up to this side are drawn one by one; a larger image is reduced to the resolution of the figure.
_MAX_SIDE_PX = 512
#: Dash pattern of marks of a second kind: offset, and lengths of dash and gap.
DASHED = (0, (2, 1.5))
_LABEL_BOX = {"facecolor": "#000000", "alpha": 0.55, "pad": 1.0, "linewidth": 0.0}


@dataclass(frozen=True)
class Mark:
    """Marks at pixels (u, v) in matplotlib's style of a line, whose `label` is the name in the legend.

    - pixels: shape (n, 2): n points; shape (k, n, 2): n lines through k points
    - text: label above the upper end of the mark; may be empty
    """

    pixels: Pixels
    style: Mapping[str, Any]
    text: str = ""


@dataclass(frozen=True)
class Panel:
    """An image with its title and marks.

    - image: values of the pixels, NaN where unknown; None for a panel without an image
    - frame: properties of the lines around the image; empty for no frame
    - text: text of a panel without an image
    - contrast: quantiles of the values that are drawn black and white
    - title_style: properties of the title
    """

    image: Image | None = None
    title: str = ""
    marks: Sequence[Mark] = ()
    frame: Mapping[str, Any] = field(default_factory=dict)
    text: str = ""
    contrast: tuple[float, float] = (0.01, 0.99)
    title_style: Mapping[str, Any] = field(default_factory=dict)


#: Rows of panels. A panel that is in several adjacent cells extends over them.
PanelRows = Sequence[Sequence[Panel]]


def box(corner: Float[np.ndarray, "2"], size: Float[np.ndarray, "2"], style: Mapping[str, Any], text: str = "") -> Mark:
    """Create the outline of a rectangle from its corner with the smallest pixel coordinates."""
    corners = corner + size * np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0), (0.0, 0.0)])
    return Mark(corners[:, None], style, text)


def square(centre: Float[np.ndarray, "2"], side: float, style: Mapping[str, Any], text: str = "") -> list[Mark]:
    """Create the outline of a square; empty if its position or its side is unknown."""
    is_known = np.isfinite([*centre, side]).all()
    return [box(centre - 0.5 * side, np.full(2, side), style, text)] if is_known else []


@in_page_style
def draw_panels(rows: PanelRows, size_in: tuple[float, float], heights: Sequence[float] | None = None) -> Figure:
    """Draw panels in a figure of a size in inches; `heights` are the relative heights of the rows."""
    figure = Figure(figsize=size_in, layout="constrained")
    fill_panels(figure, rows, heights)
    return figure


def fill_panels(figure: FigureBase, rows: PanelRows, heights: Sequence[float] | None = None) -> None:
    """Draw panels in a figure, or in a part of one; the caller must be decorated with `in_page_style`."""
    panels = {id(panel): panel for row in rows for panel in row}
    axes = figure.subplot_mosaic([[id(panel) for panel in row] for row in rows], height_ratios=heights)
    for key, panel in panels.items():
        _draw_panel(axes[key], panel)


def _draw_panel(axes: Axes, panel: Panel) -> None:
    if panel.image is None:
        axes.set_axis_off()
        axes.text(0.5, 0.5, panel.text, ha="center", va="center", color=INK, fontsize=9, fontweight="bold")
        return
    show_image(axes, panel.image, panel.contrast)
    if panel.frame:
        axes.spines[:].set(visible=True, **panel.frame)
    for mark in panel.marks:
        axes.plot(*np.moveaxis(mark.pixels, -1, 0), **mark.style)
        if mark.text:
            points = mark.pixels.reshape(-1, 2)
            top = 0.5 * (points[:, 0].min() + points[:, 0].max()), points[:, 1].min()
            axes.annotate(
                mark.text, top, xytext=(0, 3), textcoords="offset points", ha="center", va="bottom", fontsize=9,
                color=mark.style["color"], fontweight="bold", annotation_clip=True, bbox=_LABEL_BOX,
            )  # fmt: skip
    axes.set_title(panel.title, **{"fontsize": 9, **panel.title_style})


def show_image(axes: Axes, image: Image, contrast: tuple[float, float] = (0.01, 0.99)) -> None:
    """Draw an image in grey, its contrast stretched between two quantiles; unknown pixels are dark."""
    finite = image[np.isfinite(image)]
    low, high = np.quantile(finite, contrast) if finite.size else (0.0, 1.0)
    levels = np.clip((np.nan_to_num(image, nan=low) - low) / max(float(high - low), 1e-9), 0.0, 1.0)
    grey = np.round(255.0 * levels).astype(np.uint8)
    interpolation = "none" if max(image.shape) <= _MAX_SIDE_PX else "antialiased"
    axes.imshow(np.repeat(grey[..., None], 3, axis=2), interpolation=interpolation, aspect="equal")
    axes.set_facecolor(INK)
    axes.autoscale(enable=False)
    hide_frame(axes)


def draw_images(images: Sequence[Image]) -> Figure:
    """Draw numbered images in a row, for a case without details of the algorithm."""
    rows, columns = images[0].shape
    panels = [Panel(image, f"Image {number}") for number, image in enumerate(images, start=1)]
    return draw_panels([panels], (12.0, 12.0 / len(images) * rows / columns + 0.35))


#: Size of thumbnails, pixels, and their JPEG quality.
_THUMBNAIL_PX, _THUMBNAIL_QUALITY = 96, 70
#: Minimum size of an image, pixels. From this ratio of its sides, an image has binned rows or columns: it is scaled to
#: a square, not cropped.
_MIN_IMAGE_PX, _MAX_ASPECT = 48, 2.0


def thumbnail(products: Products) -> str:
    """Return a square preview of a case's last image as a data URI; empty if the products contain no image.

    An image is a product at the top level with integer values and two dimensions.
    """
    images = [value for value in products.values() if isinstance(value, np.ndarray) and value.ndim == 2]
    images = [image for image in images if np.issubdtype(image.dtype, np.integer) and min(image.shape) >= _MIN_IMAGE_PX]
    if not images:
        return ""
    image = images[-1].astype(np.float32)
    rows, columns = image.shape
    if columns < _MAX_ASPECT * rows and rows < _MAX_ASPECT * columns:
        size = min(rows, columns)
        top, left = (rows - size) // 2, (columns - size) // 2
        image = image[top : top + size, left : left + size]
    low, high = np.percentile(image, (1.0, 99.0))
    small = cv2.resize(image, (_THUMBNAIL_PX, _THUMBNAIL_PX), interpolation=cv2.INTER_AREA)
    grey = np.clip((small - low) * (255.0 / max(high - low, 1.0)), 0.0, 255.0).astype(np.uint8)
    _, jpeg = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, _THUMBNAIL_QUALITY])
    return f"data:image/jpeg;base64,{base64.b64encode(jpeg.tobytes()).decode()}"
