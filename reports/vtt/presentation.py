"""How visual target tracking is presented: its sections, and a case as its stops, its way and its updates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from marsyard.reports.presentation import CaseKind, CaseView, Presentation, TableRow
from marsyard.reports.section import plate
from marsyard.reports.vtt import sections
from marsyard.reports.vtt.case_figures import (
    draw_path,
    draw_stops,
    is_vtt_case,
    list_stops,
    rover_path,
    write_vtt_figures,
)
from marsyard.reports.vtt.goal import GOAL
from marsyard.reports.wording import NOTHING, label, note_text, number

#: Maximum number of stops whose pictures the page shows.
_MAX_STOPS = 8
#: Numbers of an update in the order of the table.
_QUANTITIES = (
    "range_m", "azimuth_deg", "elevation_deg", "magnification", "roll_change_deg", "azimuth_change_deg", "match_score",
    "stereo_score", "correction_px", "error_px", "position_error_m",
)  # fmt: skip


def view(products: Mapping[str, Any], key: str) -> CaseView:
    """A tracking case."""
    stops = list_stops(products)
    caption = f"{_MAX_STOPS} stops of {len(stops)}." if len(stops) > _MAX_STOPS else "All stops."
    plates = [plate(draw_stops(products, _MAX_STOPS), f"{key}stops", caption, wide=True)]
    if rover_path(products) is not None:
        text = "The path from above, and the target as estimated."
        plates.append(plate(draw_path(products), f"{key}way", text, wide=True))
    names = [name for name in _QUANTITIES if any(name in stop.figures for stop in stops)]
    rows = []
    for stop in stops:
        texts = [str(stop.number), stop.state or NOTHING, *(number(stop.figure(name)) for name in names)]
        rows.append(TableRow(texts, stop.is_found))
    return CaseView([("Stops", str(len(stops)))], plates, ["Stop", "State", *(label(name) for name in names)], rows)


VTT = Presentation(
    cases=(CaseKind(is_vtt_case, view, write_vtt_figures, note_text("vtt.legend")),), first=(*sections.SECTIONS, GOAL)
)
