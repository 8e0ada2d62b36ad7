"""Presentation of visual target tracking: report sections, and views of cases with stops, path and updates."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from marsyard.algorithms.vtt.accuracy import HandOffOutcome
from marsyard.reports.presentation import CaseKind, CaseView, Presentation, TableRow
from marsyard.reports.section import svg_figure
from marsyard.reports.vtt import sections
from marsyard.reports.vtt.case_figures import (
    draw_path,
    draw_stops,
    is_vtt_case,
    read_rover_path,
    read_stops,
    write_vtt_figures,
)
from marsyard.reports.vtt.goal import GOAL
from marsyard.reports.wording import NOTHING, label, note_text
from marsyard.scenarios.rover.stops import RunOutcome

#: Maximum number of stops with images on the page.
_MAX_STOPS = 8
#: Quantities of an update in the order of the table.
_QUANTITIES = (
    "range_m", "azimuth_deg", "elevation_deg", "magnification", "roll_change_deg", "azimuth_change_deg", "match_score",
    "stereo_score", "correction_px", "error_px", "position_error_m",
)  # fmt: skip
#: Short headings and numbers of decimals of the table.
_HEADS = {
    "range_m": "Range (m)", "azimuth_deg": "Mast azimuth (deg)", "elevation_deg": "Mast elevation (deg)",
    "magnification": "Magnification", "roll_change_deg": "Roll change (deg)",
    "azimuth_change_deg": "Change of direction (deg)", "match_score": "Match NCC", "stereo_score": "Stereo NCC",
    "correction_px": "Correction (px)", "error_px": "Tracking error (px)", "position_error_m": "Position error (cm)",
}  # fmt: skip
_DIGITS = {"magnification": 3, "match_score": 3, "stereo_score": 3, "correction_px": 1}
_CAPTION = (
    "Each stop: left subframe (large), enlarged target (above right) and right subframe (below right). Blue, dashed: "
    "search window. Orange: tracked target. White cross: true projection of the designated point. At the first stop "
    "the range is unknown, so the right subframe is a narrow strip along the rows in which the target can be. Above "
    "the images: number of the stop, range, mast azimuth and elevation, magnification (×) and roll change since the "
    "last match, NCC of the match and of the stereo match, and tracking error."
)
_PATH_CAPTION = (
    "Left: top view of the rover's path, north up; grey lines are headings, numbers are stops. Right: estimated "
    "positions of the target relative to the designated point, enlarged."
)


def view(products: Mapping[str, Any], key: str) -> CaseView:
    """Create the view of a tracking case."""
    stops = read_stops(products)
    shows_selection = len(stops) > _MAX_STOPS
    caption = f"{_MAX_STOPS} of the {len(stops)} stops. {_CAPTION}" if shows_selection else _CAPTION
    svg_figures = [svg_figure(draw_stops(products, _MAX_STOPS), f"{key}stops", caption, wide=True)]
    if read_rover_path(products) is not None:
        svg_figures.append(svg_figure(draw_path(products), f"{key}way", _PATH_CAPTION, wide=True))
    names = [name for name in _QUANTITIES if any(name in stop.quantities for stop in stops)]
    rows = []
    for stop in stops:
        texts = [str(stop.number), stop.state or NOTHING, *(_format(name, stop.quantity(name)) for name in names)]
        rows.append(TableRow(texts, stop.is_matched))
    head = ["Stop", "State", *(_HEADS.get(name, label(name)) for name in names)]
    return CaseView([("Stops", str(len(stops)))], svg_figures, head, rows)


def _format(name: str, value: float) -> str:
    """Format a quantity of the table of stops; positions are in centimetres, and no digit is below the noise."""
    digits = _DIGITS.get(name, 2)
    scale = 100.0 if name == "position_error_m" else 1.0
    return f"{scale * value:z.{digits}f}".replace("-", "−") if math.isfinite(value) else NOTHING


VTT = Presentation(
    cases=(CaseKind(is_vtt_case, view, write_vtt_figures, note_text("vtt.legend")),),
    first=(*sections.SECTIONS, GOAL),
    outcomes=(RunOutcome, HandOffOutcome),
)
