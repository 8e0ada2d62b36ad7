"""Style of the figures of reports: colours, markers, the page's matplotlib style, and SVG in the page's theme."""

import base64
import functools
import io
import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from html import escape
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import cv2
import matplotlib as mpl
import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

P = ParamSpec("P")
R = TypeVar("R")
#: Colours in which matplotlib draws the figures, and the CSS colours of the page that replace them.
INK, MUTED, GRID = "#10161d", "#5a6672", "#d3d9e0"
_THEME = {INK: "var(--ink)", MUTED: "var(--muted)", GRID: "var(--line)"}
#: Colours and markers of categories. The colours are those of Okabe & Ito's palette for colour-blind readers, adjusted
#: to a contrast of 3:1 on the light and the dark page. Colour is never the only distinction.
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
#: Maximum number of points drawn as vectors; more points are drawn as pixels, to keep pages small.
MAX_VECTOR_POINTS = 800
#: Dots per inch of elements drawn as pixels: twice the resolution of a screen.
RASTER_DPI = 160
#: Images that matplotlib writes into an SVG. From this size they are photographs; plots and maps of cells are smaller.
_EMBEDDED_PNG, _MIN_COMPRESSED_BYTES = re.compile(r"data:image/png;base64,([\w+/=\s]+)"), 64_000
#: Quality of compressed images (assumed: artefacts are below the noise of the detectors).
_WEBP_QUALITY = 70
_STYLE_FILE = Path(__file__).parent / "templates" / "page.mplstyle"


def in_page_style(draw: Callable[P, R]) -> Callable[P, R]:
    """Decorate a drawing function to use the page's style instead of the user's matplotlib style."""

    @functools.wraps(draw)
    def apply_style(*args: P.args, **kwargs: P.kwargs) -> R:
        with _page_style():
            return draw(*args, **kwargs)

    return apply_style


@contextmanager
def _page_style(**changes: str) -> Iterator[None]:
    """Apply the page's style in a context; ignore warnings about characters that are missing from the font."""
    with mpl.rc_context(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # without the checks of `mpl.style.context`, which take 20 ms for each figure
        settings: Any = mpl.rcParams
        dict.update(settings, {**_style_values(), **changes})
        yield


@functools.cache
def _style_values() -> dict[str, Any]:
    """Return matplotlib's settings in the page's style."""
    with mpl.style.context(["default", _STYLE_FILE]):
        return {name: value for name, value in dict.items(mpl.rcParams) if name != "backend"}


def new_axes(width: float, height: float) -> tuple[Figure, Axes]:
    """Create a figure with one pair of axes, size in inches; the caller must be decorated with `in_page_style`."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.add_subplot()


def svg_markup(figure: Figure, key: str, description: str) -> str:
    """Convert a figure to an SVG element of a page; its texts must be set through matplotlib, which escapes them.

    key: letters and digits, unique on the page; prefix of the identifiers in the SVG
    description: text for readers who cannot see the figure
    """
    buffer = io.StringIO()
    metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    with _page_style(**{"svg.hashsalt": key, "svg.fonttype": "none"}):
        figure.savefig(buffer, format="svg", dpi=RASTER_DPI, metadata=metadata)
    markup = buffer.getvalue()
    body = _EMBEDDED_PNG.sub(_compress_image, markup[markup.index("<svg") :])
    view_box = re.search(r'viewBox="[^"]*"', body)
    content = re.sub(r' id="([^"]*)"', rf' id="{key}-\1"', body[body.index(">") + 1 :])
    content = re.sub(r'(href="|url\()#', rf"\1#{key}-", content)
    for drawn_colour, page_colour in _THEME.items():
        content = content.replace(drawn_colour, page_colour)
    head = (
        f'<svg role="img" aria-label="{escape(description, quote=True)}" {view_box[0] if view_box else ""} '
        'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink">'
    )
    return head + content.strip()


def _compress_image(embedded: re.Match[str]) -> str:
    """Compress a large image of an SVG, with its transparency, to about a quarter; the run stores the exact image."""
    png = base64.b64decode(embedded[1])
    if len(png) < _MIN_COMPRESSED_BYTES:
        return embedded[0]
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    _, webp = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, _WEBP_QUALITY])
    return f"data:image/webp;base64,{base64.b64encode(webp.tobytes()).decode()}"


def hide_frame(axes: Axes) -> None:
    """Remove ticks, grid and frame of axes."""
    axes.set(xticks=[], yticks=[])
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
