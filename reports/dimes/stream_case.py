"""View of a case of a velocity stream: an algorithm that answers after each of any number of images."""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.figure import Figure

from marsyard.reports.dimes import case_figures as figures
from marsyard.reports.figure_style import INK, MARKERS, MUTED, SERIES, in_page_style
from marsyard.reports.images import Panel, fill_panels
from marsyard.reports.presentation import CaseFigure, CaseKind, CaseView, TableRow
from marsyard.reports.products import Products, read_arrays, to_matrix
from marsyard.reports.wording import note_text, number

#: Maximum number of images in a row of a stream's figure.
_MAX_PER_ROW = 10


class _StreamAnswers(NamedTuple):
    """Answers of a velocity stream, one for each image.

    - spans_s: start and end of the time span that an answer describes
    - estimated_m_s, true_m_s: velocity (east, north); the estimate is NaN without an answer
    """

    spans_s: Float[np.ndarray, "n 2"]
    estimated_m_s: Float[np.ndarray, "n 2"]
    true_m_s: Float[np.ndarray, "n 2"]

    @property
    def is_answered(self) -> Bool[np.ndarray, " n"]:
        """Whether each image has an estimate."""
        return np.asarray(np.isfinite(self.estimated_m_s[:, 0]))


def _read_answers(products: Products) -> _StreamAnswers:
    """Read the answers of a stream; no answer if they are missing."""
    names = ("after_spans_s", "after_velocities_m_s", "after_true_m_s")
    arrays = read_arrays(products, dict.fromkeys(names, ("n", 2)))
    return _StreamAnswers(*([np.empty((0, 2))] * 3 if arrays is None else arrays))


def is_stream_case(products: Products) -> bool:
    """Whether products contain the answers of a velocity stream after each of its images."""
    n_answers = len(_read_answers(products).spans_s)
    images = [to_matrix(products.get(f"image_{index + 1}")) for index in range(n_answers)]
    return bool(images) and all(image is not None for image in images)


def view_stream(products: Products, _complete: bool = False) -> CaseView:
    """Create the view of a velocity stream: its images, and the estimate after each image."""
    answers = _read_answers(products)
    rows = []
    for index, is_answered in enumerate(answers.is_answered.tolist()):
        span_s, estimated, true = (array[index] for array in answers)
        values = [number(float(value)) for value in (*span_s, *estimated, *true, np.hypot(*(estimated - true)))]
        rows.append(TableRow([str(index + 1), *(values if is_answered else ["" for _ in values])], is_answered))
    head = ["After image", "From (s)", "To (s)", "East (m/s)", "North (m/s)"]
    head += ["True east", "True north", "Error (m/s)"]
    caption = "Images of the stream, and the estimated velocity after each image."
    return CaseView([CaseFigure("stream", draw_stream_case(products), caption)], head=head, rows=rows)


@in_page_style
def draw_stream_case(products: Products) -> Figure:
    """Draw the images in rows, and both components of the velocity after each image."""
    answers = _read_answers(products)
    n_images = len(answers.spans_s)
    n_rows = math.ceil(n_images / _MAX_PER_ROW)
    figure = Figure(figsize=(12.0, 3.4 + 1.6 * n_rows), layout="constrained")
    cells = figure.add_gridspec(2, 1, height_ratios=(1.6 * n_rows, 3.4))
    upper, lower = (figure.add_subfigure(part) for part in (cells[0], cells[1]))
    names = range(1, n_images + 1)
    panels = [Panel(figures.read_square_image(products, f"image_{name}"), str(name)) for name in names]
    n_columns = min(n_images, _MAX_PER_ROW)
    panels += [Panel() for _ in range(n_rows * n_columns - len(panels))]
    fill_panels(upper, [panels[first : first + n_columns] for first in range(0, len(panels), n_columns)])
    spans_s, estimated_m_s, true_m_s = (array[answers.is_answered] for array in answers)
    start, end = spans_s.T
    centres = 0.5 * (start + end)
    for component, (name, axes) in enumerate(zip(("east", "north"), lower.subplots(1, 2), strict=True)):
        estimates, truth = estimated_m_s[:, component], true_m_s[:, component]
        axes.hlines(truth, start, np.maximum(end, start), color=INK, linewidth=1.0)
        axes.plot(centres, truth, color=INK, linewidth=1.0, label="true")
        style: dict[str, Any] = {"fmt": MARKERS[component], "color": SERIES[component], "ecolor": MUTED}
        axes.errorbar(centres, estimates, xerr=0.5 * (end - start), label="answered", **style)
        if len(spans_s):
            axes.legend()
        axes.set(xlabel="Time tag (s)", ylabel=f"Velocity {name} (m/s)")
    return figure


STREAM_CASE = CaseKind(is_stream_case, view_stream, note_text("dimes.stream_legend"))
