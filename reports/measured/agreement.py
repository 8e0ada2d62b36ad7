"""Real cases: agreement of their pictures with the measured poses, and of the answers with other measurements."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from marsyard.reports.columns import label, numbers
from marsyard.reports.section import Block, Grid, Section, Subject, plate
from marsyard.reports.svg import MARKERS, SERIES, in_page_style, new_axes
from marsyard.reports.wording import NOTHING, number

MEDIAN, MOST = "residual_median_px", "residual_90_percent_px"
#: Maximum number of rows of the table; further cases are counted.
_MAX_ROWS = 60
#: Minimum number of cases for a figure.
_MIN_DRAWN = 3
#: Further columns of the table where the rows have them.
_QUANTITIES = (
    "matches", "outlier_fraction", MEDIAN, MOST, "residual_worst_pair_px", "max_rotation_deg", "max_translation_m",
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
    names = [name for name in _columns(frame) if np.isfinite(numbers(frame, name)).any()]
    head = ["Case", "Name", "Outcome", *(label(name) for name in names)]
    rows = [_row(frame, place, names) for place in range(min(len(frame), _MAX_ROWS))]
    plates = []
    if np.count_nonzero(np.isfinite(numbers(frame, MEDIAN))) >= _MIN_DRAWN:
        plates.append(plate(residual_figure(frame), "agreement", "Residuals of the cases, the smallest median first."))
    note = (_INERTIAL if "inertial_difference_m_s" in names else "") + _NO_DRAWS
    grid = Grid(head, rows, max(0, len(frame) - _MAX_ROWS))
    medians = numbers(frame, MEDIAN)
    data = {
        "cases": len(frame),
        "unmatched": int(np.count_nonzero(~np.isfinite(medians))),
        "median_of_medians_px": float(np.nanmedian(medians)) if np.isfinite(medians).any() else None,
        "apart": {name: float(np.nanmedian(numbers(frame, name))) for name in names if _is_apart(name)},
    }
    blocks = [Block(text=_TEXT, plates=plates, grid=grid, note=note)]
    return Section("agreement", "Agreement", "Pictures against measured poses", blocks, data)


@in_page_style
def residual_figure(frame: pd.DataFrame) -> Figure:
    """Median and 90 % residual of each case, ordered by the median."""
    medians, most = numbers(frame, MEDIAN), numbers(frame, MOST)
    known = np.flatnonzero(np.isfinite(medians))
    order = known[np.argsort(medians[known], kind="stable")]
    places = np.arange(1, order.size + 1)
    figure, axes = new_axes(6.2, 3.2)
    for values, name, place in ((most, "90 %", 1), (medians, "median", 0)):
        axes.plot(places, values[order], MARKERS[place], color=SERIES[place], markersize=5.0, label=name)
    axes.set(xlabel="case, in order of the median", ylabel="residual (px)", ylim=(0.0, None))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlim(0.5, order.size + 0.5)
    axes.legend(loc="upper left")
    return figure


def _columns(frame: pd.DataFrame) -> Sequence[str]:
    """Quantities in their order, then the distances of further algorithms from the first."""
    return [*(name for name in _QUANTITIES if name in frame), *(str(name) for name in frame if _is_apart(str(name)))]


def _is_apart(name: str) -> bool:
    return name.endswith((".apart_m_s", ".apart_m"))


def _row(frame: pd.DataFrame, place: int, names: Sequence[str]) -> list[str]:
    values = [float(numbers(frame.iloc[[place]], name)[0]) for name in names]
    texts = [NOTHING if not np.isfinite(one) else f"{one:.0f}" if one.is_integer() else number(one) for one in values]
    case = str(frame["case"].iloc[place]) if "case" in frame else str(place)
    return [case, str(frame["measured_case"].iloc[place]), str(frame["outcome"].iloc[place]), *texts]
