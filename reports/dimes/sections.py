"""Sections about descents: field test, velocity errors at thruster ignition, landings, influence of conditions.

The paper is Johnson et al., "Field Testing of the MER DIMES".
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from scipy import stats

from marsyard.reports import rates
from marsyard.reports.blocks import Quantity, Rows, distribution_block, quantile_block, rate_block
from marsyard.reports.dimes.landing import (
    SPEED_CORRECTED,
    SPEED_UNCORRECTED,
    create_speed_block,
    landing_fractions,
    landing_rows,
    omit_empty_rows,
)
from marsyard.reports.papers import read_paper
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import (
    MARKERS,
    MUTED,
    REQUIREMENT,
    SERIES,
    Block,
    Grid,
    Section,
    Subject,
    SvgFigure,
    build_grid,
    create_section,
    has_values,
    in_page_style,
    new_axes,
    svg_figure,
)
from marsyard.reports.tables import error_summaries, statistics_rows
from marsyard.reports.wording import (
    NOTHING,
    axis_columns,
    count,
    format_fraction,
    label,
    magnitude_label,
    note_text,
    number,
    numbers,
    percent,
)
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
    if not {"run", "category"}.issubset(frame.columns) or not rates.is_flag(frame, "answered"):
        return None
    cells = field_cells(subject)
    grid = build_grid(
        cells,
        {
            "Category and run": lambda cell: f"{cell['category']}: {cell['run']}",
            "Triples": lambda cell: f"{cell['valid'].n:,}",
            "Valid": lambda cell: f"{cell['valid'].hits:,}",
            "% valid": lambda cell: percent(cell["valid"].fraction),
            f"{format_fraction(CONFIDENCE)} interval": lambda cell: rates.range_text(
                cell["valid"].lower, cell["valid"].upper
            ),
            "Paper": lambda cell: NOTHING if cell["paper_percent"] is None else f"{cell['paper_percent']} %",
            "Difference": lambda cell: _difference_text(cell["difference_points"]),
            "Errors above the bound" if bound is None else f"Errors above {bound:g}": lambda cell: (
                NOTHING if cell["errors_above_bound"] is None else f"{cell['errors_above_bound']:,}"
            ),
            "Largest error": lambda cell: number(cell["largest"]),
        },
    )
    blocks = [Block(grid=grid, note=_field_note(cells))]
    svg_figures = scatter_figures(subject)
    if svg_figures:
        note = ""
        if bound is not None and subject.metric is not None:
            note = note_text("dimes.errors", bound=f"{bound:g}", unit=split_unit(subject.metric)[1])
        blocks.append(Block(heading="Errors by category", figures=svg_figures, note=note))
    data = {"cells": [cell | {"valid": asdict(cell["valid"])} for cell in cells]}
    return Section("field-test", "Field test", "Runs and categories, next to the paper's Fig. 11", blocks, data)


def field_cells(subject: Subject) -> list[dict[str, Any]]:
    """List the results of each category and run: first those of the paper, in its order, then others."""
    frame, cells = subject.frame, []
    names = frame[["category", "run"]].dropna().drop_duplicates()
    pairs = [(str(category), str(run)) for category, run in names.itertuples(index=False)]
    for category, run in [*(pair for pair in FIG_11 if pair in pairs), *(pair for pair in pairs if pair not in FIG_11)]:
        rows = frame[frame["category"].eq(category) & frame["run"].eq(run)]
        answered = rates.population_mask(rows, "valid")
        errors = np.abs(numbers(rows[answered], subject.metric)) if subject.metric else np.array([])
        errors = errors[np.isfinite(errors)]
        fraction, paper_percent = rates.fraction_of(answered, rows), FIG_11.get((category, run), {}).get("percent")
        cells.append(
            {
                "category": category,
                "run": run,
                "valid": fraction,
                "errors_above_bound": None if subject.bound is None else int((errors > subject.bound).sum()),
                "largest": float(errors.max()) if errors.size else math.nan,
                "paper_percent": paper_percent,
                "difference_points": math.nan if paper_percent is None else 100.0 * fraction.fraction - paper_percent,
            }
        )
    return cells


def _difference_text(points: float) -> str:
    mark = " (large)" if abs(points) > LARGE_DIFFERENCE_POINTS else ""
    return NOTHING if math.isnan(points) else f"{points:+.1f} pp{mark}".replace("-", "−")


def _field_note(cells: Sequence[Mapping[str, Any]]) -> str:
    """Describe definitions, the paper's misprints, and cells that differ from the paper."""
    definitions = note_text("dimes.field_test")
    if not any(cell["paper_percent"] is not None for cell in cells):
        return definitions
    inconsistent_rows = [
        f"{run}, {category} ({row['valid']} + {row['invalid']} ≠ {row['total']})"
        for (category, run), row in FIG_11.items()
        if row["valid"] + row["invalid"] != row["total"]
    ]
    totals = sum(row["total"] for row in FIG_11.values())
    counts = sum(row["valid"] + row["invalid"] for row in FIG_11.values())
    large = [cell for cell in cells if abs(cell["difference_points"]) > LARGE_DIFFERENCE_POINTS]
    names = "; ".join(f"{cell['category']}, {cell['run']}" for cell in large) or "none"
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
def _draw_scatter(rows: Rows, components: Sequence[str], subject: Subject, axis_limit: float) -> Figure:
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


_FIRING = "firing_velocity_error_m_s"
_FIRING_NOTE = (
    "The first column is the magnitude of the error. The reported velocity is a mean over the time between images 2 "
    "and 3. The IMU propagates it to ignition. The error is the difference from the true velocity of the camera at "
    "ignition, which includes the pendulum motion. It can be smaller than in the section Errors: an attitude error "
    "causes errors of opposite sign in the reported velocity and in the propagation."
)


def ignition_section(subject: Subject) -> Section | None:
    """Create the section on the error of the propagated velocity at thruster ignition, at a height near 100 m.

    Section I of the paper. None without the error, or if it is the page's metric.
    """
    frame = subject.frame
    if subject.metric == _FIRING or not has_values(frame, _FIRING):
        return None
    summaries = error_summaries(frame, _FIRING)
    rows, too_few_cases = omit_empty_rows(statistics_rows([summary for _, summary in summaries]))
    grid = Grid(["", *(name for name, _ in summaries)], rows)
    data = {name: asdict(summary) for name, summary in summaries}
    return create_section(
        "firing",
        "Ignition",
        "Velocity error at thruster ignition",
        Block(grid=grid, note=f"{too_few_cases}{_FIRING_NOTE}", data=data),
        quantile_block(
            frame,
            [Quantity("firing_after_s")],
            {"Minimum": 0.0, "Median": 0.5, "Maximum": 1.0},
            "Time available to compute the velocity",
        ),
    )


def landing_section(subject: Subject) -> Section | None:
    """Create the section on the horizontal speed at touchdown with and without steering by the estimated velocity."""
    landings = landing_rows(subject)
    if landings is None:
        return None
    return create_section(
        "landing",
        "Landing",
        "Horizontal speed at touchdown",
        distribution_block(
            "landing",
            {
                "with steering": rates.finite_values(landings, SPEED_CORRECTED),
                "without steering": rates.finite_values(landings, SPEED_UNCORRECTED),
            },
            ("horizontal speed at touchdown (m/s)", "fraction of landings above this speed"),
            "The same landings with steering by the reported velocity, and without. The lower curve is better.",
            complementary=True,
        ),
        rate_block(
            landing_fractions(landings),
            "Landings",
            "Effect of steering",
            "The intervals are two-sided Clopper-Pearson intervals, corrected for shared terrains.",
            data="fractions",
        ),
        create_speed_block(landings, subject),
    )


#: Conditions that the paper compares (all of them must vary), and additional conditions.
PAPER_CONDITIONS = ("descent_rate_m_s", "altitude_1_m", "attitude_rate_max_deg_s")
ADDITIONAL_CONDITIONS = ("off_nadir_max_deg", "horizontal_speed_m_s", "sun_elevation_deg")
#: Minimum number of errors for the section.
MIN_CASES = 50
#: Fixed seed of the bootstrap, for reproducible reports.
_SEED = 20050815


@dataclass(frozen=True)
class ConditionEffect:
    """Effect of one condition on the magnitude of the error; each tuple contains an estimate and its two bounds.

    - low, high: 5 % and 95 % quantile of the condition
    - rank_correlation: Spearman's rank correlation of condition and magnitude
    - coefficient: coefficient of a regression on all conditions, in standard deviations of condition and magnitude
    - effect: change of the mean magnitude from `low` to `high` in that regression, in the error's unit
    """

    column: str
    low: float
    high: float
    rank_correlation: tuple[float, float, float]
    coefficient: tuple[float, float, float]
    effect: tuple[float, float, float]


def sensitivity_section(subject: Subject) -> Section | None:
    """Create the section on rank correlations and a standardised regression of the error on all conditions.

    None for too few errors, or if the paper's conditions do not vary. Paper (section III.C): "vertical velocity of the
    lander had much less of an effect on DIMES performance when compared to altitude and attitude rates".
    """
    metric = subject.metric
    effects = [] if metric is None else estimate_effects(subject, metric)
    if metric is None or not effects:
        return None
    unit = split_unit(metric)[1]
    change_text = f"Change of the mean {magnitude_label(metric)} from the 5 % to the 95 % quantile of each condition."
    caption = f"{change_text} Dots: estimates. Bars: {format_fraction(CONFIDENCE)} intervals."
    effect_svg = svg_figure(effect_figure(effects, unit), "sensitivity", caption)
    note = note_text("dimes.sensitivity", metric=magnitude_label(metric), confidence=format_fraction(CONFIDENCE))
    rows = [
        [label(effect.column), f"{number(effect.low)} to {number(effect.high)}"]
        + [
            "{} ({} to {})".format(*map(number, value))
            for value in (effect.rank_correlation, effect.coefficient, effect.effect)
        ]
        for effect in effects
    ]
    head = ["", "5 % to 95 % quantile", "Rank correlation", "Standardised coefficient", f"Effect ({unit})"]
    data = {"drivers": [asdict(effect) for effect in effects]}
    blocks = [Block(figures=[effect_svg]), Block(grid=Grid(head, rows), note=note)]
    return Section("sensitivity", "Sensitivity", "Sensitivity of the error to the conditions", blocks, data)


def estimate_effects(subject: Subject, metric: str) -> list[ConditionEffect]:
    """Estimate the effects of the conditions; empty if one of the paper's is constant, or for too few errors."""
    frame = subject.frame
    magnitude = np.abs(numbers(frame, metric))
    columns = [name for name in (*PAPER_CONDITIONS, *ADDITIONAL_CONDITIONS) if rates.varies(frame, name)]
    conditions = np.column_stack([numbers(frame, name) for name in columns]) if columns else np.zeros((len(frame), 0))
    finite = np.isfinite(magnitude) & np.isfinite(conditions).all(axis=1)
    if not set(PAPER_CONDITIONS) <= set(columns) or finite.sum() < MIN_CASES:
        return []
    x, y = conditions[finite], magnitude[finite]
    if np.ptp(y) == 0.0 or (np.ptp(x, axis=0) == 0.0).any():
        return []
    groups = rates.terrain_groups(frame[finite])
    weights = rates.bootstrap_weights(np.arange(y.size) if groups is None else groups, np.random.default_rng(_SEED))
    low, high = np.quantile(x, (0.05, 0.95), axis=0)
    slopes = regress_weighted(x / x.std(axis=0), y, weights)
    ranks = correlate_weighted(stats.rankdata(x, axis=0), stats.rankdata(y), weights)
    # the first row is the sample, the other rows are the resamples
    statistics = [ranks, slopes / y.std(), slopes / x.std(axis=0) * (high - low)]
    effects = []
    for index, name in enumerate(columns):
        intervals = [
            (float(statistic[0, index]), *rates.percentile_interval(statistic[1:, index])) for statistic in statistics
        ]
        effects.append(ConditionEffect(name, float(low[index]), float(high[index]), *intervals))
    return effects


def regress_weighted(
    x: Float[np.ndarray, "n k"], y: Float[np.ndarray, " n"], weights: Float[np.ndarray, "b n"]
) -> Float[np.ndarray, "b k"]:
    """Fit y to all columns of x and a constant by weighted least squares; return the slopes for each row of weights."""
    design = np.column_stack([np.ones(y.size), x - x.mean(axis=0)])
    normal_matrices = np.einsum("bn,ni,nj->bij", weights, design, design, optimize=True)
    right_sides = np.einsum("bn,ni->bi", weights, design * y[:, None])
    # a condition can be constant in a resample of few terrains; its slope from the pseudo-inverse is then 0
    return np.asarray(np.einsum("bij,bj->bi", np.linalg.pinv(normal_matrices, hermitian=True), right_sides)[:, 1:])


def correlate_weighted(
    x: Float[np.ndarray, "n k"], y: Float[np.ndarray, " n"], weights: Float[np.ndarray, "b n"]
) -> Float[np.ndarray, "b k"]:
    """Correlate y with each column of x for each row of weights; inputs are ranks in the original sample."""
    normalized = weights / weights.sum(axis=1, keepdims=True)
    x, y = x - x.mean(axis=0), y - y.mean()
    mean_x, mean_y = normalized @ x, (normalized @ y)[:, None]
    covariance = normalized @ (x * y[:, None]) - mean_x * mean_y
    variances = (normalized @ (x * x) - mean_x**2) * ((normalized @ (y * y))[:, None] - mean_y**2)
    # `tiny` avoids a division by zero for a constant
    return np.asarray(covariance / np.sqrt(np.maximum(variances, np.finfo(np.float64).tiny)))


@in_page_style
def effect_figure(effects: Sequence[ConditionEffect], unit: str) -> Figure:
    """Draw the effects with their intervals."""
    figure, axes = new_axes(6.4, 0.9 + 0.36 * len(effects))
    y_positions = np.arange(len(effects))
    values = np.array([effect.effect for effect in effects])
    axes.hlines(y_positions, values[:, 1], values[:, 2], color=SERIES[0], linewidth=5.0, alpha=0.45)
    axes.plot(values[:, 0], y_positions, "o", color=SERIES[0])
    axes.axvline(0.0, color=MUTED, linewidth=0.8)
    axes.set_yticks(y_positions, [label(effect.column) for effect in effects])
    axes.set(xlabel=f"change of the mean magnitude ({unit})", ylim=(len(effects) - 0.5, -0.5))
    axes.grid(visible=False, axis="y")
    return figure
