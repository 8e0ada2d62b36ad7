"""Figures as inline SVG: the same bytes for the same rows, with ink that follows the page's light or dark colours."""

from __future__ import annotations

import functools
import io
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from html import escape
from typing import ParamSpec, TypeVar

import matplotlib as mpl
import matplotlib.style
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

P = ParamSpec("P")
R = TypeVar("R")

#: Stand-ins that figures are drawn with and the page's own colours that take their place.
INK, MUTED, GRID = "#10161d", "#5a6672", "#d3d9e0"
_THEME = {INK: "var(--ink)", MUTED: "var(--muted)", GRID: "var(--line)"}

#: Colours and markers of categories. After Okabe & Ito's palette for colour-blind readers, shifted to middle tones that
#: keep a contrast of 3:1 on white and on the dark page alike; no category is told by its colour alone.
SERIES = ("#2f83d6", "#cf6a14", "#1c9a76", "#b262b2", "#9c7f12", "#78838f")
MARKERS = ("o", "^", "s", "D", "v", "P")
REQUIREMENT = "#d0392f"

#: Points above this number are drawn as pixels rather than as vectors, to keep pages small.
LARGEST_VECTOR_SAMPLE = 800
#: Dots per inch of what is drawn as pixels: twice the size on a screen, and fit to be printed.
RASTER_DPI = 160

_STYLE = {
    "axes.axisbelow": True,
    "axes.edgecolor": MUTED,
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.labelsize": 10,
    "axes.linewidth": 0.8,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlecolor": INK,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "font.family": "sans-serif",
    "font.size": 10,
    "grid.color": GRID,
    "grid.linewidth": 0.7,
    "hatch.linewidth": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "legend.labelcolor": INK,
    "path.simplify": True,
    "savefig.facecolor": "none",
    "text.color": INK,
    "text.parse_math": False,
    "xtick.color": MUTED,
    "xtick.labelcolor": INK,
    "xtick.labelsize": 9,
    "ytick.color": MUTED,
    "ytick.labelcolor": INK,
    "ytick.labelsize": 9,
}


def in_page_style(draw: Callable[P, R]) -> Callable[P, R]:
    """Makes a function draw in the page's style, whatever the reader's own settings of matplotlib are."""

    @functools.wraps(draw)
    def styled(*args: P.args, **kwargs: P.kwargs) -> R:
        with _page_style():
            return draw(*args, **kwargs)

    return styled


@contextmanager
def _page_style(**further: str) -> Iterator[None]:
    """The page's style; what matplotlib finds wrong with a text (a letter that its font lacks) is not worth a word."""
    with mpl.style.context(["default", _STYLE, further]), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def new_axes(width: float, height: float) -> tuple[Figure, Axes]:
    """A figure of one pair of axes, in inches; to be called in the page's style."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.add_subplot()


def svg_markup(figure: Figure, key: str, description: str) -> str:
    """The figure as an SVG element to put into a page.

    Parameters
    ----------
    figure
        The figure.
    key
        Letters and digits that no other figure of the page has: they keep the identifiers inside apart.
    description
        What a reader who cannot see the figure is told.

    Notes
    -----
    Texts in the figure are escaped by matplotlib; they must have been set through its API.
    """
    buffer = io.StringIO()
    metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    with _page_style(**{"svg.hashsalt": key, "svg.fonttype": "none"}):
        figure.savefig(buffer, format="svg", dpi=RASTER_DPI, metadata=metadata)
    return _for_page(buffer.getvalue(), key, description)


def _for_page(markup: str, key: str, description: str) -> str:
    """Drops the file's head and fixed size, renames identifiers, and hands the ink to the page."""
    body = markup[markup.index("<svg") :]
    view_box = re.search(r'viewBox="[^"]*"', body)
    inner = body[body.index(">") + 1 :]
    inner = re.sub(r' id="([^"]*)"', rf' id="{key}-\1"', inner)
    inner = re.sub(r'(href="|url\()#', rf"\1#{key}-", inner)
    for stand_in, colour in _THEME.items():
        inner = inner.replace(stand_in, colour)
    head = (
        f'<svg role="img" aria-label="{escape(description, quote=True)}" {view_box[0] if view_box else ""} '
        'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink">'
    )
    return head + inner.strip()


#: Width of a row of pictures, and height of its titles, inches.
_ROW_IN = (12.0, 0.35)


def show_picture(axes: Axes, picture: Float[np.ndarray, "_ _"]) -> None:
    """A picture in grey, its contrast stretched between the 1 % and the 99 % quantile."""
    finite = picture[np.isfinite(picture)]
    low, high = np.quantile(finite, (0.01, 0.99)) if finite.size else (0.0, 1.0)
    axes.imshow(picture, cmap="gray", vmin=low, vmax=max(high, low + 1e-9), interpolation="antialiased")
    axes.set(xticks=[], yticks=[], facecolor=INK)
    axes.autoscale(enable=False)
    axes.grid(visible=False)
    for spine in axes.spines.values():
        spine.set_visible(False)


@in_page_style
def draw_pictures(pictures: Sequence[Float[np.ndarray, "_ _"]]) -> Figure:
    """Pictures in a row, numbered, as they were delivered: of a case whose algorithm left no details to draw."""
    width, title = _ROW_IN
    rows, columns = pictures[0].shape
    figure = Figure(figsize=(width, width / len(pictures) * rows / columns + title), layout="constrained")
    for number, (axes, picture) in enumerate(zip(figure.subplots(1, len(pictures)), pictures, strict=True), start=1):
        show_picture(axes, picture)
        axes.set_title(f"Picture {number}", fontsize=9)
    return figure
