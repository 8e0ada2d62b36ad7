"""Presentation of descents in reports: sections, and views of single cases (figures and a table).

A DIMES case has three images. A velocity stream is an algorithm that answers after each of any number of images.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from marsyard.algorithms.interface import VelocityOutcome
from marsyard.reports.dimes import case_figures as figures
from marsyard.reports.dimes.sections import ignition_section, landing_section, sensitivity_section
from marsyard.reports.figure_style import INK, MARKERS, MUTED, SERIES, in_page_style
from marsyard.reports.images import Panel, fill_panels
from marsyard.reports.presentation import CaseFigure, CaseKind, CaseView, Cause, Presentation, TableRow
from marsyard.reports.products import Products, check_shape, numeric_product, read_arrays, to_float, to_matrix
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
_LEGEND = (
    "Top row: images rectified to a view from directly above, north up. Middle row, if there are templates: templates "
    "and search windows, cut from the rectified images. Bottom row: {images} Squares in the bottom row mark "
    "positions, not sizes. Positions in the table are pixels of the images in the bottom row, from 0 at the upper "
    "left. Each velocity in the table is the mean between the two images of the pair. DIMES combines each valid track "
    "of pair 1 with each valid track of pair 2. It selects the combination whose velocity change agrees best with "
    "the IMU. It reports the velocity of the selected track of pair 2, the later pair. If the smallest difference "
    "from the IMU is too large, no velocity is reported."
)


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
    legend = _LEGEND.format(images=_describe_images(products))
    return CaseView(drawn, [*facts, *_format_selection(products)], head, rows, legend)


def _create_track_table(products: Products) -> tuple[list[str], list[TableRow]]:
    """Create the headings and the rows of the table of tracks."""
    tracks = figures.read_tracks(products)
    names = dict.fromkeys(name for track in tracks for name in track.values)
    positions = {heading: pair for heading, pair in _POSITIONS.items() if {*pair} <= {*names}}
    hidden_names = {*_HIDDEN_COLUMNS, *(name for pair in positions.values() for name in pair)}
    quantities = [name for name in names if name not in hidden_names and not name.startswith("failed_")]
    selected_pair = check_shape(products.get("selected"), 2)
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
    combinations = check_shape(products.get("combinations"), None, 3)
    if combinations is None or not len(combinations):
        return []
    differences = [f"{number(float(value))} m/s" for value in np.sort(combinations[:, 2])]
    is_selected = check_shape(products.get("selected"), 2) is not None
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


#: Maximum number of images in a row of a stream's figure.
_MAX_PER_ROW = 10


def _read_stream(products: Products) -> Float[np.ndarray, "n 6"] | None:
    """Read a row for each image: start and end of the time span, estimate, truth (east, north); NaN if missing."""
    names = ("after_spans_s", "after_velocities_m_s", "after_true_m_s")
    parts = read_arrays(products, dict.fromkeys(names, ("n", 2)))
    return np.concatenate(parts, axis=1) if parts is not None and len(parts[0]) else None


def is_stream_case(products: Products) -> bool:
    """Whether products contain the answers of a velocity stream after each of its images."""
    table = _read_stream(products)
    return table is not None and all(
        to_matrix(products.get(f"image_{index + 1}")) is not None for index in range(len(table))
    )


def view_stream(products: Products, _complete: bool = False) -> CaseView:
    """Create the view of a velocity stream: its images, and the estimate after each image."""
    rows = []
    for image_number, row in enumerate(_require_stream(products), start=1):
        is_answered = bool(np.isfinite(row[2]))
        values = [number(float(value)) for value in (*row, np.hypot(row[2] - row[4], row[3] - row[5]))]
        rows.append(TableRow([str(image_number), *(values if is_answered else ["" for _ in values])], is_answered))
    head = ["After image", "From (s)", "To (s)", "East (m/s)", "North (m/s)"]
    head += ["True east", "True north", "Error (m/s)"]
    caption = "Images of the stream, and the estimated velocity after each image."
    return CaseView([CaseFigure("stream", draw_stream_case(products), caption)], head=head, rows=rows)


def _require_stream(products: Products) -> Float[np.ndarray, "n 6"]:
    """Read the velocity stream as in `_read_stream`. Raises ValueError if it is missing."""
    table = _read_stream(products)
    if table is None:
        raise ValueError("the products contain no velocity stream")
    return table


@in_page_style
def draw_stream_case(products: Products) -> Figure:
    """Draw the images in rows, and both components of the velocity after each image."""
    table = _require_stream(products)
    n_rows = -(-len(table) // _MAX_PER_ROW)
    figure = Figure(figsize=(12.0, 3.4 + 1.6 * n_rows), layout="constrained")
    cells = figure.add_gridspec(2, 1, height_ratios=(1.6 * n_rows, 3.4))
    upper, lower = (figure.add_subfigure(part) for part in (cells[0], cells[1]))
    names = range(1, len(table) + 1)
    panels = [Panel(figures.read_square_image(products, f"image_{name}"), str(name)) for name in names]
    n_columns = min(len(table), _MAX_PER_ROW)
    panels += [Panel() for _ in range(n_rows * n_columns - len(panels))]
    fill_panels(upper, [panels[first : first + n_columns] for first in range(0, len(panels), n_columns)])
    answered_rows = table[np.isfinite(table[:, 2])]
    start, end = answered_rows[:, 0], answered_rows[:, 1]
    centres = 0.5 * (start + end)
    for component, (name, axes) in enumerate(zip(("east", "north"), lower.subplots(1, 2), strict=True)):
        estimates, truth = answered_rows[:, 2 + component], answered_rows[:, 4 + component]
        axes.hlines(truth, start, np.maximum(end, start), color=INK, linewidth=1.0)
        axes.plot(centres, truth, color=INK, linewidth=1.0, label="true")
        style: dict[str, Any] = {"fmt": MARKERS[component], "color": SERIES[component], "ecolor": MUTED}
        axes.errorbar(centres, estimates, xerr=0.5 * (end - start), label="answered", **style)
        if len(answered_rows):
            axes.legend()
        axes.set(xlabel="Time tag (s)", ylabel=f"Velocity {name} (m/s)")
    return figure


STREAM_CASE = CaseKind(is_stream_case, view_stream, note_text("dimes.stream_legend"))
# every view has its own legend
DIMES_CASE = CaseKind(figures.is_dimes_case, view)


def explain(row: Mapping[str, Any], metric: str) -> Cause | None:
    """Compare a velocity error with the errors that attitude and altitude cause alone.

    An attitude error a makes v tan(a) of the descent rate v appear as horizontal velocity; a relative altitude error
    scales the horizontal velocity.
    """
    error_m_s = abs(to_float(row.get(metric)))
    if "velocity_error" not in metric or math.isnan(error_m_s):
        return None
    attitude_deg, rate_m_s = (to_float(row.get(name)) for name in ("attitude_error_common_deg", "descent_rate_m_s"))
    altitude, speed_m_s = (to_float(row.get(name)) for name in ("altitude_error_common", "horizontal_speed_m_s"))
    by_attitude_m_s = abs(rate_m_s * math.tan(math.radians(attitude_deg)))
    by_altitude_m_s = abs(altitude * speed_m_s)
    if by_attitude_m_s >= 0.5 * error_m_s:
        text = f"the attitude error of {number(attitude_deg)} deg causes up to {number(by_attitude_m_s)} m/s"
        return Cause("attitude error", text)
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
