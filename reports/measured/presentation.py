"""Presentation of real cases: their agreement with measurements, matches, and the figures of their system."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from marsyard.reports.dimes.presentation import DIMES_CASE
from marsyard.reports.hda.case_figures import FIGURES, figures_reached
from marsyard.reports.presentation import (
    CaseKind,
    CaseView,
    Presentation,
    TableRow,
    numeric_product,
    plane,
    save_figures,
)
from marsyard.reports.section import (
    MARKERS,
    MUTED,
    SERIES,
    Block,
    Grid,
    Section,
    Subject,
    in_page_style,
    new_axes,
    plate,
    show_picture,
)
from marsyard.reports.wording import NOTHING, label, number, numbers

MEDIAN, PERCENTILE_90 = "residual_median_px", "residual_90_percent_px"
#: Maximum number of rows of the table; further cases are counted.
_MAX_ROWS = 60
#: Minimum number of cases for a figure.
_MIN_DRAWN = 3
#: Further columns of the table where the rows have them.
_QUANTITIES = (
    "matches", "outlier_fraction", MEDIAN, PERCENTILE_90, "residual_worst_pair_px", "max_rotation_deg",
    "max_translation_m",
    "inertial_difference_m_s", "pair_discrepancy_m_s", "rotation_pose_difference_deg", "direction_pose_difference_deg",
    "baseline_pose_difference_fraction",
)  # fmt: skip
_TEXT = (
    "Whatever is known of the truth, pictures and poses must agree. Features are matched from each picture to the "
    "next; by the poses a match lies on a curve of the later picture (at a point, if the camera only turned), and the "
    "residual is how far off it is. It holds the errors of poses, lens and matching together: a few tenths of a pixel "
    "are what matching alone leaves, more is the poses' or the camera's."
)
_INERTIAL = (
    "Velocities compared with the inertial one contain its constant error; the discrepancy of pairs, the change of "
    "velocity from the first pair of pictures to the second against the inertial one, does not. Without measured "
    "positions the "
    "residual is that of the answer: its velocity stands for the inertial one's constant part. "
)
_NO_DRAWS = "Cases that were measured are no random draws: nothing here is a probability."


def agreement_section(subject: Subject) -> Section | None:
    """Section on the agreement; None where cases are not real ones."""
    frame = subject.frame
    if "measured_case" not in frame or MEDIAN not in frame:
        return None
    # distances of further algorithms from the first come last
    apart = [str(name) for name in frame if str(name).endswith((".difference_m_s", ".difference_m"))]
    names = [one for one in (*_QUANTITIES, *apart) if one in frame and np.isfinite(numbers(frame, one)).any()]
    medians = numbers(frame, MEDIAN)
    head = ["Case", "Name", "Outcome", *(label(name) for name in names)]
    rows = []
    for place, row in enumerate(frame.head(_MAX_ROWS).to_dict("records")):
        values = [float(numbers(frame, name)[place]) for name in names]
        texts = [NOTHING if not isfinite(one) else f"{one:.0f}" if one.is_integer() else number(one) for one in values]
        rows.append([str(row.get("case", place)), str(row["measured_case"]), str(row["outcome"]), *texts])
    plates = []
    if np.count_nonzero(np.isfinite(medians)) >= _MIN_DRAWN:
        plates.append(plate(residual_figure(frame), "agreement", "Residuals of the cases, the smallest median first."))
    note = (_INERTIAL if "inertial_difference_m_s" in names else "") + _NO_DRAWS
    grid = Grid(head, rows, max(0, len(frame) - _MAX_ROWS))
    data = {
        "cases": len(frame),
        "unmatched": int(np.count_nonzero(~np.isfinite(medians))),
        "median_of_medians_px": float(np.nanmedian(medians)) if np.isfinite(medians).any() else None,
        "apart": {name: float(np.nanmedian(numbers(frame, name))) for name in names if name in apart},
    }
    blocks = [Block(text=_TEXT, plates=plates, grid=grid, note=note)]
    return Section("agreement", "Agreement", "Pictures against measured poses", blocks, data)


@in_page_style
def residual_figure(frame: pd.DataFrame) -> Figure:
    """Median and 90 % residual of each case, ordered by the median."""
    medians, percentile_90 = numbers(frame, MEDIAN), numbers(frame, PERCENTILE_90)
    finite = np.flatnonzero(np.isfinite(medians))
    order = finite[np.argsort(medians[finite], kind="stable")]
    places = np.arange(1, order.size + 1)
    figure, axes = new_axes(6.2, 3.2)
    for values, name, place in ((percentile_90, "90 %", 1), (medians, "median", 0)):
        axes.plot(places, values[order], MARKERS[place], color=SERIES[place], markersize=5.0, label=name)
    axes.set(xlabel="case, in order of the median", ylabel="residual (px)", ylim=(0.0, None))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlim(0.5, order.size + 0.5)
    axes.legend(loc="upper left")
    return figure


#: Maximum number of pairs in the page.
_MAX_PAIRS = 4
#: Figures of a landing that need no truth.
_WITHOUT_TRUTH = ("fig1-tracks", "fig3-epipolar", "fig4-elevation")
_LEGEND = (
    "Features matched between one picture and the next, coloured by how far they lie from where the measured poses "
    "allow them; grey crosses: matches that no rigid motion explains, which are left out. Offsets are those of the "
    "later picture: their spread shows errors of matching and lens, a common offset an attitude error. "
)


def view(products: Mapping[str, Any], key: str) -> CaseView:
    """View of a real case."""
    pairs = matched_pairs(products)
    plates = [
        plate(draw_pair(pair), f"{key}matches{pair.number}", f"{pair.caption}.", wide=True)
        for pair in pairs[:_MAX_PAIRS]
    ]
    left_out = len(pairs) - _MAX_PAIRS
    facts = [("Pairs not shown", str(left_out))] if left_out > 0 else []
    if DIMES_CASE.is_case(products) and "tracks" in products:
        theirs = DIMES_CASE.view(products, key)
        return CaseView([*facts, *theirs.facts], [*plates, *theirs.plates], theirs.head, theirs.rows)
    plates += [plate(FIGURES[name](products), f"{key}{name[:4]}", f"{name}.", wide=True) for name in _landing(products)]
    head = ["Pictures", "Matches", "Wrong", "Median residual (px)", "90 % (px)"]
    head += ["Offset right (px)", "Offset down (px)"]
    rows = []
    for pair in pairs:
        residuals, offsets = pair.residuals_px, pair.offsets[pair.right]
        cells = [f"{pair.number} and {pair.number + 1}", f"{residuals.size:,}", f"{int((~pair.right).sum()):,}"]
        texts = 4 * ["–"]
        if residuals.size:
            values = [
                np.median(residuals),
                np.quantile(residuals, 0.9, method="higher"),
                *np.nanmedian(offsets, axis=0),
            ]
            texts = [number(float(value)) for value in values]
        rows.append(TableRow([*cells, *texts], succeeded=residuals.size > 0))
    return CaseView(facts, plates, head, rows)


def _is_measured_case(products: Mapping[str, Any]) -> bool:
    return bool(matched_pairs(products))


def _landing(products: Mapping[str, Any]) -> list[str]:
    return [name for name in figures_reached(products) if name in _WITHOUT_TRUTH]


def _write(directory: Path, products: Mapping[str, Any]) -> list[Path]:
    pairs = matched_pairs(products)
    written = save_figures(directory, {f"matches-{pair.number}": draw_pair(pair) for pair in pairs})
    if DIMES_CASE.is_case(products) and "tracks" in products:
        return [*written, *DIMES_CASE.write(directory, products)]
    return [*written, *save_figures(directory, {name: FIGURES[name](products) for name in _landing(products)}, dpi=130)]


MEASURED = Presentation(cases=(CaseKind(_is_measured_case, view, _write, _LEGEND),), first=(agreement_section,))


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
        table = numeric_product(products.get(f"matches_{k}"))
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
