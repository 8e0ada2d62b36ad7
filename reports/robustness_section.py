"""Section on robust verdicts: changes that turn PASS into FAIL, and verdicts under other models."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from marsyard.reports.dispersion_changes import ChangeKind
from marsyard.reports.figure_style import MARKERS, MUTED, SERIES, in_page_style, new_axes
from marsyard.reports.robustness import ALL_DISPERSIONS, ChangeOutcome, Robustness, sort_key
from marsyard.reports.section import Block, Grid, Section, svg_figure
from marsyard.reports.variants import VariantVerdict
from marsyard.reports.verdicts import Status
from marsyard.reports.wording import NOTHING, note_text, number, percent

#: Maximum number of rows of the table of a requirement, and of parameters in the figure.
_MAX_ROWS, _MAX_PARAMETERS = 12, 16
_DIRECTIONS = {
    ChangeKind.MEAN_UP: ", up",
    ChangeKind.MEAN_DOWN: ", down",
    ChangeKind.WIDER: ", up",
    ChangeKind.NARROWER: ", down",
}
_OUTCOMES: Mapping[ChangeOutcome, str] = {
    ChangeOutcome.FOUND: "",
    ChangeOutcome.REFUSED: "unknown beyond",
    ChangeOutcome.NONE: "none up to",
}


def robustness_section(records: Sequence[Robustness], variants: Sequence[VariantVerdict]) -> Section | None:
    """Create the section; None for a run without a requirement that is met."""
    if not records and not variants:
        return None
    blocks = []
    if records:
        figure = svg_figure(_draw_changes(records), "robustness", note_text("common.robustness_caption"), wide=True)
        blocks.append(Block(figures=[figure], note=note_text("common.robustness")))
    for requirement in dict.fromkeys(item.requirement for item in records):
        own = [item for item in records if item.requirement == requirement]
        blocks.append(Block(f"Change to FAIL: {requirement}", grid=change_grid(own)))
    if variants:
        grid, bands = variant_grid(variants)
        blocks.append(Block("Other models", text=bands, grid=grid, note=note_text("common.variants")))
    data = {"variants": [asdict(item) for item in variants]}
    return Section("robustness", "Robustness", "How far the verdicts reach", blocks, data)


def change_grid(records: Sequence[Robustness]) -> Grid:
    """Create the table of a requirement, the smallest change first."""
    head = ["Quantity", "Assumed", "PASS up to", "FAIL from", "Change (spreads)", "Interval (spreads)", "Cases"]
    rows = [
        [
            f"{item.name}{_DIRECTIONS.get(item.kind, '')}",
            NOTHING if item.kind is ChangeKind.DIVERGENCE else item.format_value(item.assumed, 0.0),
            NOTHING if math.isnan(item.lower) else item.format_value(item.passes_at, item.lower),
            item.format_value(item.fails_at, item.change)
            if item.outcome is ChangeOutcome.FOUND
            else _OUTCOMES[item.outcome],
            number(item.change) if item.outcome is ChangeOutcome.FOUND else f"> {number(item.reach)}",
            f"{number(item.lower)} to {number(item.upper)}",
            f"{item.effective_cases:,.0f}",
        ]
        for item in records[:_MAX_ROWS]
    ]
    return Grid(head, rows, max(len(records) - _MAX_ROWS, 0))


def variant_grid(variants: Sequence[VariantVerdict]) -> tuple[Grid, str]:
    """Create the table of verdicts by variant and requirement; also return the band of each requirement in words."""
    requirements = list(dict.fromkeys(item.requirement for item in variants))
    texts = {
        (item.title, item.requirement): f"{item.status}: {percent(item.estimate)} "
        f"({percent(item.lower)} to {percent(item.upper)})"
        for item in variants
    }
    rows = [
        [title, *(texts.get((title, name), NOTHING) for name in requirements)]
        for title in dict.fromkeys(item.title for item in variants)
    ]
    bands = []
    for name in requirements:
        statuses = [item.status for item in variants if item.requirement == name]
        ordered = [str(status) for status in reversed(Status) if status in statuses]
        bands.append(f"{name}: {ordered[0] if len(ordered) == 1 else f'{ordered[0]} to {ordered[-1]}'}")
    return Grid(["Model", *requirements], rows), f"{'; '.join(bands)}."


@in_page_style
def _draw_changes(records: Sequence[Robustness]) -> Figure:
    """Draw the changes of parameters for each requirement, in assumed spreads; those to FAIL are first."""
    drawn = {(item.parameter, item.value, item.kind, item.requirement): item for item in records}
    ordered = sorted(records, key=lambda item: (item.kind is not ChangeKind.DIVERGENCE, *sort_key(item)))
    keys = list(dict.fromkeys((item.parameter, item.value, item.kind) for item in ordered))[:_MAX_PARAMETERS]
    requirements = list(dict.fromkeys(item.requirement for item in records))
    figure, axes = new_axes(8.6, 1.3 + 0.36 * len(keys))
    for index, requirement in enumerate(requirements):
        style: dict[str, Any] = {"color": SERIES[index % len(SERIES)]}
        marker: dict[str, Any] = {"marker": MARKERS[index % len(MARKERS)], "markersize": 5.5, **style}
        axes.plot([], [], label=requirement, linewidth=3.0, **marker)
        offset = 0.5 * (index - 0.5 * (len(requirements) - 1)) / len(requirements)
        for row, key in enumerate(keys):
            item = drawn.get((*key, requirement))
            if item is None:
                continue
            lower, y = np.nan_to_num(item.lower), [row + offset] * 2
            axes.plot([0.0, lower], y, linewidth=3.0, solid_capstyle="butt", **style)
            axes.plot([lower, item.upper if math.isfinite(item.upper) else item.reach], y, linewidth=0.9, **style)
            axes.plot([item.change], y[:1], **marker)
    names = [f"{parameter}{f' = {value}' if value else ''}, {kind}" for parameter, value, kind in keys]
    axes.set_yticks(range(len(keys)), [ALL_DISPERSIONS if name.startswith(ALL_DISPERSIONS) else name for name in names])
    axes.invert_yaxis()
    axes.set(xlabel="change, assumed spreads", xlim=(0.0, None))
    axes.grid(visible=False, axis="y")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(requirements), labelcolor=MUTED)
    return figure
