"""Pairs of images with their matched features: read from the products of a case, and drawn."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.figure import Figure

from marsyard.reports import figure_style
from marsyard.reports.images import Image, show_image
from marsyard.reports.products import Products, check_shape, to_matrix
from marsyard.reports.wording import number

#: Upper end of the colour scale of residuals.
_MAX_COLOUR_PX = 3.0
_COLOURS = "plasma"
_OUTLIER_COLOUR = "#c9d1d9"
#: Possible numbers of a case's images.
_IMAGE_NUMBERS = range(1, 100)


@dataclass(frozen=True)
class MatchedPair:
    """Two images and the features matched between them.

    - number: number of the earlier image, from 1; images: counts of both images
    - pixels: (u, v) of each match in both images
    - offsets: position in the later image minus the position predicted by the poses, pixels
    - inlier: whether a rigid motion explains the match
    """

    number: int
    images: tuple[Image, Image]
    pixels: Float[np.ndarray, "n 2 2"]
    offsets: Float[np.ndarray, "n 2"]
    inlier: Bool[np.ndarray, " n"]

    @property
    def residuals_px(self) -> Float[np.ndarray, " k"]:
        """Lengths of the offsets of the inliers; infinite for predictions out of view."""
        lengths = np.hypot(*self.offsets[self.inlier].T)
        return np.asarray(np.where(np.isfinite(lengths), lengths, np.inf))

    @property
    def caption(self) -> str:
        """Caption of the pair."""
        residuals = self.residuals_px
        median = f", median residual {number(float(np.median(residuals)))} px" if residuals.size else ""
        return f"Images {self.number} and {self.number + 1}: {residuals.size:,} matches{median}"


def read_matched_pairs(products: Products) -> list[MatchedPair]:
    """Read the valid pairs of a case's products (`marsyard.scenarios.measured.matching.agreement_products`)."""
    pairs = []
    for image_number in _IMAGE_NUMBERS:
        # columns of the table: (u, v) in both images, offset (u, v), and 1 for inliers
        table = check_shape(products.get(f"matches_{image_number}"), None, 7)
        first, second = (to_matrix(products.get(f"image_{image_number + offset}")) for offset in (0, 1))
        if table is not None and first is not None and second is not None:
            pixels, is_inlier = table[:, :4].reshape(-1, 2, 2), table[:, 6] > 0.0
            pairs.append(MatchedPair(image_number, (first, second), pixels, table[:, 4:6], is_inlier))
    return pairs


@figure_style.in_page_style
def draw_pair(pair: MatchedPair) -> Figure:
    """Draw both images with the matches, coloured by their residuals, and the offsets."""
    figure = Figure(figsize=(12.0, 5.2), layout="constrained")
    left, right, scatter = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 0.8))
    offsets = pair.offsets[pair.inlier]
    lengths = np.hypot(*offsets.T)
    style: dict[str, Any] = {"c": lengths, "s": 12.0, "cmap": _COLOURS, "vmin": 0.0, "vmax": _MAX_COLOUR_PX}
    for image_index, axes in enumerate((left, right)):
        show_image(axes, pair.images[image_index])
        axes.plot(
            *pair.pixels[~pair.inlier, image_index].T, "x", markersize=4.0, color=_OUTLIER_COLOUR, markeredgewidth=0.8
        )
        points = axes.scatter(*pair.pixels[pair.inlier, image_index].T, linewidths=0.0, **style)
        axes.set_title(f"Image {pair.number + image_index}", fontsize=9)
    colour_bar_style: dict[str, Any] = {"location": "bottom", "shrink": 0.5, "aspect": 40, "extend": "max"}
    figure.colorbar(points, ax=[left, right], label="residual (px)", **colour_bar_style)
    finite = lengths[np.isfinite(lengths)]
    axis_limit = max(_MAX_COLOUR_PX, 1.5 * float(np.quantile(finite, 0.9))) if finite.size else _MAX_COLOUR_PX
    scatter.scatter(*offsets.T, linewidths=0.0, **style)
    for line in (scatter.axhline, scatter.axvline):
        line(0.0, color=figure_style.MUTED, linewidth=0.8)
    # rows increase downwards
    scatter.set(xlim=(-axis_limit, axis_limit), ylim=(axis_limit, -axis_limit), aspect="equal")
    scatter.set(xlabel="to the right (px)", ylabel="down (px)")
    n_beyond = int(np.count_nonzero(~np.all(np.abs(offsets) <= axis_limit, axis=1)))
    scatter.set_title("Offsets" + (f", {n_beyond} outside" if n_beyond else ""), fontsize=9)
    return figure
