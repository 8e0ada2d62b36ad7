"""Presentation of visual target tracking: report sections, and views of cases with stops, path and updates."""

from __future__ import annotations

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
from marsyard.reports.wording import NOTHING, label, note_text, number
from marsyard.scenarios.rover.stops import RunOutcome

#: Maximum number of stops with images on the page.
_MAX_STOPS = 8
#: Quantities of an update in the order of the table.
_QUANTITIES = (
    "range_m", "azimuth_deg", "elevation_deg", "magnification", "roll_change_deg", "azimuth_change_deg", "match_score",
    "stereo_score", "correction_px", "error_px", "position_error_m",
)  # fmt: skip


def view(products: Mapping[str, Any], key: str) -> CaseView:
    """Create the view of a tracking case."""
    stops = read_stops(products)
    shows_selection = len(stops) > _MAX_STOPS
    caption = f"{_MAX_STOPS} of the {len(stops)} stops." if shows_selection else "All stops."
    svg_figures = [svg_figure(draw_stops(products, _MAX_STOPS), f"{key}stops", caption, wide=True)]
    if read_rover_path(products) is not None:
        text = "Left: top view of the rover's path. Right: estimated target positions."
        svg_figures.append(svg_figure(draw_path(products), f"{key}way", text, wide=True))
    names = [name for name in _QUANTITIES if any(name in stop.quantities for stop in stops)]
    rows = []
    for stop in stops:
        texts = [str(stop.number), stop.state or NOTHING, *(number(stop.quantity(name)) for name in names)]
        rows.append(TableRow(texts, stop.is_matched))
    head = ["Stop", "State", *map(label, names)]
    return CaseView([("Stops", str(len(stops)))], svg_figures, head, rows)


VTT = Presentation(
    cases=(CaseKind(is_vtt_case, view, write_vtt_figures, note_text("vtt.legend")),),
    first=(*sections.SECTIONS, GOAL),
    outcomes=(RunOutcome, HandOffOutcome),
)
