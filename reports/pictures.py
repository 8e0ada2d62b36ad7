"""Pictures of a case as figures show them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from marsyard.reports.svg import INK, in_page_style

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
