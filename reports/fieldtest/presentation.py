"""Presentation of the field test: its runs and categories, next to the paper's Figs. 10 and 11.

The paper is Johnson et al., "Field Testing of the MER DIMES".
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from marsyard.reports import populations, rates
from marsyard.reports.column_selection import axis_columns
from marsyard.reports.column_values import numbers, to_float
from marsyard.reports.dimes.presentation import find_cause
from marsyard.reports.figure_style import MARKERS, REQUIREMENT, SERIES, in_page_style, new_axes
from marsyard.reports.fits import fit_note
from marsyard.reports.papers import read_paper
from marsyard.reports.presentation import Cause, Presentation
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Block, Section, Subject, SvgFigure, build_grid, svg_figure
from marsyard.reports.wording import NOTHING, count, format_fraction, label, note_text, number, percent
from marsyard.scenarios.columns import split_unit

#: Rows of the paper's Fig. 11 by (category, run).
FIG_11: Mapping[tuple[str, str], Mapping[str, Any]] = {
    (group["category"], row["run"]): row
    for group in read_paper(Path(__file__).with_name("paper.toml"))["fig_11"]
    for row in group["runs"]
}
#: A difference from the paper is marked as large above this value, percentage points.
LARGE_DIFFERENCE_POINTS = 10.0


def field_test_section(subject: Subject) -> Section | None:
    """Create the section that compares the field test with the paper's Figs. 10 and 11; None for other campaigns."""
    frame, bound = subject.frame, subject.bound
    if not {"run", "category"}.issubset(frame.columns) or not populations.is_flag(frame, "answered"):
        return None
    cells = field_cells(subject)
    grid = build_grid(
        cells,
        {
            "Category and run": lambda cell: f"{cell.category}: {cell.run}",
            "Triples": lambda cell: f"{cell.valid.n:,}",
            "Valid": lambda cell: f"{cell.valid.hits:,}",
            "% valid": lambda cell: percent(cell.valid.fraction),
            f"{format_fraction(CONFIDENCE)} interval": lambda cell: rates.range_text(
                cell.valid.lower, cell.valid.upper
            ),
            "Paper": lambda cell: NOTHING if cell.paper_percent is None else f"{cell.paper_percent} %",
            "Difference": lambda cell: _difference_text(cell.difference_points),
            "Errors above the bound" if bound is None else f"Errors above {bound:g}": lambda cell: (
                NOTHING if cell.errors_above_bound is None else f"{cell.errors_above_bound:,}"
            ),
            "Largest error": lambda cell: number(cell.largest),
        },
    )
    blocks = [Block(grid=grid, note=f"{_field_note(cells)} {fit_note('dimes-fieldtest')}")]
    svg_figures = scatter_figures(subject)
    if svg_figures:
        note = ""
        if bound is not None and subject.metric is not None:
            note = note_text("dimes.errors", bound=f"{bound:g}", unit=split_unit(subject.metric)[1])
        blocks.append(Block(heading="Errors by category", figures=svg_figures, note=note))
    return Section(
        "field-test", "Field test", "Runs and categories, next to the paper's Fig. 11", blocks, {"cells": cells}
    )


@dataclass(frozen=True)
class FieldCell:
    """Results of a run in a category.

    - valid: fraction of valid triples of images
    - errors_above_bound: number of errors above the bound of the requirement; None without a bound
    - largest: largest error; NaN without a valid triple
    - paper_percent: percentage of valid triples in the paper; None without one
    - difference_points: difference of the percentage from that of the paper, percentage points; NaN without one
    """

    category: str
    run: str
    valid: rates.CaseFraction
    errors_above_bound: int | None
    largest: float
    paper_percent: int | None
    difference_points: float


def field_cells(subject: Subject) -> list[FieldCell]:
    """List the results of each category and run: first those of the paper, in its order, then others."""
    frame, cells = subject.frame, []
    names = frame[["category", "run"]].dropna().drop_duplicates()
    pairs = [(str(category), str(run)) for category, run in names.itertuples(index=False)]
    for category, run in [*(pair for pair in FIG_11 if pair in pairs), *(pair for pair in pairs if pair not in FIG_11)]:
        rows = frame[frame["category"].eq(category) & frame["run"].eq(run)]
        answered = populations.population_mask(rows, "valid")
        errors = np.abs(numbers(rows[answered], subject.metric)) if subject.metric else np.array([])
        errors = errors[np.isfinite(errors)]
        fraction, paper_percent = rates.fraction_of(answered, rows), FIG_11.get((category, run), {}).get("percent")
        cells.append(
            FieldCell(
                category=category,
                run=run,
                valid=fraction,
                errors_above_bound=None if subject.bound is None else int((errors > subject.bound).sum()),
                largest=float(errors.max()) if errors.size else math.nan,
                paper_percent=paper_percent,
                difference_points=math.nan if paper_percent is None else 100.0 * fraction.fraction - paper_percent,
            )
        )
    return cells


def _difference_text(points: float) -> str:
    mark = " (large)" if abs(points) > LARGE_DIFFERENCE_POINTS else ""
    return NOTHING if math.isnan(points) else f"{points:+.1f} pp{mark}".replace("-", "−")


def _field_note(cells: Sequence[FieldCell]) -> str:
    """Describe definitions, the paper's misprints, and cells that differ from the paper."""
    definitions = note_text("dimes.field_test")
    if not any(cell.paper_percent is not None for cell in cells):
        return definitions
    inconsistent_rows = [
        f"{run}, {category} ({row['valid']} + {row['invalid']} ≠ {row['total']})"
        for (category, run), row in FIG_11.items()
        if row["valid"] + row["invalid"] != row["total"]
    ]
    totals = sum(row["total"] for row in FIG_11.values())
    counts = sum(row["valid"] + row["invalid"] for row in FIG_11.values())
    large = [cell for cell in cells if abs(cell.difference_points) > LARGE_DIFFERENCE_POINTS]
    names = "; ".join(f"{cell.category}, {cell.run}" for cell in large) or "none"
    return (
        f"{definitions} The paper's table has misprints in the rows {'; '.join(inconsistent_rows)}. Its totals sum to "
        f"{totals:,}, its counts to {counts:,}. This report uses the totals. For Pisgah Run 3, same direction, the "
        f"paper prints 99 %, but its counts result in 97 %. These results differ from the paper by more than "
        f"{LARGE_DIFFERENCE_POINTS:g} percentage points: {names}."
    )


def scatter_figures(subject: Subject) -> list[SvgFigure]:
    """Draw the signed errors of each category on equal axes (the paper's Fig. 10)."""
    frame, metric = subject.frame, subject.metric
    components = axis_columns(metric, [str(name) for name in frame.columns])[:2] if metric else []
    if len(components) < 2:
        return []
    points = np.column_stack([numbers(frame, component) for component in components])
    finite = np.isfinite(points).all(axis=1)
    if not finite.any():
        return []
    axis_limit = 1.06 * max(float(np.abs(points[finite]).max()), subject.bound or 0.0)
    categories = [*(category for category, _ in FIG_11), *sorted(frame["category"].dropna().unique())]
    svg_figures = []
    for index, category in enumerate(dict.fromkeys(str(name) for name in categories)):
        rows = frame[finite & frame["category"].eq(category).to_numpy(dtype=np.bool_)]
        if len(rows):
            caption = f"{category[:1].upper()}{category[1:]}: {count(len(rows), 'valid triple')}."
            figure = _draw_scatter(rows, components, subject, axis_limit)
            svg_figures.append(svg_figure(figure, f"fieldtest{index}", caption))
    return svg_figures


@in_page_style
def _draw_scatter(rows: pd.DataFrame, components: Sequence[str], subject: Subject, axis_limit: float) -> Figure:
    figure, axes = new_axes(4.2, 4.4)
    runs = sorted(str(run) for run in subject.frame["run"].dropna().unique())
    for index, run in enumerate(runs):
        x, y = (numbers(rows[rows["run"].eq(run)], component) for component in components)
        style: dict[str, Any] = {"marker": MARKERS[index % len(MARKERS)], "color": SERIES[index % len(SERIES)]}
        axes.plot(x, y, linestyle="", markersize=4.0, alpha=0.7, markeredgewidth=0.0, label=run, **style)
    if subject.bound is not None:
        axes.add_patch(Circle((0, 0), subject.bound, fill=False, color=REQUIREMENT, linewidth=1.6, linestyle="--"))
    axes.set(xlim=(-axis_limit, axis_limit), ylim=(-axis_limit, axis_limit), aspect="equal")
    axes.set(xlabel=label(components[0]), ylabel=label(components[1]))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2, handletextpad=0.2)
    return figure


def explain(row: Mapping[str, Any], metric: str) -> Cause | None:
    """Compare a velocity error with the errors that the attitudes and altitudes of the last pair cause alone."""
    by_attitude_m_s = to_float(row.get("attitude_velocity_error_m_s"))
    errors_m, altitudes_m = (
        np.array([to_float(row.get(f"{name}_{image}_m")) for image in (2, 3)])
        for name in ("altitude_error", "altitude")
    )
    speed_m_s = math.hypot(*(to_float(row.get(f"velocity_true_{axis}_m_s")) for axis in "xy"))
    attitude = ("the change of the attitude error between the images", by_attitude_m_s)
    return find_cause(row, metric, attitude, float(np.mean(errors_m / altitudes_m)), speed_m_s)


FIELD_TEST = Presentation(first=(field_test_section,), explain=explain)
