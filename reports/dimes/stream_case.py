"""View of a case of a velocity stream: an algorithm that answers after each of any number of images."""

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from marsyard.reports.dimes import case_figures as figures
from marsyard.reports.figure_style import INK, MARKERS, MUTED, SERIES, in_page_style
from marsyard.reports.images import Panel, fill_panels
from marsyard.reports.presentation import CaseFigure, CaseKind, CaseView, TableRow
from marsyard.reports.products import Products, read_arrays, to_matrix
from marsyard.reports.wording import note_text, number

#: Maximum number of images in a row of a stream's figure.
_MAX_PER_ROW = 10


def _read_stream(products: Products) -> Float[np.ndarray, "n 6"]:
    """Read a row for each image: start and end of the time span, estimate, truth (east, north); no row if missing."""
    names = ("after_spans_s", "after_velocities_m_s", "after_true_m_s")
    parts = read_arrays(products, dict.fromkeys(names, ("n", 2)))
    return np.empty((0, 6)) if parts is None else np.concatenate(parts, axis=1)


def is_stream_case(products: Products) -> bool:
    """Whether products contain the answers of a velocity stream after each of its images."""
    images = [to_matrix(products.get(f"image_{index + 1}")) for index in range(len(_read_stream(products)))]
    return bool(images) and all(image is not None for image in images)


def view_stream(products: Products, _complete: bool = False) -> CaseView:
    """Create the view of a velocity stream: its images, and the estimate after each image."""
    rows = []
    for image_number, row in enumerate(_read_stream(products), start=1):
        is_answered = bool(np.isfinite(row[2]))
        values = [number(float(value)) for value in (*row, np.hypot(row[2] - row[4], row[3] - row[5]))]
        rows.append(TableRow([str(image_number), *(values if is_answered else ["" for _ in values])], is_answered))
    head = ["After image", "From (s)", "To (s)", "East (m/s)", "North (m/s)"]
    head += ["True east", "True north", "Error (m/s)"]
    caption = "Images of the stream, and the estimated velocity after each image."
    return CaseView([CaseFigure("stream", draw_stream_case(products), caption)], head=head, rows=rows)


@in_page_style
def draw_stream_case(products: Products) -> Figure:
    """Draw the images in rows, and both components of the velocity after each image."""
    table = _read_stream(products)
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
