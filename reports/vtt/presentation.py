"""Presentation of visual target tracking: report sections, and views of cases with stops, path and updates."""

import math
from collections.abc import Mapping
from typing import Any

from marsyard.algorithms.vtt.arm import HandOffOutcome
from marsyard.reports.column_values import is_true, to_float
from marsyard.reports.presentation import CaseFigure, CaseKind, CaseView, Cause, Presentation, TableRow
from marsyard.reports.products import Products
from marsyard.reports.vtt.case_figures import draw_path, draw_stops
from marsyard.reports.vtt.case_products import is_vtt_case, read_rover_path, read_stops
from marsyard.reports.vtt.goal_section import goal_section
from marsyard.reports.vtt.paper_sections import DEFINITIONS, SECTIONS
from marsyard.reports.wording import NOTHING, number, percent
from marsyard.scenarios.rover.run_state import RunOutcome

#: Maximum number of stops with images on the page.
_MAX_STOPS = 8
#: Quantities of an update in the order of the table, with their headings.
_HEADINGS = {
    "range_m": "Range (m)", "azimuth_deg": "Mast azimuth (deg)", "elevation_deg": "Mast elevation (deg)",
    "magnification": "Magnification", "roll_change_deg": "Roll change (deg)",
    "azimuth_change_deg": "Azimuth change of the line of sight (deg)", "match_score": "NCC score",
    "stereo_score": "Stereo score", "correction_px": "Correction (px)", "error_px": "Tracking error (px)",
    "position_error_m": "Position error (cm)",
}  # fmt: skip
#: Numbers of decimals that are not 2.
_DIGITS = {"magnification": 3, "correction_px": 1}
_CAPTION = (
    "Each stop: left subframe (large), enlarged target (above right), and right subframe (below right) around the "
    "stereo match. The numbers are those of the table below; stereo is the stereo score, error the tracking error."
)
_STRIP_CAPTION = (
    "At stop 1 the range is unknown. The right subframe is a strip, because the rows of the target are known, but not "
    "the columns."
)
_PATH_CAPTION = (
    "Numbers are stops. Left: top view, north up. Right: estimated positions of the target in the rover's estimated "
    "world frame. They contain the error of the rover's pose; the position error in the table does not."
)
_LEGEND = (
    "The layout follows Figs. 15, 17 and 16b of the paper (Kim, Nesnas and Bajracharya, visual target tracking). Mast "
    "azimuth (positive to the right) and elevation are the pointing angles of the mast relative to the rover. "
    f"{DEFINITIONS} Position error: distance of the reported from the true position of the designated point, "
    "both in the rover frame. It contains errors of stereo, calibration and mast pointing."
)


def view(products: Products, complete: bool = False) -> CaseView:
    """Create the view of a tracking case; only the complete view has the images of all stops."""
    stops = read_stops(products)
    shows_selection = len(stops) > _MAX_STOPS and not complete
    captions = [f"{_MAX_STOPS} of the {len(stops)} stops."] if shows_selection else []
    captions.append(_CAPTION)
    if stops[0].right is not None and 2 * len(stops[0].right) < len(stops[0].left):
        captions.append(_STRIP_CAPTION)
    figures = [CaseFigure("stops", draw_stops(products, None if complete else _MAX_STOPS), " ".join(captions))]
    if read_rover_path(products) is not None:
        figures.append(CaseFigure("way", draw_path(products), _PATH_CAPTION))
    names = [name for name in _HEADINGS if any(name in stop.quantities for stop in stops)]
    # without a loss, the tracker's state does not vary
    shows_state = any(stop.state not in ("", "normal") for stop in stops)
    rows = []
    for stop in stops:
        texts = [str(stop.number), *([stop.state or NOTHING] if shows_state else [])]
        texts += [_format(name, stop.quantity(name)) for name in names]
        rows.append(TableRow(texts, stop.is_matched))
    head = ["Stop", *(["State"] if shows_state else []), *(_HEADINGS[name] for name in names)]
    return CaseView(figures, head=head, rows=rows)


def _format(name: str, value: float) -> str:
    """Format a quantity of the table of stops; positions are in centimetres, and no digit is below the noise."""
    digits = _DIGITS.get(name, 2)
    scale = 100.0 if name == "position_error_m" else 1.0
    return f"{scale * value:z.{digits}f}".replace("-", "−") if math.isfinite(value) else NOTHING


#: Obliquity of a face, degrees, and slip, above which they are named as the cause of a loss.
_MAX_OBLIQUITY_DEG, _MAX_SLIP = 60.0, 0.5


def explain(row: Mapping[str, Any], metric: str) -> Cause | None:
    """Return the larger component of a position error, or the probable cause of a lost or false track."""
    if metric == "position_error_m":
        range_m, cross_m = (abs(to_float(row.get(f"{name}_error_m"))) for name in ("range", "cross"))
        if math.isnan(range_m + cross_m):
            return None
        errors = f"{1e3 * range_m:.0f} mm along and {1e3 * cross_m:.0f} mm across the line of sight"
        detail = f"{errors}, drift {number(to_float(row.get('drift_px')))} px"
        return Cause("range" if range_m > cross_m else "direction", detail)
    if metric not in ("answered", "tracked", "no_false_track", "handed_off"):
        return None
    obliquity_deg, slip = to_float(row.get("obliquity_max_deg")), to_float(row.get("slip_max"))
    causes = {
        "shadow of the mast": is_true(row.get("rover_shadow_on_target")),
        "slip": slip > _MAX_SLIP,
        "oblique face": obliquity_deg > _MAX_OBLIQUITY_DEG,
    }
    name = next((name for name, applies in causes.items() if applies), "not identified")
    detail = f"losses: {row.get('losses')}, face seen at up to {number(obliquity_deg)} deg, slip up to {percent(slip)}"
    return Cause(name, detail if name == "not identified" else f"{name}: {detail}")


VTT = Presentation(
    cases=(CaseKind(is_vtt_case, view, _LEGEND),),
    first=(*SECTIONS, goal_section),
    outcomes=(RunOutcome, HandOffOutcome),
    explain=explain,
)
