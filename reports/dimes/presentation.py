"""Presentation of descents: report sections, and views of DIMES cases and of velocity streams."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from marsyard.reports import presentation
from marsyard.reports.dimes import case_figures as figures
from marsyard.reports.dimes.sections import FIRING, LANDING, field_test_section, sensitivity_section
from marsyard.reports.presentation import (
    CaseKind,
    CaseView,
    Presentation,
    TableRow,
    numeric_product,
    plane,
    read_arrays,
)
from marsyard.reports.section import INK, MARKERS, MUTED, SERIES, in_page_style, plate
from marsyard.reports.wording import label, note_text, number

#: Columns of the tracks that the page shows elsewhere or has no width for.
_NOT_SHOWN = ("pair", "template", "valid", "ground_east_m", "ground_north_m")


def view(products: Mapping[str, Any], key: str) -> CaseView:
    """A DIMES case; its pictures alone if the algorithm left no DIMES details."""
    if "tracks" not in products:
        pictures = figures.draw_delivered_pictures(products)
        shown = plate(pictures, f"{key}pictures", "The three pictures that the algorithm was given.", wide=True)
        return CaseView(_velocities(products), [shown], [], [], note_text("dimes.plain_legend"))
    pairs = enumerate(("first and second picture", "second and third picture"))
    plates = [
        plate(figures.draw_dimes_pair(products, k), f"{key}pair{k}", f"Pair {k + 1}: {name}.") for k, name in pairs
    ]
    tracks = figures.tracks(products)
    names = dict.fromkeys(name for track in tracks for name in track.values)
    quantities = [name for name in names if name not in _NOT_SHOWN and not name.startswith("failed_")]
    head = ["Pair", "Template", "Failed checks", *(label(name) for name in quantities)]
    rows = []
    for track in tracks:
        failed = [name for name, value in track.values.items() if name.startswith("failed_") and value == 1.0]
        checks = ", ".join(name.removeprefix("failed_").replace("_", " ") for name in failed)
        texts = [str(track.pair + 1), str(track.template + 1), checks or ("none" if track.valid else "unknown")]
        texts += [number(track.values.get(name, np.nan)) for name in quantities]
        rows.append(TableRow(texts, track.valid))
    return CaseView(_velocities(products), plates, head, rows)


def _velocities(products: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Estimated and true velocity, if the products hold them."""
    facts = []
    for key, name in (("velocity_estimated_m_s", "Estimated velocity"), ("velocity_true_m_s", "True velocity")):
        velocity = numeric_product(products.get(key))
        if velocity is not None and velocity.size >= 2 and np.isfinite(velocity.ravel()[:2]).all():
            east, north = velocity.ravel()[:2]
            facts.append((name, f"{east:+.2f} m/s east, {north:+.2f} m/s north"))
    return facts


#: Pictures in a row of a stream's figure.
_MAX_IN_ROW = 10


def _stream(products: Mapping[str, Any]) -> Float[np.ndarray, "n 6"] | None:
    """Begin and end of the time span, estimate and truth (east, north) after each picture; NaN where none was given."""
    parts = read_arrays(products, dict.fromkeys(("after_spans_s", "after_velocities_m_s", "after_true_m_s"), (None, 2)))
    if parts is None or len({len(part) for part in parts}) > 1 or not len(parts[0]):
        return None
    return np.concatenate(parts, axis=1)


def is_stream_case(products: Mapping[str, Any]) -> bool:
    """Whether products hold the answers of a velocity stream after each of its pictures."""
    table = _stream(products)
    return table is not None and all(plane(products.get(f"image_{k + 1}")) is not None for k in range(len(table)))


def view_stream(products: Mapping[str, Any], key: str) -> CaseView:
    """A velocity stream: its pictures, and the estimate after each."""
    rows = []
    for place, row in enumerate(_require_stream(products), start=1):
        answered = bool(np.isfinite(row[2]))
        values = [number(float(value)) for value in (*row, np.hypot(row[2] - row[4], row[3] - row[5]))]
        rows.append(TableRow([str(place), *(values if answered else ["" for _ in values])], answered))
    head = ["After picture", "From (s)", "To (s)", "East (m/s)", "North (m/s)"]
    head += ["True east", "True north", "Error (m/s)"]
    drawn = plate(draw_stream_case(products), f"{key}stream", "Pictures, and the estimate after each.", wide=True)
    return CaseView([], [drawn], head, rows)


def _require_stream(products: Mapping[str, Any]) -> Float[np.ndarray, "n 6"]:
    table = _stream(products)
    if table is None:
        raise ValueError("the products hold no velocity stream")
    return table


@in_page_style
def draw_stream_case(products: Mapping[str, Any]) -> Figure:
    """The pictures in rows, and both components of the velocity after each."""
    table = _require_stream(products)
    lines = -(-len(table) // _MAX_IN_ROW)
    figure = Figure(figsize=(12.0, 3.4 + 1.6 * lines), layout="constrained")
    parts = figure.add_gridspec(2, 1, height_ratios=(1.6 * lines, 3.4))
    upper, lower = (figure.add_subfigure(part) for part in (parts[0], parts[1]))
    panels = upper.subplots(lines, min(len(table), _MAX_IN_ROW), squeeze=False)
    for place, axes in enumerate(panels.ravel()):
        axes.set_axis_off()
        picture = plane(products.get(f"image_{place + 1}"))
        if picture is not None and place < len(table):
            low, high = np.quantile(picture, (0.01, 0.99))
            axes.imshow(picture, cmap="gray", vmin=low, vmax=max(high, low + 1.0), aspect="auto")
            axes.set_box_aspect(1.0)
            axes.set_title(str(place + 1), fontsize=9)
    answered = table[np.isfinite(table[:, 2])]
    start, end = answered[:, 0], answered[:, 1]
    centres = 0.5 * (start + end)
    for component, (name, axes) in enumerate(zip(("east", "north"), lower.subplots(1, 2), strict=True)):
        estimated, true = answered[:, 2 + component], answered[:, 4 + component]
        axes.hlines(true, start, np.maximum(end, start), color=INK, linewidth=1.0)
        axes.plot(centres, true, color=INK, linewidth=1.0, label="true")
        style: dict[str, Any] = {"fmt": MARKERS[component], "color": SERIES[component], "ecolor": MUTED}
        axes.errorbar(centres, estimated, xerr=0.5 * (end - start), label="answered", **style)
        if len(answered):
            axes.legend()
        axes.set(xlabel="Time tag (s)", ylabel=f"Velocity {name} (m/s)")
    return figure


def _write_stream(directory: Path, products: Mapping[str, Any]) -> list[Path]:
    return presentation.save_figures(directory, {"stream": draw_stream_case(products)})


STREAM_CASE = CaseKind(is_stream_case, view_stream, _write_stream, note_text("dimes.stream_legend"))
DIMES_CASE = CaseKind(figures.is_dimes_case, view, figures.write_dimes_figures, note_text("dimes.legend"))
DIMES = Presentation(cases=(STREAM_CASE, DIMES_CASE), sections=(FIRING, LANDING, sensitivity_section))
FIELD_TEST = Presentation(first=(field_test_section,))
