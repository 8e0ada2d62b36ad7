"""Presentation of descents in reports: sections, and the view of a DIMES case, which has three images."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from marsyard.algorithms.interface import VelocityOutcome
from marsyard.reports.column_values import to_float
from marsyard.reports.dimes import case_figures as figures
from marsyard.reports.dimes.sections import ignition_section, landing_section, sensitivity_section
from marsyard.reports.dimes.stream_case import STREAM_CASE
from marsyard.reports.presentation import CaseFigure, CaseKind, CaseView, Cause, Presentation, TableRow
from marsyard.reports.products import Products, array_of_shape, numeric_product, to_matrix
from marsyard.reports.wording import NOTHING, label, note_text, number, percent

#: Columns of the tracks that the table shows in other columns, or not at all because they are too wide.
_HIDDEN_COLUMNS = ("pair", "template", "valid", "ground_east_m", "ground_north_m")
#: Positions in the table: heading, and the columns (u, v) of the tracks.
_POSITIONS = {
    "Template in the earlier image: column, row (px)": ("template_u", "template_v"),
    "Match in the later image: column, row (px)": ("match_u", "match_v"),
}
#: Headings of columns that need more words than `label` returns.
_HEADINGS = {
    "contrast": "contrast of the template",
    "peak_width": "width of the peak (template px)",
    "second_peak_ratio": "second peak / first peak",
}


def view(products: Products, complete: bool = False) -> CaseView:
    """Create the view of a DIMES case, without templates and tracks if the algorithm provides no DIMES details.

    The complete view has one figure of both image pairs, the page a figure of each pair.
    """
    facts = _format_velocities(products)
    if "tracks" not in products:
        caption = "The three images that the algorithm received."
        figure = CaseFigure("images", figures.draw_delivered_images(products), caption)
        return CaseView([figure], facts, legend=_describe_images(products).capitalize())
    drawn = [CaseFigure("dimes", figures.draw_dimes_case(products))] if complete else []
    for pair in () if complete else (0, 1):
        caption = f"Pair {pair + 1}: images {pair + 1} and {pair + 2}. {figures.describe_marks(products, pair)}"
        drawn.append(CaseFigure(f"pair{pair}", figures.draw_dimes_case(products, [pair]), caption, wide=False))
    head, rows = _create_track_table(products)
    legend = note_text("dimes.legend", images=_describe_images(products))
    return CaseView(drawn, [*facts, *_format_selection(products)], head, rows, legend)


def _create_track_table(products: Products) -> tuple[list[str], list[TableRow]]:
    """Create the headings and the rows of the table of tracks."""
    tracks = figures.read_tracks(products)
    names = dict.fromkeys(name for track in tracks for name in track.values)
    positions = {heading: pair for heading, pair in _POSITIONS.items() if {*pair} <= {*names}}
    hidden_names = {*_HIDDEN_COLUMNS, *(name for pair in positions.values() for name in pair)}
    quantities = [name for name in names if name not in hidden_names and not name.startswith("failed_")]
    selected_pair = array_of_shape(products.get("selected"), 2)
    head = ["Pair", "Template", *([] if selected_pair is None else ["Selected"]), "Failed checks", *positions]
    head += [_HEADINGS.get(name) or label(name) for name in quantities]
    rows = []
    for track in tracks:
        failed_columns = [name for name, value in track.values.items() if name.startswith("failed_") and value == 1.0]
        checks = ", ".join(name.removeprefix("failed_").replace("_", " ") for name in failed_columns)
        texts = [str(track.pair + 1), str(track.template + 1)]
        if selected_pair is not None:
            is_selected = selected_pair[track.pair] == track.template
            texts.append(("yes" if track.pair == 0 else "yes, reported") if is_selected else "no")
        texts.append(checks or ("none" if track.valid else "unknown"))
        texts += [_format_position(*(track.values[name] for name in pair)) for pair in positions.values()]
        texts += [number(track.values.get(name, np.nan)) for name in quantities]
        rows.append(TableRow(texts, track.valid))
    return head, rows


def _format_position(u: float, v: float) -> str:
    return NOTHING if math.isnan(u + v) else f"{u:.1f}, {v:.1f}".replace("-", "−")


def _format_velocities(products: Products) -> list[tuple[str, str]]:
    """Format the estimated velocity, the true velocity and the error, if the products contain them."""
    facts, velocities = [], []
    for key, name in (
        ("velocity_estimated_m_s", "Reported velocity, mean over the time between images 2 and 3"),
        ("velocity_true_m_s", "True velocity, same interval"),
    ):
        velocity = numeric_product(products.get(key))
        if velocity is not None and velocity.size >= 2 and np.isfinite(velocity.ravel()[:2]).all():
            east, north = velocity.ravel()[:2]
            velocities.append((east, north))
            facts.append((name, f"{east:+.2f} m/s east, {north:+.2f} m/s north".replace("-", "−")))
    if len(velocities) == 2:
        facts.append(("Velocity error", f"{number(math.dist(*velocities))} m/s"))
    return facts


def _format_selection(products: Products) -> list[tuple[str, str]]:
    """Format the smallest differences between velocity changes of tracks and of the IMU, if the products have them."""
    combinations = array_of_shape(products.get("combinations"), None, 3)
    if combinations is None or not len(combinations):
        return []
    # columns: templates of the first and of the second pair, and difference
    _, _, differences_m_s = combinations.T
    differences = [f"{number(float(value))} m/s" for value in np.sort(differences_m_s)]
    is_selected = array_of_shape(products.get("selected"), 2) is not None
    other = f"; other combinations: {differences[1]} or more" if len(differences) > 1 else ""
    text = f"{differences[0]} (selected tracks){other}" if is_selected else f"{differences[0]} or more: too large"
    return [("Velocity change between the pairs: difference from the IMU", text)]


def _describe_images(products: Products) -> str:
    """Describe how the images in the figure differ from the received images."""
    counts = to_matrix(products.get("image_1"))
    columns = 1 if counts is None else figures.column_binning(counts)
    if counts is None or columns == 1:
        return "images as received."
    averaging = f"each group of {columns} columns is averaged, for square pixels"
    return f"images as received, but {averaging} ({len(counts)} × {len(counts)} px)."


# every view has its own legend
DIMES_CASE = CaseKind(figures.is_dimes_case, view)


def explain(row: Mapping[str, Any], metric: str) -> Cause | None:
    """Compare the error of the reported velocity with the errors that attitude and altitude cause alone.

    An attitude error a makes v tan(a) of the descent rate v appear as horizontal velocity; a relative altitude error
    scales the horizontal velocity. Errors at the firing have no cause: the same attitude error changes the propagation.
    """
    attitude_deg, rate_m_s = (to_float(row.get(name)) for name in ("attitude_error_common_deg", "descent_rate_m_s"))
    altitude, speed_m_s = (to_float(row.get(name)) for name in ("altitude_error_common", "horizontal_speed_m_s"))
    by_attitude_m_s = abs(rate_m_s * math.tan(math.radians(attitude_deg)))
    attitude_text = f"the attitude error of {number(attitude_deg)} deg"
    return find_cause(row, metric, (attitude_text, by_attitude_m_s), altitude, speed_m_s)


def find_cause(
    row: Mapping[str, Any], metric: str, attitude: tuple[str, float], altitude: float, speed_m_s: float
) -> Cause | None:
    """Return the cause of at least half of an error of the reported velocity, or the images.

    Returns None for other metrics, and if a quantity is unknown.

    - attitude: text of the attitude error, and the velocity error that it causes, m/s
    - altitude, speed_m_s: relative altitude error, and the horizontal speed that it scales
    """
    error_m_s = abs(to_float(row.get(metric)))
    attitude_text, by_attitude_m_s = attitude
    by_altitude_m_s = abs(altitude * speed_m_s)
    if not metric.startswith("velocity_error") or math.isnan(error_m_s + by_attitude_m_s + by_altitude_m_s):
        return None
    if by_attitude_m_s >= 0.5 * error_m_s:
        return Cause("attitude error", f"{attitude_text} causes up to {number(by_attitude_m_s)} m/s")
    if by_altitude_m_s >= 0.5 * error_m_s:
        text = f"the altitude error of {percent(abs(altitude))} causes up to {number(by_altitude_m_s)} m/s"
        return Cause("altitude error", text)
    return Cause("images", "attitude and altitude errors explain less than half of it")


DIMES = Presentation(
    cases=(STREAM_CASE, DIMES_CASE),
    sections=(ignition_section, landing_section, sensitivity_section),
    outcomes=(VelocityOutcome,),
    explain=explain,
)
