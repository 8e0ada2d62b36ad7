"""Sections of the report of every campaign.

Answers (availability), scatter (error ellipse), drivers (conditions that may affect errors or failures), convergence
(estimates against the number of cases), consistency (covariances against errors), and faults (dust on the
window or bad pixels, for example).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter
from scipy import stats

from marsyard.reports import rates
from marsyard.reports.blocks import NO_FAULT, OutcomesBySize, Rows
from marsyard.reports.column_selection import axis_columns, driver_columns
from marsyard.reports.column_values import numbers
from marsyard.reports.comparison import list_compared_algorithms, select_algorithm
from marsyard.reports.decision import evaluate_requirements
from marsyard.reports.figures import ELLIPSE
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.sampling_design import read_sampling_design
from marsyard.reports.section import (
    REQUIREMENT,
    SERIES,
    Block,
    Grid,
    Section,
    Subject,
    build_grid,
    create_section,
    in_page_style,
    new_axes,
    svg_figure,
)
from marsyard.reports.statistics.changes import correct_holm
from marsyard.reports.statistics.drivers import Driver, estimate_driver
from marsyard.reports.statistics.proportions import proportion_interval
from marsyard.reports.statistics.samples import circular_error, error_ellipse, mean_interval, quantile_bounds
from marsyard.reports.wording import (
    NOTHING,
    coefficient,
    format_fraction,
    interval,
    label,
    magnitude_label,
    note_text,
    number,
    p_text,
    percent,
)
from marsyard.scenarios.columns import enabling_columns, split_unit


def answers_section(subject: Subject) -> Section | None:
    """Create the section on availability and wrong answers; None if the rows contain no answers."""
    fractions = answer_fractions(subject)
    if not fractions:
        return None
    grid = build_grid(
        fractions.items(),
        {
            "": lambda pair: pair[0],
            "Cases": lambda pair: f"{pair[1].hits:,} of {pair[1].n:,}",
            "Fraction": lambda pair: percent(pair[1].fraction),
            f"{format_fraction(CONFIDENCE)} interval": lambda pair: rates.range_text(pair[1].lower, pair[1].upper),
            "Interval with shared terrains": lambda pair: (
                NOTHING if pair[1].shared_lower is None else rates.interval_text(pair[1], shared=True)
            ),
        },
    )
    note = note_text("common.answers")
    return Section("answers", "Answers", "Availability and wrong answers", [Block(grid=grid, note=note)], fractions)


def answer_fractions(subject: Subject) -> Mapping[str, rates.CaseFraction]:
    """Compute the fractions of answered cases and of wrong answers, by name; empty without the column `answered`.

    Fractions that need other columns are omitted if the rows do not have them.
    """
    frame = subject.all_cases
    if not rates.is_flag(frame, "answered") or frame.empty:
        return {}
    is_answered = rates.population_mask(frame, "valid")
    fractions = {"answered (of all cases)": rates.fraction_of(is_answered, frame)}
    for column in enabling_columns(map(str, frame.columns)):
        if not rates.is_flag(frame, column.name):
            continue
        is_enabled, is_completed = (rates.population_mask(frame, name) for name in (column.name, "completed"))
        fractions[f"answered, of cases {column.population}"] = rates.fraction_of(
            is_answered[is_enabled], frame[is_enabled]
        )
        fractions[f"no {column.population.removeprefix('with ')} (of completed cases)"] = rates.fraction_of(
            ~is_enabled[is_completed], frame[is_completed]
        )
    if subject.metric is not None and subject.bound is not None:
        is_wrong = ~rates.success_mask(frame[is_answered], subject.metric, subject.bound)
        name = f"wrong answers: error above {subject.bound:g} {split_unit(subject.metric)[1]} (of answers)"
        fractions[name] = rates.fraction_of(is_wrong, frame[is_answered])
    return fractions


#: Fractions of the errors inside the circles whose radii are reported.
PROBABILITIES = (0.5, 0.95, 0.99)


def scatter_section(subject: Subject) -> Section | None:
    """Create the section on error ellipse and circular errors; None without x and y errors or for too few cases."""
    metric = subject.metric
    if metric is None:
        return None
    components = axis_columns(metric, [str(name) for name in subject.all_cases.columns])[:2]
    if len(components) < 2:
        return None
    errors = np.column_stack([numbers(subject.all_cases, component) for component in components])
    ellipse = error_ellipse(errors, ELLIPSE)
    if ellipse is None:
        return None
    groups = rates.terrain_groups(subject.all_cases)
    circles = [circular_error(errors, probability, CONFIDENCE, groups) for probability in PROBABILITIES]
    unit = split_unit(metric)[1]
    first, second = (label(component).removesuffix(f" ({unit})") for component in components)
    x, y = (number(value) for value in ellipse.centre)
    text = (
        f"{format_fraction(ELLIPSE)} ellipse, assuming normally distributed errors: centre {x}, {y} {unit}, semi-axes "
        f"{number(ellipse.semi_major)} and {number(ellipse.semi_minor)} {unit}, major axis at "
        f"{number(ellipse.angle_deg)} deg from the {first} towards the {second}. "
        f"{percent(ellipse.inside)} of these errors lie inside."
    )
    rows = [
        [
            format_fraction(circle.probability),
            "too few cases" if math.isnan(circle.estimate) else number(circle.estimate),
            interval(circle.lower, circle.upper),
        ]
        for circle in circles
    ]
    grid = Grid(
        ["Fraction of errors", f"Radius ({unit})", f"Lower and upper bound ({format_fraction(CONFIDENCE)} each)"], rows
    )
    note = note_text("common.scatter")
    block = Block(text=text, grid=grid, note=note)
    return Section(
        "scatter", "Scatter", "Error ellipse and circular errors", [block], {"ellipse": ellipse, "circles": circles}
    )


#: Maximum number of ranked conditions, and of cases that are used for the ranking.
MAX_CONDITIONS, MAX_CASES = 12, 20_000


def drivers_section(subject: Subject) -> Section | None:
    """Create the section that ranks drivers by explained variance of errors and of failures; None without drivers."""
    metric = subject.metric
    if metric is None:
        return None
    frame = subject.frame.head(MAX_CASES)
    responses = {"the size of errors": np.abs(numbers(frame, metric))}
    if subject.bound is not None:
        responses["failures"] = (~rates.success_mask(frame, metric, subject.bound)).astype(np.float64)
    columns = driver_columns(frame, metric, MAX_CONDITIONS, subject.run.is_condition)
    ranked_drivers = {
        name: drivers for name, response in responses.items() if (drivers := rank_drivers(frame, columns, response))
    }
    if not ranked_drivers:
        return None
    note = note_text("common.drivers", confidence=format_fraction(CONFIDENCE))
    headings = ["Condition", "Cases", "Rank correlation", "Interval of the correlation"]
    headings += ["Fraction of variance", "Interval of the fraction", "p"]
    blocks = []
    for name, drivers in ranked_drivers.items():
        rows = []
        for column, driver, p_value in drivers:
            ranks = [coefficient(driver.correlation), f"{coefficient(driver.lower)} to {coefficient(driver.upper)}"]
            fractions = [percent(driver.fraction), rates.range_text(driver.fraction_lower, driver.fraction_upper)]
            rows.append([label(column), f"{driver.n:,}", *ranks, *fractions, p_text(p_value)])
        blocks.append(Block(heading=f"Drivers of {name}", grid=Grid(headings, rows)))
    data = {
        name: [{"condition": column, **asdict(driver), "corrected_p": p_value} for column, driver, p_value in drivers]
        for name, drivers in ranked_drivers.items()
    }
    title = "Influence of conditions on errors and failures"
    return Section("explained", "Influences", title, [*blocks, Block(note=note)], data)


#: Column, statistics and corrected p-value of each driver.
RankedDrivers = Sequence[tuple[str, Driver, float]]


def rank_drivers(frame: pd.DataFrame, columns: Sequence[str], response: Float[np.ndarray, " n"]) -> RankedDrivers:
    """Rank columns by the fraction of a response's variance that they explain, largest first; correct the p-values."""
    groups = rates.terrain_groups(frame)
    drivers: Mapping[str, Driver] = {
        column: driver
        for column in columns
        if (driver := estimate_driver(numbers(frame, column), response, groups, CONFIDENCE)) is not None
    }
    p_values = dict(zip(drivers, correct_holm([driver.p_value for driver in drivers.values()]), strict=True))
    order = sorted(drivers, key=lambda column: (-drivers[column].fraction, column))
    return [(column, drivers[column], p_values[column]) for column in order]


#: A logarithmic axis with a smaller ratio of maximum to minimum also has ticks at 2 and 5.
_MAX_TICK_RATIO = 50
#: Number of points of a convergence curve, spaced logarithmically, and the minimum number of cases.
MAX_POINTS, MIN_CASES = 12, 8
QUANTILE = 0.95


@dataclass(frozen=True)
class Point:
    """A point of a convergence curve: estimate from the first `cases` cases; bounds are NaN or infinite if unknown."""

    cases: int
    estimate: float
    lower: float
    upper: float


def convergence_section(subject: Subject) -> Section | None:
    """Plot success rates, mean and 95 % quantile of the errors against the number of cases; None below 16 cases."""
    frame = subject.all_cases
    if len(frame) < 2 * MIN_CASES:
        return None
    curves = success_rate_curves(subject)
    svg_figures = [
        svg_figure(
            curve_figure(points, "success rate", rate), f"converge{index}", f"{name}: success rate and its bounds."
        )
        for index, (name, rate, points) in enumerate(curves)
    ]
    data = {name: points for name, _, points in curves}
    for key, (name, axis, points) in error_curves(frame, subject.metric).items():
        bound = subject.bound if key == "quantile" else None
        svg_figures.append(svg_figure(curve_figure(points, axis, bound), f"converge-{key}", f"{name} and its bounds."))
        data[f"{subject.metric}: {name}"] = points
    if not svg_figures:
        return None
    note = note_text("common.convergence")
    return Section(
        "convergence",
        "Convergence",
        "Estimates against the number of cases",
        [Block(figures=svg_figures, note=note)],
        data,
    )


def curve_sizes(cases: int) -> list[int]:
    """Return the number of cases of each point of a convergence curve."""
    return sorted({round(float(size)) for size in np.geomspace(MIN_CASES, cases, MAX_POINTS)})


def success_rate_curves(subject: Subject) -> list[tuple[str, float, list[Point]]]:
    """Return name, required rate and convergence curve of each requirement that can be evaluated."""
    sampling = read_sampling_design(subject.run.definition)
    frame, requirements = subject.all_cases, subject.run.requirements
    sizes = curve_sizes(len(frame))
    evaluated = [(size, evaluate_requirements(frame.head(size), requirements, sampling)) for size in sizes]
    curves = []
    for index, final in enumerate(evaluated[-1][1]):
        points = [
            Point(size, verdicts[index].estimate, verdicts[index].lower, verdicts[index].upper)
            for size, verdicts in evaluated
            if not math.isnan(verdicts[index].estimate)
        ]
        if len(points) > 1:
            curves.append((final.requirement_id, final.probability, points))
    return curves


def error_curves(frame: pd.DataFrame, metric: str | None) -> dict[str, tuple[str, str, list[Point]]]:
    """Return name, axis label and points of mean and 95 % quantile of the first n errors; empty for too few cases."""
    if metric is None:
        return {}
    magnitude, groups = np.abs(numbers(frame, metric)), rates.terrain_groups(frame)
    means, quantiles = [], []
    for size in curve_sizes(len(frame)):
        finite = np.isfinite(magnitude[:size])
        if finite.sum() >= MIN_CASES:
            values, finite_groups = magnitude[:size][finite], None if groups is None else groups[:size][finite]
            means.append(Point(size, float(values.mean()), *mean_interval(values, CONFIDENCE, finite_groups)))
            bounds = quantile_bounds(values, QUANTILE, CONFIDENCE, finite_groups)
            quantiles.append(Point(size, float(np.quantile(values, QUANTILE)), *bounds))
    if len(quantiles) < 2:
        return {}
    name = magnitude_label(metric)
    return {
        "mean": ("Mean of the errors", f"mean of {name}", means),
        "quantile": ("95 % quantile of the errors", f"95 % of {name}", quantiles),
    }


@in_page_style
def curve_figure(points: Sequence[Point], name: str, required: float | None) -> Figure:
    """Draw an estimate and its bounds against the number of cases."""
    figure, axes = new_axes(4.2, 2.8)
    cases, estimates, lower, upper = np.array([astuple(point) for point in points]).T
    values = np.concatenate([estimates, lower, upper, [math.nan if required is None else required]])
    values = values[np.isfinite(values)]
    if values.size:
        # margin of 6 % of the range; infinite bounds extend to the edges of the axes
        margin = 0.06 * float(np.ptp(values)) or 0.06
        bottom, top = float(values.min()) - margin, float(values.max()) + margin
        axes.set_ylim(bottom, top)
        axes.fill_between(
            cases, np.where(np.isfinite(lower), lower, bottom), np.where(np.isfinite(upper), upper, top),
            where=~np.isnan(lower), color=SERIES[0], alpha=0.25, linewidth=0.0,
        )  # fmt: skip
    axes.plot(cases, estimates, color=SERIES[0], marker="o", markersize=3.5)
    if required is not None and math.isfinite(required):
        axes.axhline(required, color=REQUIREMENT, linewidth=1.4, linestyle="--")
    axes.set(xscale="log", xlabel="cases", ylabel=name)
    if cases[-1] < _MAX_TICK_RATIO * cases[0]:
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_formatter(NullFormatter())
    return figure


#: Columns of normalised estimation errors squared (NEES), and their degrees of freedom.
NEES, NEES_DIMENSION = ("velocity_nees", "position_nees"), 2
#: Probability of the band of the mean NEES, and of the error ellipse.
BAND_PROBABILITY = 0.95


def evaluate_consistency(nees: Float[np.ndarray, " n"]) -> dict[str, Any]:
    """Evaluate from the NEES of estimates whether their errors agree with their covariances.

    Keys: mean NEES with its band for correct covariances, fraction of errors `inside` their ellipse with its 90 %
    interval, and `word`: "consistent", "optimistic" (errors larger than the covariances) or "pessimistic".
    """
    n, mean = nees.size, float(nees.mean())
    tail = 0.5 * (1.0 - BAND_PROBABILITY)
    # for correct covariances, the sum of n NEES has a chi-square distribution with n * dimension degrees of freedom
    lower, upper = (float(stats.chi2.ppf(level, NEES_DIMENSION * n)) / n for level in (tail, 1.0 - tail))
    inside = int((nees <= stats.chi2.ppf(BAND_PROBABILITY, NEES_DIMENSION)).sum())
    low, high = proportion_interval(inside, n, CONFIDENCE)
    word = "optimistic" if mean > upper else "pessimistic" if mean < lower else "consistent"
    band = {"n": n, "mean": mean, "lower": lower, "upper": upper}
    return band | {"inside": inside / n, "inside_lower": low, "inside_upper": high, "word": word}


def evaluate_consistencies(frame: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """Evaluate the consistency of all algorithms with covariances in the rows, by name."""
    tested_name = str(frame["algorithm"].iloc[0]) if "algorithm" in frame and len(frame) else "tested"
    frames = {tested_name: frame, **{name: select_algorithm(frame, name) for name in list_compared_algorithms(frame)}}
    values = {name: [rates.finite_values(rows, column) for column in NEES] for name, rows in frames.items()}
    return {name: evaluate_consistency(nees) for name, columns in values.items() for nees in columns if nees.size}


def consistency_section(subject: Subject) -> Section | None:
    """Create the section that compares reported covariances with errors; None without covariances."""
    results = evaluate_consistencies(subject.frame)
    if not results:
        return None
    rows = []
    for name, result in results.items():
        inside = f"{percent(result['inside'])} ({rates.range_text(result['inside_lower'], result['inside_upper'])})"
        band = f"{number(result['lower'])} to {number(result['upper'])}"
        rows.append([name, f"{result['n']:,}", number(result["mean"]), band, inside, result["word"]])
    head = ["Algorithm", "Estimates", "Mean NEES", "95 % band", "Within 95 % ellipse", "Covariances are"]
    blocks = [Block(grid=Grid(head, rows), note=note_text("common.consistency", parts=NEES_DIMENSION))]
    return Section("consistency", "Consistency", "Reported covariances against errors", blocks, results)


def _classify_answers(rows: Rows, metric: str, bound: float) -> dict[str, Bool[np.ndarray, " n"]]:
    """Create the masks of answers within the bound (`valid`), cases without an answer (`invalid`) and wrong answers."""
    is_answered, is_correct = rates.population_mask(rows, "valid"), rates.success_mask(rows, metric, bound)
    return {"valid": is_answered & is_correct, "invalid": ~is_answered, "wrong": is_answered & ~is_correct}


def find_frequent_refusal(rows: Rows) -> str:
    """Return the most frequent outcome of cases without an answer; empty if all cases have an answer."""
    if "outcome" not in rows:
        return ""
    refusals = rows.loc[~rates.population_mask(rows, "valid"), "outcome"].value_counts()
    return str(refusals.index[0]) if len(refusals) else ""


def fault_outcomes(metric: str, bound: float) -> OutcomesBySize:
    """Define the outcomes of `_classify_answers` by fault and its size."""
    return OutcomesBySize(
        outcomes=lambda rows: _classify_answers(rows, metric, bound),
        styles={"valid": ("valid", "full"), "invalid": ("invalid", "hatched"), "wrong": ("wrong", "crossed")},
        cases="Cases",
        wording=lambda fault, size: (label(fault), "" if math.isnan(size) or fault == NO_FAULT else f"{size:g}"),
        extra_columns=(
            ("Most frequent refusal", "most_frequent_refusal", find_frequent_refusal, lambda text: text or NOTHING),
        ),
    )


def faults_section(subject: Subject) -> Section | None:
    """Create the section on outcomes by fault and size; None without faults or bound."""
    if subject.metric is None or subject.bound is None or not rates.is_flag(subject.frame, "answered"):
        return None
    unit, confidence = split_unit(subject.metric)[1], format_fraction(CONFIDENCE)
    note = note_text("common.faults", bound=f"{subject.bound:g}", unit=unit, confidence=confidence)
    caption = "Solid bars: answers within the bound. Hatched bars: no answer. Cross-hatched bars: wrong answers."
    blocks = fault_outcomes(subject.metric, subject.bound).blocks(subject.frame, "faults", caption, note)
    return create_section("faults", "Faults", "Faults by size", *blocks)
