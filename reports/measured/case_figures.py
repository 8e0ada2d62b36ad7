"""Pictures of a real case with matched features, and their offsets from the measured poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from marsyard.reports.presentation import numbers, plane, save_figures
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
    found = (_pair(products, place) for place in _PICTURES if f"matches_{place}" in products)
    return [pair for pair in found if pair is not None]


def _pair(products: Mapping[str, Any], place: int) -> MatchedPair | None:
    table = numbers(products.get(f"matches_{place}"))
    first, second = (plane(products.get(f"image_{number}")) for number in (place, place + 1))
    if table is None or table.ndim != 2 or table.shape[1] != 7 or first is None or second is None:
        return None
    return MatchedPair(place, (first, second), table[:, :4].reshape(-1, 2, 2), table[:, 4:6], table[:, 6] > 0.0)


def is_measured_case(products: Mapping[str, Any]) -> bool:
    """Whether products hold pictures with matches between them."""
    return bool(matched_pairs(products))


@in_page_style
def draw_pair(pair: MatchedPair) -> Figure:
    """Draw both pictures with the matches, coloured by their residuals, and the offsets."""
    figure = Figure(figsize=(12.0, 5.2), layout="constrained")
    left, right, scatter = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 0.8))
    lengths = np.hypot(*pair.offsets[pair.right].T)
    for side, axes in enumerate((left, right)):
        show_picture(axes, pair.pictures[side])
        wrong, good = pair.pixels[~pair.right, side], pair.pixels[pair.right, side]
        axes.plot(*wrong.T, "x", markersize=4.0, color=_WRONG, markeredgewidth=0.8)
        drawn = axes.scatter(
            good[:, 0], good[:, 1], c=lengths, s=12.0, cmap=_COLOURS, vmin=0.0, vmax=_MAX_COLOUR_PX, linewidths=0.0
        )
        axes.set_title(f"Picture {pair.number + side}", fontsize=9)
    figure.colorbar(
        drawn, ax=[left, right], location="bottom", shrink=0.5, aspect=40, label="residual (px)", extend="max"
    )
    _draw_offsets(scatter, pair, lengths)
    return figure


def _draw_offsets(axes: Axes, pair: MatchedPair, lengths: Float[np.ndarray, " k"]) -> None:
    """Draw offsets in the later picture; those beyond the axes are counted."""
    finite = lengths[np.isfinite(lengths)]
    reach = max(_MAX_COLOUR_PX, 1.5 * float(np.quantile(finite, 0.9))) if finite.size else _MAX_COLOUR_PX
    offsets = pair.offsets[pair.right]
    axes.scatter(
        offsets[:, 0], offsets[:, 1], c=lengths, s=12.0, cmap=_COLOURS, vmin=0.0, vmax=_MAX_COLOUR_PX, linewidths=0.0
    )
    for line in (axes.axhline, axes.axvline):
        line(0.0, color=MUTED, linewidth=0.8)
    # rows grow downwards
    axes.set(xlim=(-reach, reach), ylim=(reach, -reach), aspect="equal", xlabel="to the right (px)", ylabel="down (px)")
    beyond = int(np.count_nonzero(~np.all(np.abs(offsets) <= reach, axis=1)))
    axes.set_title("Offsets" + (f", {beyond} beyond" if beyond else ""), fontsize=9)


def write_measured_figures(directory: Path, products: Mapping[str, Any]) -> list[Path]:
    """Write a figure of each pair into a folder; return their paths. Raises OSError where that fails."""
    return save_figures(directory, {f"matches-{pair.number}": draw_pair(pair) for pair in matched_pairs(products)})
