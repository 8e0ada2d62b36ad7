"""Pictures of a real case with matched features, and their offsets from the measured poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.figure import Figure

from marsyard.reports.presentation import numbers, plane
from marsyard.reports.svg import MUTED, in_page_style, show_picture
from marsyard.reports.wording import number

#: Upper end of the colour scale of residuals.
_MAX_COLOUR_PX = 3.0
_COLOURS = "plasma"
_WRONG = "#c9d1d9"
#: Numbers of a case's pictures.
_PICTURES = range(1, 100)


@dataclass(frozen=True)
class MatchedPair:
    """Two pictures and the features matched between them.

    number: of the earlier picture, from 1.
    pictures: both pictures, counts.
    pixels: (u, v) of each match in both.
    offsets: position in the later picture minus the position by the poses, pixels.
    right: whether a rigid motion explains the match.
    """

    number: int
    pictures: tuple[Float[np.ndarray, "_ _"], Float[np.ndarray, "_ _"]]
    pixels: Float[np.ndarray, "n 2 2"]
    offsets: Float[np.ndarray, "n 2"]
    right: Bool[np.ndarray, " n"]

    @property
    def residuals_px(self) -> Float[np.ndarray, " k"]:
        """Lengths of the offsets of the right matches; those out of view count as infinite."""
        lengths = np.hypot(*self.offsets[self.right].T)
        return np.asarray(np.where(np.isfinite(lengths), lengths, np.inf))

    @property
    def caption(self) -> str:
        """Caption of the pair."""
        residuals = self.residuals_px
        median = f", median residual {number(float(np.median(residuals)))} px" if residuals.size else ""
        return f"Pictures {self.number} and {self.number + 1}: {residuals.size:,} matches{median}"


def matched_pairs(products: Mapping[str, Any]) -> list[MatchedPair]:
    """Readable pairs of a case's products."""
    pairs = []
    for k in _PICTURES:
        table = numbers(products.get(f"matches_{k}"))
        first, second = (plane(products.get(f"image_{one}")) for one in (k, k + 1))
        if table is not None and table.ndim == 2 and table.shape[1] == 7 and first is not None and second is not None:
            pixels, right = table[:, :4].reshape(-1, 2, 2), table[:, 6] > 0.0
            pairs.append(MatchedPair(k, (first, second), pixels, table[:, 4:6], right))
    return pairs


@in_page_style
def draw_pair(pair: MatchedPair) -> Figure:
    """Draw both pictures with the matches, coloured by their residuals, and the offsets."""
    figure = Figure(figsize=(12.0, 5.2), layout="constrained")
    left, right, scatter = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 0.8))
    offsets = pair.offsets[pair.right]
    lengths = np.hypot(*offsets.T)
    style: dict[str, Any] = {"c": lengths, "s": 12.0, "cmap": _COLOURS, "vmin": 0.0, "vmax": _MAX_COLOUR_PX}
    for side, axes in enumerate((left, right)):
        show_picture(axes, pair.pictures[side])
        axes.plot(*pair.pixels[~pair.right, side].T, "x", markersize=4.0, color=_WRONG, markeredgewidth=0.8)
        drawn = axes.scatter(*pair.pixels[pair.right, side].T, linewidths=0.0, **style)
        axes.set_title(f"Picture {pair.number + side}", fontsize=9)
    bar: dict[str, Any] = {"location": "bottom", "shrink": 0.5, "aspect": 40, "extend": "max"}
    figure.colorbar(drawn, ax=[left, right], label="residual (px)", **bar)
    finite = lengths[np.isfinite(lengths)]
    reach = max(_MAX_COLOUR_PX, 1.5 * float(np.quantile(finite, 0.9))) if finite.size else _MAX_COLOUR_PX
    scatter.scatter(*offsets.T, linewidths=0.0, **style)
    for line in (scatter.axhline, scatter.axvline):
        line(0.0, color=MUTED, linewidth=0.8)
    # rows grow downwards
    scatter.set(xlim=(-reach, reach), ylim=(reach, -reach), aspect="equal")
    scatter.set(xlabel="to the right (px)", ylabel="down (px)")
    beyond = int(np.count_nonzero(~np.all(np.abs(offsets) <= reach, axis=1)))
    scatter.set_title("Offsets" + (f", {beyond} beyond" if beyond else ""), fontsize=9)
    return figure
