"""Section on reported sites and hazards compared with the ground truth.

Figures and "the paper" refer to Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int
from matplotlib.figure import Figure

from marsyard.reports import populations, rates, section
from marsyard.reports.blocks import rate_block
from marsyard.reports.column_values import numbers
from marsyard.reports.figure_style import in_page_style
from marsyard.reports.hda.landing_cases import ANSWERS, INTERVAL_NOTE, classify_answers, landing_rows
from marsyard.reports.plots import RateLine, cumulative_figure, draw_rates
from marsyard.reports.rates import CONFIDENCE, PooledRate, pooled_rate, rate_text
from marsyard.reports.section import (
    Block,
    Grid,
    Section,
    Subject,
    build_grid,
    create_section,
    drop_empty_columns,
    svg_figure,
)
from marsyard.reports.statistics.samples import is_interpolated, quantile_bounds
from marsyard.reports.wording import NOTHING, format_fraction, note_text, number
from marsyard.scenarios.landing.map_score import CLASS_BOUNDS, CLASS_NAMES

#: Minimum number of values for a cumulative curve.
MIN_CURVE_VALUES = 5
#: Classes of the true ground that both images show, best first, with their texts in the table. All positions within one
#: lander radius of a wide safe site are also safe.
GROUNDS = {
    "wide safe site": "a wide safe site exists",
    "narrow safe site": "only narrow safe sites exist",
    "no safe site": "no safe site exists",
}


def site_fractions(frame: pd.DataFrame) -> dict[str, rates.CaseFraction]:
    """Compute fractions of correct answers by class of the true ground; classes without cases are omitted."""
    is_reported, is_refused, is_safe = (
        populations.flag_mask(frame, name) for name in ("site_reported", "no_site_reported", "site_safe")
    )
    has_wide_site, has_narrow_site, has_no_safe_site = _ground_masks(frame).values()
    is_correct = is_refused | (is_reported & is_safe)
    fractions = {
        "reported sites that are truly safe": rates.fraction_of(is_safe[is_reported], frame[is_reported]),
        "site reported if a wide safe site exists": rates.fraction_of(is_reported[has_wide_site], frame[has_wide_site]),
        "truly safe site or 'no safe site' if only narrow safe sites exist": rates.fraction_of(
            is_correct[has_narrow_site], frame[has_narrow_site]
        ),
        "answer 'no safe site' if no safe site exists": rates.fraction_of(
            is_refused[has_no_safe_site], frame[has_no_safe_site]
        ),
    }
    return {name: fraction for name, fraction in fractions.items() if fraction.n}


def _ground_masks(frame: pd.DataFrame) -> dict[str, Bool[np.ndarray, " n"]]:
    """Create the mask of each class of the true ground (`GROUNDS`)."""
    has_wide_site, has_safe_site, has_no_safe_site = (
        populations.flag_mask(frame, name) for name in ("wide_site_exists", "safe_site_exists", "no_safe_site_exists")
    )
    return dict(zip(GROUNDS, (has_wide_site, has_safe_site & ~has_wide_site, has_no_safe_site), strict=True))


def outcome_counts(frame: pd.DataFrame) -> dict[str, dict[str, int]]:
    """Count flights by true ground (`GROUNDS`) and name of the outcome (`ANSWERS`)."""
    answer_masks = classify_answers(frame)
    return {
        ground: {answer.name: int((ground_mask & answer_masks[key]).sum()) for key, answer in ANSWERS.items()}
        for ground, ground_mask in _ground_masks(frame).items()
    }


def create_outcome_block(frame: pd.DataFrame) -> Block:
    """Create the table of the outcomes of the search by class of the true ground."""
    counts = outcome_counts(frame)
    rows = [
        [GROUNDS[ground], *(f"{answer_counts[answer.name]:,}" for answer in ANSWERS.values())]
        for ground, answer_counts in counts.items()
    ]
    head = ["Ground truth", *(answer.heading for answer in ANSWERS.values())]
    note = note_text("hda.outcomes")
    grid, data = Grid(head, rows), {"outcomes": counts}
    return Block(heading="Answers by ground truth", grid=grid, note=note, data=data)


class HazardDistances(NamedTuple):
    """Distances to the nearest unsafe position of the grid, and the terrain of each flight (None if unknown).

    distances_m: 0 on unsafe ground; infinite if the grid has no unsafe position
    """

    distances_m: Float[np.ndarray, " n"]
    terrains: Int[np.ndarray, " n"] | None


def hazard_distances(frame: pd.DataFrame) -> dict[str, HazardDistances]:
    """Collect the distances of reported sites and of true touchdowns to the nearest hazard."""
    rows_with_site = frame[populations.flag_mask(frame, "site_reported")]
    distances = {}
    for name, rows, prefix in (("reported site", rows_with_site, "site"), ("true touchdown", frame, "touchdown")):
        values = numbers(rows, f"{prefix}_hazard_distance_m")
        if f"{prefix}_safe" in rows:
            is_unsafe = rows[f"{prefix}_safe"].eq(False).fillna(False).to_numpy(dtype=np.bool_)
            values = np.where(is_unsafe & ~np.isnan(values), 0.0, values)
        is_known = ~np.isnan(values)
        distances[name] = HazardDistances(values[is_known], rates.terrain_groups(rows[is_known]))
    return distances


def distance_grid(distances: Mapping[str, HazardDistances]) -> Grid:
    """Create a table of minimum distance, median, 5 % quantile, and lower bound of the 5 % quantile."""
    rows = []
    for name, (values, terrains) in distances.items():
        if values.size:
            bound, _ = quantile_bounds(values, 0.05, CONFIDENCE, terrains)
            # the method does not interpolate, since values can be infinite
            low, median = (float(np.quantile(values, probability, method="lower")) for probability in (0.05, 0.5))
            texts = [_distance_text(float(values.min()))]
            texts.append(_distance_text(median) if values.size >= MIN_CURVE_VALUES else NOTHING)
            texts.append(_distance_text(low) if is_interpolated(values.size, 0.05) else NOTHING)
            counts = [f"{n:,}" for n in (values.size, int((values == 0.0).sum()), int(np.isinf(values).sum()))]
            rows.append([name, *counts, *texts, NOTHING if math.isinf(bound) else _distance_text(bound)])
    bound_head = f"5 % quantile, lower bound at {format_fraction(CONFIDENCE)} confidence (m)"
    count_heads = ["Flights", "On unsafe ground", "No unsafe position in the area"]
    return Grid(["", *count_heads, "Minimum distance (m)", "Median (m)", "5 % quantile (m)", bound_head], rows)


def _distance_text(distance_m: float) -> str:
    return "0" if distance_m == 0.0 else number(distance_m)


def create_distance_block(frame: pd.DataFrame) -> Block | None:
    """Create table and curves of the distances to true hazards; no curves for few distances."""
    distances = hazard_distances(frame)
    grid = drop_empty_columns(distance_grid(distances))
    if not grid.rows:
        return None
    curves = {name: values for name, (values, _) in distances.items()}
    all_values = np.concatenate([*curves.values()])
    edge_m = float(np.max(all_values[np.isfinite(all_values)], initial=0.0))
    figures = []
    if edge_m > 0.0 and max(values.size for values in curves.values()) >= MIN_CURVE_VALUES:
        # infinite distances lie beyond the axis
        curves = {name: np.where(np.isinf(values), 2.0 * edge_m, values) for name, values in curves.items()}
        labels = ("distance to the nearest unsafe position (m)", "fraction above this distance")
        figure = cumulative_figure(curves, labels, complementary=True)
        figure.axes[0].set_xlim(0.0, 1.02 * edge_m)
        figures.append(svg_figure(figure, "distances", "The drop at 0 is the fraction on unsafe ground."))
    note = note_text("hda.distances")
    return Block(heading="Distance to true hazards", figures=figures, grid=grid, note=note)


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
    footprint_rates = {name: pooled_rate(rate_rows, *columns) for name, columns in RATES.items()}
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
        [name, f"{item.hits:,} of {item.total:,}", rate_text(item)]
        for name, item in footprint_rates.items()
        if item.total > 0
    ]
    rate_grid = Grid(["", "Footprints", f"Fraction ({format_fraction(CONFIDENCE)} interval)"], rows)
    figures = []
    if any(item.called_safe.hits or item.unflagged.hits for item in hazards):
        caption = "Bars are the intervals of the table. There is no bar if the rate is 0."
        figures.append(section.svg_figure(class_figure(hazards), "classes", caption))
    blocks = [Block(heading="Missed hazards by size", figures=figures, grid=class_grid)] if hazards else []
    data = {"rates": footprint_rates, "classes": classes}
    note = f"{note_text('hda.classes')} {note_text('hda.footprint_rates', confidence=format_fraction(CONFIDENCE))}"
    return [*blocks, Block(heading="Safe footprints and large hazards", grid=rate_grid, note=note, data=data)]


@in_page_style
def class_figure(classes: Sequence[HazardClass]) -> Figure:
    """Draw the fractions of missed hazards against their size, by roughness and by slope."""
    figure = Figure(figsize=(7.2, 3.3), layout="constrained")
    drawn_rates = [rate for item in classes for rate in (item.called_safe, item.unflagged)]
    top = float(np.nanmax([(rate.fraction, rate.upper) for rate in drawn_rates], initial=0.0)) or 1.0
    for axes, kind in zip(figure.subplots(1, 2, sharey=True), ("roughness", "slope"), strict=True):
        kind_classes = [item for item in classes if item.kind == kind]
        positions = np.arange(len(kind_classes))
        # the two marks of a class are next to each other
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


def sites_section(subject: Subject) -> Section | None:
    """Compare sites and hazards with the ground truth; None if the rows are not those of landings."""
    frame = landing_rows(subject)
    if frame is None:
        return None
    fractions = rate_block(site_fractions(frame), "Flights", "Fractions of correct answers", INTERVAL_NOTE, "fractions")
    return create_section(
        "sites",
        "Sites",
        "Sites and hazards compared with the ground truth",
        create_outcome_block(frame),
        fractions,
        create_distance_block(frame),
        *create_class_blocks(frame),
    )
