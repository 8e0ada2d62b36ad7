"""Presentation of measured cases (real images): agreement with measured poses, and views of cases."""

from dataclasses import dataclass
from math import isfinite, isinf, isnan, nan
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from marsyard.reports import figure_style, section
from marsyard.reports.column_values import numbers
from marsyard.reports.dimes.presentation import DIMES_CASE
from marsyard.reports.hda.case_figures import FIGURES, available_figures
from marsyard.reports.images import Image, show_image
from marsyard.reports.measured.over_map import OVER_MAP, map_section
from marsyard.reports.presentation import CaseFigure, CaseKind, CaseView, Presentation, TableRow
from marsyard.reports.products import Products, array_of_shape, to_matrix
from marsyard.reports.wording import NOTHING, label, note_text, number
from marsyard.scenarios.measured.over_map import MapOutcome

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
    """Read the valid pairs of a case's products (`marsyard.scenarios.measured.pose_agreement.agreement_products`)."""
    pairs = []
    for image_number in _IMAGE_NUMBERS:
        # columns of the table: (u, v) in both images, offset (u, v), and 1 for inliers
        table = array_of_shape(products.get(f"matches_{image_number}"), None, 7)
        first, second = (to_matrix(products.get(f"image_{image_number + offset}")) for offset in (0, 1))
        if table is not None and first is not None and second is not None:
            pixels, offsets, inlier = np.split(table, (4, 6), axis=1)
            is_inlier = inlier[:, 0] > 0.0
            pairs.append(MatchedPair(image_number, (first, second), pixels.reshape(-1, 2, 2), offsets, is_inlier))
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


MEDIAN, PERCENTILE_90 = "residual_median_px", "residual_90_percent_px"
#: Maximum number of rows of the table; additional cases are counted.
_MAX_ROWS = 60
#: Minimum number of cases for a figure.
_MIN_CASES = 3
#: Columns of the table after case, name and outcome; columns that the rows do not contain are omitted.
_COLUMNS = (
    "matches", "outlier_fraction", MEDIAN, PERCENTILE_90, "residual_worst_pair_px", "max_rotation_deg",
    "max_translation_m",
    "inertial_difference_m_s", "pair_discrepancy_m_s", "rotation_pose_difference_deg", "direction_pose_difference_deg",
    "baseline_pose_difference_fraction",
)  # fmt: skip
#: Infinite residual: by the poses, the later image does not show what both images show.
_OUT_OF_VIEW = "out of view"
_INERTIAL_NOTE = (
    "Differences from the inertial velocity contain its constant error. The discrepancy of pairs does not: it compares "
    "the change of velocity from the first pair of images to the second with the inertial change. Without measured "
    "positions, the residual uses the answer's velocity instead of the constant part of the inertial velocity. "
)
_SAMPLING_NOTE = "Measured cases are not random samples, so these numbers are not probabilities."


def agreement_section(subject: section.Subject) -> section.Section | None:
    """Create the section on the agreement of images and poses; None if the cases are not measured cases."""
    frame = subject.frame
    if "measured_case" not in frame or MEDIAN not in frame:
        return None
    # differences of compared algorithms come last
    differences = [str(name) for name in frame if str(name).endswith((".difference_m_s", ".difference_m"))]
    names = [name for name in (*_COLUMNS, *differences) if name in frame and not np.isnan(numbers(frame, name)).all()]
    medians = numbers(frame, MEDIAN)
    head = ["Case", "Name", "Outcome", *(label(name) for name in names)]
    rows = []
    for index, row in enumerate(frame.head(_MAX_ROWS).to_dict("records")):
        values = [float(numbers(frame, name)[index]) for name in names]
        texts = [
            _OUT_OF_VIEW
            if isinf(value)
            else NOTHING
            if isnan(value)
            else f"{value:.0f}"
            if value.is_integer()
            else number(value)
            for value in values
        ]
        rows.append([str(row.get("case", index)), str(row["measured_case"]), str(row["outcome"]), *texts])
    svg_figures = []
    if np.count_nonzero(np.isfinite(medians)) >= _MIN_CASES:
        svg_figures.append(
            section.svg_figure(
                residual_figure(frame), "agreement", "Residuals of each case, in the order of their median."
            )
        )
    note = (_INERTIAL_NOTE if "inertial_difference_m_s" in names else "") + _SAMPLING_NOTE
    grid = section.Grid(head, rows, max(0, len(frame) - _MAX_ROWS))
    median = float(np.nanmedian(medians)) if not np.isnan(medians).all() else nan
    data = {
        "cases": len(frame),
        "unmatched": int(np.count_nonzero(np.isnan(medians))),
        "out_of_view": int(np.count_nonzero(np.isinf(medians))),
        "median_of_medians_px": median if isfinite(median) else None,
        "differences": {name: float(np.nanmedian(numbers(frame, name))) for name in names if name in differences},
    }
    blocks = [section.Block(text=note_text("measured.agreement_text"), figures=svg_figures, grid=grid, note=note)]
    return section.Section("agreement", "Agreement", "Images compared with measured poses", blocks, data)


@figure_style.in_page_style
def residual_figure(frame: pd.DataFrame) -> Figure:
    """Draw the median and the 90 % quantile of the residuals of each case, ordered by the median."""
    medians, percentile_90 = numbers(frame, MEDIAN), numbers(frame, PERCENTILE_90)
    finite = np.flatnonzero(np.isfinite(medians))
    order = finite[np.argsort(medians[finite], kind="stable")]
    x = np.arange(1, order.size + 1)
    figure, axes = figure_style.new_axes(6.2, 3.2)
    for values, name, index in ((percentile_90, "90 %", 1), (medians, "median", 0)):
        axes.plot(
            x, values[order], figure_style.MARKERS[index], color=figure_style.SERIES[index], markersize=5.0, label=name
        )
    axes.set(xlabel="case, in order of the median", ylabel="residual (px)", ylim=(0.0, None))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlim(0.5, order.size + 0.5)
    axes.legend(loc="upper left")
    return figure


#: Maximum number of pairs on the page.
_MAX_PAIRS = 4
#: Figures of a landing that need no ground truth, and their captions.
_FIGURES_WITHOUT_TRUTH = {
    "fig1-tracks": "Features of the first image and their tracks in the second image.",
    "fig3-epipolar": "Structure pixels (red), epipolar segments (green) and matches (blue).",
    "fig4-elevation": "Two views of the elevation map.",
}


def view(products: Products, complete: bool = False) -> CaseView:
    """Create the view of a measured case; only the complete view has all pairs of images."""
    pairs = read_matched_pairs(products)
    drawn_pairs = pairs if complete else pairs[:_MAX_PAIRS]
    figures = [CaseFigure(f"matches-{pair.number}", draw_pair(pair), f"{pair.caption}.") for pair in drawn_pairs]
    n_omitted = len(pairs) - len(drawn_pairs)
    facts = [("Pairs not shown", str(n_omitted))] if n_omitted else []
    if DIMES_CASE.is_case(products) and "tracks" in products:
        dimes = DIMES_CASE.view(products, complete)
        return CaseView([*figures, *dimes.figures], [*facts, *dimes.facts], dimes.head, dimes.rows)
    names = [name for name in available_figures(products) if name in _FIGURES_WITHOUT_TRUTH]
    figures += [CaseFigure(name, FIGURES[name](products), _FIGURES_WITHOUT_TRUTH[name]) for name in names]
    head = ["Images", "Inliers", "Outliers", "Median residual (px)", "90 % quantile (px)"]
    head += ["Offset right (px)", "Offset down (px)"]
    rows = []
    for pair in pairs:
        residuals, offsets = pair.residuals_px, pair.offsets[pair.inlier]
        head_cells = [f"{pair.number} and {pair.number + 1}", f"{residuals.size:,}", f"{int((~pair.inlier).sum()):,}"]
        texts = 4 * [NOTHING]
        if residuals.size:
            percentile_90 = np.quantile(residuals, 0.9, method="higher")
            values = [np.median(residuals), percentile_90, *np.nanmedian(offsets, axis=0)]
            texts = [number(float(value)) for value in values]
        rows.append(TableRow([*head_cells, *texts], succeeded=residuals.size > 0))
    return CaseView(figures, facts, head, rows)


MEASURED = Presentation(
    cases=(CaseKind(lambda products: bool(read_matched_pairs(products)), view, note_text("measured.legend")), OVER_MAP),
    first=(agreement_section, map_section),
    outcomes=(MapOutcome,),
)
