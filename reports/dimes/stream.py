"""What is shown of a descent whose pictures were taken one by one: the pictures, and what was known after each."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from marsyard.reports.presentation import CaseKind, CaseView, TableRow, numbers, plane, save_figures
from marsyard.reports.section import plate
from marsyard.reports.svg import INK, MARKERS, MUTED, SERIES, in_page_style
from marsyard.reports.wording import number

#: Pictures that a row of the figure holds.
_MOST_IN_ROW = 10
_AXES = ("east", "north")
_LEGEND = (
    "The pictures as delivered, in their order. Below, the velocity that was answered after each picture (marks, at "
    "the middle of the span that it is of; bars: that span) and the true one of the same span (lines)."
)


def is_stream_case(products: Mapping[str, Any]) -> bool:
    """Whether products hold what a stream answered after each of its pictures."""
    answers = _answers(products)
    return answers is not None and all(plane(products.get(f"image_{k + 1}")) is not None for k in range(len(answers)))


def view(products: Mapping[str, Any], key: str) -> CaseView:
    """A stream's case."""
    rows = []
    for place, (start, end, east, north, true_east, true_north) in enumerate(_table(products), start=1):
        answered = bool(np.isfinite(east))
        error = np.hypot(east - true_east, north - true_north)
        values = [number(float(value)) for value in (start, end, east, north, true_east, true_north, error)]
        rows.append(TableRow([str(place), *(values if answered else ["" for _ in values])], answered))
    head = [
        "After picture",
        "From (s)",
        "To (s)",
        "East (m/s)",
        "North (m/s)",
        "True east",
        "True north",
        "Error (m/s)",
    ]
    drawn = plate(draw_stream_case(products), f"{key}stream", "Pictures, and what was known after each.", wide=True)
    return CaseView(facts=[], plates=[drawn], head=head, rows=rows)


@in_page_style
def draw_stream_case(products: Mapping[str, Any]) -> Figure:
    """The pictures in rows, and both components of the velocity after each."""
    table = _table(products)
    lines = -(-len(table) // _MOST_IN_ROW)
    figure = Figure(figsize=(12.0, 3.4 + 1.6 * lines), layout="constrained")
    parts = figure.add_gridspec(2, 1, height_ratios=(1.6 * lines, 3.4))
    upper, lower = (figure.add_subfigure(part) for part in (parts[0], parts[1]))
    in_row = min(len(table), _MOST_IN_ROW)
    for place, axes in enumerate(upper.subplots(lines, in_row, squeeze=False).ravel()):
        axes.set_axis_off()
        picture = plane(products.get(f"image_{place + 1}"))
        if picture is not None and place < len(table):
            low, high = np.quantile(picture, (0.01, 0.99))
            axes.imshow(picture, cmap="gray", vmin=low, vmax=max(high, low + 1.0), aspect="auto")
            axes.set_box_aspect(1.0)
            axes.set_title(str(place + 1), fontsize=9)
    for component, axes in enumerate(lower.subplots(1, len(_AXES))):
        _draw_component(axes, table, component)
    return figure


def _draw_component(axes: Axes, table: Float[np.ndarray, "n 6"], component: int) -> None:
    given = table[np.isfinite(table[:, 2])]
    middles = 0.5 * (given[:, 0] + given[:, 1])
    answered, true = given[:, 2 + component], given[:, 4 + component]
    axes.hlines(true, given[:, 0], np.maximum(given[:, 1], given[:, 0]), color=INK, linewidth=1.0)
    axes.plot(middles, true, color=INK, linewidth=1.0, label="true")
    axes.errorbar(
        middles,
        answered,
        xerr=0.5 * (given[:, 1] - given[:, 0]),
        fmt=MARKERS[component],
        color=SERIES[component],
        ecolor=MUTED,
        label="answered",
    )
    axes.set(xlabel="Time tag (s)", ylabel=f"Velocity {_AXES[component]} (m/s)")
    if len(given):
        axes.legend()


def _answers(products: Mapping[str, Any]) -> Float[np.ndarray, "_ _"] | None:
    """Velocities after each picture; None where the products hold none in a form that can be read."""
    parts = [plane(products.get(f"after_{name}")) for name in ("spans_s", "velocities_m_s", "true_m_s")]
    if any(part is None or part.shape[1] != len(_AXES) for part in parts):
        return None
    return numbers(products["after_velocities_m_s"]) if len({len(p) for p in parts if p is not None}) == 1 else None


def _table(products: Mapping[str, Any]) -> Float[np.ndarray, "n 6"]:
    """Begin and end of the span, the answer and the truth (east, north), of each picture; NaN where none was given."""
    names = ("after_spans_s", "after_velocities_m_s", "after_true_m_s")
    return np.concatenate([np.asarray(products[name], dtype=np.float64) for name in names], axis=1)


def _write(directory: Path, products: Mapping[str, Any]) -> list[Path]:
    return save_figures(directory, {"stream": draw_stream_case(products)})


STREAM_CASE = CaseKind(is_stream_case, view, _write, _LEGEND)
