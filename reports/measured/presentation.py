"""Presentation of measured cases (real images): agreement with measured poses, and views of cases."""

from math import isfinite

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from marsyard.reports import figure_style, section
from marsyard.reports.column_values import numbers
from marsyard.reports.dimes.presentation import DIMES_CASE
from marsyard.reports.hda.case_figures import FIGURES, available_figures
from marsyard.reports.measured.matched_pairs import draw_pair, read_matched_pairs
from marsyard.reports.measured.over_map import OVER_MAP, map_section
from marsyard.reports.presentation import CaseFigure, CaseKind, CaseView, Presentation, TableRow
from marsyard.reports.products import Products
from marsyard.reports.wording import NOTHING, label, number
from marsyard.scenarios.measured.over_map import MapOutcome

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
_AGREEMENT_TEXT = (
    "Images and poses must agree, even if the true velocity is unknown. Features are matched between consecutive "
    "images. According to the poses, a match lies on a curve of the later image (at a point, if the camera only "
    "rotated); the residual is its distance from this curve. It contains the errors of poses, lens and matching. "
    "Matching alone causes a few tenths of a pixel; larger residuals are caused by the poses or the camera."
)
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
    names = [name for name in (*_COLUMNS, *differences) if name in frame and np.isfinite(numbers(frame, name)).any()]
    medians = numbers(frame, MEDIAN)
    head = ["Case", "Name", "Outcome", *(label(name) for name in names)]
    rows = []
    for index, row in enumerate(frame.head(_MAX_ROWS).to_dict("records")):
        values = [float(numbers(frame, name)[index]) for name in names]
        texts = [
            NOTHING if not isfinite(value) else f"{value:.0f}" if value.is_integer() else number(value)
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
    data = {
        "cases": len(frame),
        "unmatched": int(np.count_nonzero(~np.isfinite(medians))),
        "median_of_medians_px": float(np.nanmedian(medians)) if np.isfinite(medians).any() else None,
        "differences": {name: float(np.nanmedian(numbers(frame, name))) for name in names if name in differences},
    }
    blocks = [section.Block(text=_AGREEMENT_TEXT, figures=svg_figures, grid=grid, note=note)]
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
_LEGEND = (
    "The points are features matched between consecutive images, coloured by their residual relative to the measured "
    "poses. Grey crosses are outliers, which no rigid motion explains. Offsets are measured in the later image. Their "
    "scatter shows errors of matching and lens; a common offset shows an attitude error."
)


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
    cases=(CaseKind(lambda products: bool(read_matched_pairs(products)), view, _LEGEND), OVER_MAP),
    first=(agreement_section, map_section),
    outcomes=(MapOutcome,),
)
