"""Tables and figure of missed hazards by size.

"The paper" is Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from marsyard.reports import section
from marsyard.reports.column_values import numbers
from marsyard.reports.figure_style import in_page_style
from marsyard.reports.plots import RateLine, draw_rates
from marsyard.reports.rates import CONFIDENCE, PooledRate, pooled_rate, rate_text
from marsyard.reports.section import Block, Grid, build_grid
from marsyard.reports.wording import format_fraction
from marsyard.scenarios.landing.score import CLASS_BOUNDS, CLASS_NAMES


@dataclass(frozen=True)
class HazardClass:
    """Hazards of one size class.

    - kind: `roughness` (the height of the hazard) or `slope`
    - low, high: bounds of the class divided by the lander's limit
    - called_safe: fraction of footprints that the map classifies as safe
    - unflagged: fraction of footprints without a detected hazard before hazard growth
    """

    kind: str
    low: float
    high: float
    called_safe: PooledRate
    unflagged: PooledRate

    @property
    def is_hazard(self) -> bool:
        """Whether the footprints exceed the limit."""
        return self.low >= 1.0

    @property
    def name(self) -> str:
        """Text of the bounds."""
        if self.low == 0.0:
            return f"< {self.high:g}"
        return f"> {self.low:g}" if math.isinf(self.high) else f"{self.low:g} to {self.high:g}"


#: Rates of footprints over all flights: columns of the counted and of all footprints, by name. A large hazard has at
#: least twice the roughness limit and a diameter of at least three map cells.
RATES: Mapping[str, tuple[str, str]] = {
    "truly safe footprints that are classified as safe": ("footprints_called_safe_rightly", "footprints_truly_safe"),
    "truly safe footprints with a detected hazard (false alarms)": ("false_alarms", "footprints_truly_safe"),
    "footprints classified as safe that are not truly safe": (
        "footprints_called_safe_unsafe",
        "footprints_called_safe",
    ),
    "footprints with a large hazard that are classified as safe": ("gross_hazards_called_safe", "gross_hazards"),
    "footprints with a large hazard, but without a detected hazard": ("gross_hazards_unflagged", "gross_hazards"),
}
_CLASS_NOTE = (
    "A footprint is the circle that the lander covers around a grid point. Only footprints that both images show "
    "completely and that have values in the map are counted. The grid spacing is one tenth of the lander diameter, so "
    "footprints overlap. The roughness of a footprint is the height of its highest obstacle. Detected: the map of "
    "slope or roughness exceeds the limit in at least one cell of the footprint. Classified as safe: the safe landing "
    "map marks the centre of the footprint as safe. Footprints within the limit of the quantity are not in the first "
    "table."
)
_RATE_NOTE = (
    "A truly safe footprint without a detected hazard is still not classified as safe if it is close to a hazard, to "
    "a hole or to the border of the map, or if a further check of the algorithm rejects it. A large hazard is at "
    "least three cells wide and at least twice as high as the roughness limit. The intervals are "
    f"{format_fraction(CONFIDENCE)} bootstrap intervals over flights, or over terrains if flights share terrains. "
    "There is no interval if the rate is 0."
)


def count_hazard_classes(frame: pd.DataFrame) -> list[HazardClass]:
    """Count missed hazards by size; empty if the rows do not contain the counts."""
    edges = (0.0, *CLASS_BOUNDS, math.inf)
    classes = []
    for kind in ("roughness", "slope"):
        for class_name, low, high in zip(CLASS_NAMES, edges[:-1], edges[1:], strict=True):
            column = f"footprints_{kind}_{class_name}"
            if column in frame:
                called_safe, unflagged = (
                    pooled_rate(frame, f"{column}_{ending}", column) for ending in ("safe", "unflagged")
                )
                classes.append(HazardClass(kind, low, high, called_safe, unflagged))
    return classes


def create_class_blocks(frame: pd.DataFrame) -> list[Block]:
    """Create figure and tables of missed hazards by size, and of rates of footprints; nothing without the counts."""
    classes = count_hazard_classes(frame)
    if not classes:
        return []
    n_safe_rightly = numbers(frame, "footprints_called_safe") - numbers(frame, "footprints_called_safe_unsafe")
    rate_rows = frame.assign(footprints_called_safe_rightly=n_safe_rightly)
    rates = {name: pooled_rate(rate_rows, *columns) for name, columns in RATES.items()}
    hazards = [item for item in classes if item.is_hazard and item.called_safe.total]
    class_grid = build_grid(
        hazards,
        {
            "Quantity": lambda item: item.kind,
            "Size divided by limit": lambda item: item.name,
            "Footprints": lambda item: f"{item.called_safe.total:,}",
            "Flights": lambda item: f"{item.called_safe.flights:,}",
            "Classified as safe": lambda item: rate_text(item.called_safe),
            "Not detected": lambda item: rate_text(item.unflagged),
            "Flights with an undetected hazard": lambda item: f"{item.unflagged.flights_hit:,}",
        },
    )
    rows = [
        [name, f"{item.hits:,} of {item.total:,}", rate_text(item)] for name, item in rates.items() if item.total > 0
    ]
    rate_grid = Grid(["", "Footprints", f"Fraction ({format_fraction(CONFIDENCE)} interval)"], rows)
    figures = []
    if any(item.called_safe.hits or item.unflagged.hits for item in hazards):
        caption = "Bars are the intervals of the table. There is no bar if the rate is 0."
        figures.append(section.svg_figure(class_figure(hazards), "classes", caption))
    blocks = [Block(heading="Missed hazards by size", figures=figures, grid=class_grid)] if hazards else []
    data = {"rates": rates, "classes": classes}
    heading, note = "Safe footprints and large hazards", f"{_CLASS_NOTE} {_RATE_NOTE}"
    return [*blocks, Block(heading=heading, grid=rate_grid, note=note, data=data)]


@in_page_style
def class_figure(classes: Sequence[HazardClass]) -> Figure:
    """Draw the fractions of missed hazards against their size, by roughness and by slope."""
    figure = Figure(figsize=(7.2, 3.3), layout="constrained")
    rates = [rate for item in classes for rate in (item.called_safe, item.unflagged)]
    top = float(np.nanmax([(rate.fraction, rate.upper) for rate in rates], initial=0.0)) or 1.0
    for axes, kind in zip(figure.subplots(1, 2, sharey=True), ("roughness", "slope"), strict=True):
        kind_classes = [item for item in classes if item.kind == kind]
        positions = np.arange(len(kind_classes))
        called_safe = RateLine(
            "classified as safe", (positions - 0.08).tolist(), [item.called_safe for item in kind_classes]
        )
        unflagged = RateLine("not detected", (positions + 0.08).tolist(), [item.unflagged for item in kind_classes])
        draw_rates(axes, (called_safe, unflagged), linestyle="")
        axes.set_xticks(positions, [item.name for item in kind_classes])
        axes.set(title=kind, xlabel="size divided by the lander's limit", ylim=(-0.03 * top, 1.05 * top))
    figure.axes[0].set_ylabel("fraction of footprints")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure
