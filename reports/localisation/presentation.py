"""Presentation of localisation on a map: report sections, view of a case, and cause of an error."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from marsyard.algorithms.localisation.interface import PositionOutcome
from marsyard.reports.cell_values import to_float
from marsyard.reports.localisation.case_figures import (
    draw_errors,
    draw_landmarks,
    draw_map,
    is_localisation_case,
    read_track,
)
from marsyard.reports.localisation.sections import conditions_section, position_section
from marsyard.reports.presentation import CaseFigure, CaseKind, CaseView, Cause, Presentation, TableRow
from marsyard.reports.products import Products
from marsyard.reports.wording import number

_LEGEND = "The blue line is the true position; the bands are three standard deviations that the algorithm reports."


def view(products: Products, _complete: bool = False) -> CaseView:
    """Create the view of a localisation case: error over time, map, landmarks, and a table of the estimates."""
    drawn = [
        CaseFigure("errors", draw_errors(products), "Position error over time."),
        CaseFigure("map", draw_map(products), "True and estimated positions on the map.", wide=False),
    ]
    landmarks = draw_landmarks(products)
    if landmarks is not None:
        caption = "Landmarks in the last image: used (green), rejected (red); residuals enlarged twenty times."
        drawn.append(CaseFigure("landmarks", landmarks, caption, wide=False))
    rows = []
    track, outcomes, inliers = read_track(products), products["outcomes"], products["inliers"]
    for index, (values, outcome) in enumerate(zip(track, outcomes, strict=True)):
        is_valid = bool(np.isfinite(values[0]))
        name = f"image {index + 1}" if index < len(track) - 1 else "end"
        used = "" if not np.isfinite(inliers[index]) else f"{inliers[index]:.0f}"
        text = PositionOutcome[str(outcome)].value
        errors = [number(float(value)) if is_valid else "" for value in (*values[1:4], np.hypot(*values[4:6]))]
        rows.append(TableRow([name, text, used, *errors], is_valid))
    head = ["Estimate", "Outcome", "Landmarks used", "Error east (m)", "north (m)", "up (m)", "Reported sd (m)"]
    return CaseView(drawn, head=head, rows=rows)


#: Number of inliers of an image below which landmarks are named as the cause.
_MIN_INLIERS = 15


def explain(row: Mapping[str, Any], metric: str) -> Cause | None:
    """Return whether a wrong or missing position has few landmarks, with the difference of the suns."""
    if "position_error" not in metric and metric != "fixed_in_time":
        return None
    inliers, suns_deg = to_float(row.get("inliers_median")), to_float(row.get("sun_difference_deg"))
    name = "few landmarks" if not inliers >= _MIN_INLIERS else "biased landmarks"
    text = "no landmarks matched" if math.isnan(inliers) else f"{inliers:.0f} landmarks per image (median)"
    return Cause(name, f"{text}, suns of map and image differ by {number(suns_deg)} deg")


LOCALISATION = Presentation(
    cases=(CaseKind(is_localisation_case, view, _LEGEND),),
    first=(position_section,),
    sections=(conditions_section,),
    outcomes=(PositionOutcome,),
    explain=explain,
)
