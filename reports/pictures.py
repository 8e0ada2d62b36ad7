"""A picture of a case as figures show it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from reports.svg import INK


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
