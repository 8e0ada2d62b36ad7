"""Sections of every campaign: answers, scatter, drivers, convergence, consistency and faults."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter
from scipy import stats

from marsyard.reports import rates
from marsyard.reports.comparison import compared_names, select_algorithm
from marsyard.reports.figures import ELLIPSE
from marsyard.reports.kinds import OutcomesBySize, Rows, SectionDeclaration
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
    in_page_style,
    new_axes,
    plate,
)
from marsyard.reports.statistics.changes import holm
from marsyard.reports.statistics.drivers import Driver, driver
from marsyard.reports.statistics.proportions import proportion_interval
from marsyard.reports.statistics.samples import circular_error, error_ellipse, mean_interval, quantile_bounds
from marsyard.reports.verdicts import evaluate_requirements
from marsyard.reports.wording import (
    NOTHING,
    axis_columns,
    coefficient,
    driver_columns,
    format_fraction,
    interval,
    label,
    magnitude_label,
    note_text,
    number,
    numbers,
    p_text,
    percent,
    split_unit,
)

#: Column of true and false: whether the geometry leaves a feasible overlap for the algorithm.
ROOM = "feasible_overlap"


def answers_section(subject: Subject) -> Section | None:
    """Availability, feasible overlap, and wrong answers; None if rows hold no answers."""
    shares = answer_shares(subject)
    if not shares:
        return None
    grid = build_grid(
        shares.items(),
        {
            "": lambda pair: pair[0],
            "Cases": lambda pair: f"{pair[1].hits:,} of {pair[1].n:,}",
            "Share": lambda pair: percent(pair[1].share),
            f"{format_fraction(CONFIDENCE)} interval": lambda pair: rates.range_text(pair[1].lower, pair[1].upper),
            "Allowing for shared terrains": lambda pair: (
                NOTHING if pair[1].shared_lower is None else rates.interval_text(pair[1], shared=True)
            ),
        },
    )
    note = note_text("common.answers")
    data = {name: asdict(one) for name, one in shares.items()}
    return Section("answers", "Answers", "Answers given and answers wrong", [Block(grid=grid, note=note)], data)


def answer_shares(subject: Subject) -> Mapping[str, rates.Share]:
    """Fractions by name, as far as the rows hold them."""
    frame = subject.whole
    if not rates.is_flag(frame, "answered") or frame.empty:
        return {}
    answered = rates.members(frame, "valid")
    shares = {"answered, of all cases": rates.fraction_of(answered, frame)}
    if rates.is_flag(frame, ROOM):
        room, completed = rates.members(frame, ROOM), rates.members(frame, "completed")
        shares["answered, of cases with feasible overlap"] = rates.fraction_of(answered[room], frame[room])
        shares["no feasible overlap, of completed cases"] = rates.fraction_of(~room[completed], frame[completed])
    if subject.metric is not None and subject.bound is not None:
        wrong = ~rates.success_mask(frame[answered], subject.metric, subject.bound)
        name = f"wrong by more than {subject.bound:g} {split_unit(subject.metric)[1]}, of answers"
        shares[name] = rates.fraction_of(wrong, frame[answered])
    return shares


#: Fractions of the errors within the radii.
SHARES = (0.5, 0.95, 0.99)


def scatter_section(subject: Subject) -> Section | None:
    """Error ellipse and circular errors of a metric with x and y parts; None without them or for too few cases."""
    metric = subject.metric
    if metric is None:
        return None
    parts = axis_columns(metric, [str(name) for name in subject.whole.columns])[:2]
    if len(parts) < 2:
        return None
    errors = np.column_stack([numbers(subject.whole, part) for part in parts])
    ellipse = error_ellipse(errors, ELLIPSE)
    if ellipse is None:
        return None
    groups = rates.terrain_groups(subject.whole)
    circles = [circular_error(errors, share, CONFIDENCE, groups) for share in SHARES]
    unit = split_unit(metric)[1]
    x, y = (number(value) for value in ellipse.centre)
    text = (
        f"{format_fraction(ELLIPSE)} ellipse, for normal errors: centre {x}, {y} {unit}, half axes "
        f"{number(ellipse.semi_major)} and {number(ellipse.semi_minor)} {unit}, major axis at "
        f"{number(ellipse.angle_deg)} deg from {label(parts[0])} towards {label(parts[1])}. "
        f"{percent(ellipse.inside)} of these errors lie inside."
    )
    rows = [[format_fraction(one.probability), number(one.estimate), interval(one.lower, one.upper)] for one in circles]
    grid = Grid(["Fraction of errors", f"Radius ({unit})", f"Bounds, {format_fraction(CONFIDENCE)} each"], rows)
    note = note_text("common.scatter")
    data = {"ellipse": asdict(ellipse), "circles": [asdict(one) for one in circles]}
    return Section("scatter", "Scatter", "Scatter of the errors", [Block(text=text, grid=grid, note=note)], data)


#: Maximum number of ranked conditions, and of cases by which they are ranked.
MAX_CONDITIONS, MAX_CASES = 12, 20_000


def drivers_section(subject: Subject) -> Section | None:
    """Conditions ranked by the variance of errors and failures that they explain; None if none can be ranked."""
    metric = subject.metric
    if metric is None:
        return None
    frame = subject.frame.head(MAX_CASES)
    responses = {"the size of errors": np.abs(numbers(frame, metric))}
    if subject.bound is not None:
        responses["failures"] = (~rates.success_mask(frame, metric, subject.bound)).astype(np.float64)
    ranked = {name: ranked_drivers(frame, metric, response) for name, response in responses.items()}
    known = {name: strongest for name, strongest in ranked.items() if strongest}
    if not known:
        return None
    note = note_text("common.drivers", confidence=format_fraction(CONFIDENCE))
    head = ["Condition", "Cases", "Rank correlation", "Interval", "Share", "Interval", "p"]
    blocks = []
    for name, strongest in known.items():
        rows = []
        for column, one, p in strongest:
            ranks = [coefficient(one.correlation), f"{coefficient(one.lower)} to {coefficient(one.upper)}"]
            share = [percent(one.share), rates.range_text(one.share_lower, one.share_upper)]
            rows.append([label(column), f"{one.n:,}", *ranks, *share, p_text(p)])
        blocks.append(Block(heading=f"Drivers of {name}", grid=Grid(head, rows)))
    data = {
        name: [{"condition": column, **asdict(one), "corrected_p": p} for column, one, p in strongest]
        for name, strongest in known.items()
    }
    return Section("explained", "Explained", "Drivers of errors and failures", [*blocks, Block(note=note)], data)


Ranked = Sequence[tuple[str, Driver, float]]


def ranked_drivers(frame: pd.DataFrame, metric: str, response: Float[np.ndarray, " n"]) -> Ranked:
    """Conditions with the explained variance of a response and corrected p, in falling order."""
    groups = rates.terrain_groups(frame)
    drivers: Mapping[str, Driver] = {
        column: one
        for column in driver_columns(frame, metric, MAX_CONDITIONS)
        if (one := driver(numbers(frame, column), response, groups, CONFIDENCE)) is not None
    }
    p_values = dict(zip(drivers, holm([one.p_value for one in drivers.values()]), strict=True))
    order = sorted(drivers, key=lambda column: (-drivers[column].share, column))
    return [(column, drivers[column], p_values[column]) for column in order]


#: Up to this ratio of the axis' ends it has ticks within its decades.
_MAX_RATIO = 50
#: Number of points of a convergence curve, spaced logarithmically, and the minimum number of cases.
POINTS, FEWEST = 12, 8
QUANTILE = 0.95


@dataclass(frozen=True)
class Point:
    """An estimate of the first cases with its bounds; NaN or infinite without bounds."""

    cases: int
    estimate: float
    lower: float
    upper: float


def convergence_section(subject: Subject) -> Section | None:
    """Success rates, mean and 95 % quantile of the errors against the number of cases; None for fewer than 16."""
    frame = subject.whole
    if len(frame) < 2 * FEWEST:
        return None
    curves = requirement_curves(subject)
    plates = [
        plate(curve_figure(points, "success rate", asked), f"converge{k}", f"{name}: success rate and its bounds.")
        for k, (name, asked, points) in enumerate(curves)
    ]
    data = {name: [asdict(point) for point in points] for name, _, points in curves}
    for key, (name, axis, points) in error_curves(frame, subject.metric).items():
        bound = subject.bound if key == "quantile" else None
        plates.append(plate(curve_figure(points, axis, bound), f"converge-{key}", f"{name} and its bounds."))
        data[f"{subject.metric}: {name}"] = [asdict(point) for point in points]
    if not plates:
        return None
    note = note_text("common.convergence")
    return Section("convergence", "Convergence", "Convergence", [Block(plates=plates, note=note)], data)


def sizes(cases: int) -> list[int]:
    """Numbers of cases of the points of a curve."""
    return sorted({round(float(size)) for size in np.geomspace(FEWEST, cases, POINTS)})


def requirement_curves(subject: Subject) -> list[tuple[str, float, list[Point]]]:
    """Name, rate asked and success rates of the first cases of each requirement that can be evaluated."""
    how = read_sampling_design(subject.run.configuration)
    frame, requirements = subject.whole, subject.run.requirements
    evaluated = [(size, evaluate_requirements(frame.head(size), requirements, how)) for size in sizes(len(frame))]
    curves = []
    for place, last in enumerate(evaluated[-1][1]):
        points = [
            Point(size, one[place].estimate, one[place].lower, one[place].upper)
            for size, one in evaluated
            if not math.isnan(one[place].estimate)
        ]
        if len(points) > 1:
            curves.append((last.requirement_id, last.probability, points))
    return curves


def error_curves(frame: pd.DataFrame, metric: str | None) -> dict[str, tuple[str, str, list[Point]]]:
    """Name, axis and points of mean and 95 % quantile of the magnitudes of the first cases; empty for too few."""
    if metric is None:
        return {}
    magnitude, groups = np.abs(numbers(frame, metric)), rates.terrain_groups(frame)
    means, quantiles = [], []
    for size in sizes(len(frame)):
        finite = np.isfinite(magnitude[:size])
        if finite.sum() >= FEWEST:
            known, shared = magnitude[:size][finite], None if groups is None else groups[:size][finite]
            means.append(Point(size, float(known.mean()), *mean_interval(known, CONFIDENCE, shared)))
            bounds = quantile_bounds(known, QUANTILE, CONFIDENCE, shared)
            quantiles.append(Point(size, float(np.quantile(known, QUANTILE)), *bounds))
    if len(quantiles) < 2:
        return {}
    name = magnitude_label(metric)
    return {
        "mean": ("Mean of the errors", f"mean of {name}", means),
        "quantile": ("95 % quantile of the errors", f"95 % of {name}", quantiles),
    }


@in_page_style
def curve_figure(points: Sequence[Point], name: str, asked: float | None) -> Figure:
    """An estimate and its bounds against the number of cases."""
    figure, axes = new_axes(4.2, 2.8)
    cases, estimates, lower, upper = np.array([(one.cases, one.estimate, one.lower, one.upper) for one in points]).T
    finite = np.concatenate([estimates, lower, upper, [math.nan if asked is None else asked]])
    finite = finite[np.isfinite(finite)]
    if finite.size:
        margin = 0.06 * float(np.ptp(finite)) or 0.06
        bottom, top = float(finite.min()) - margin, float(finite.max()) + margin
        axes.set_ylim(bottom, top)
        axes.fill_between(
            cases, np.where(np.isfinite(lower), lower, bottom), np.where(np.isfinite(upper), upper, top),
            where=~np.isnan(lower), color=SERIES[0], alpha=0.25, linewidth=0.0,
        )  # fmt: skip
    axes.plot(cases, estimates, color=SERIES[0], marker="o", markersize=3.5)
    if asked is not None and math.isfinite(asked):
        axes.axhline(asked, color=REQUIREMENT, linewidth=1.4, linestyle="--")
    axes.set(xscale="log", xlabel="cases", ylabel=name)
    if cases[-1] < _MAX_RATIO * cases[0]:
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_formatter(NullFormatter())
    return figure


#: Column of the normalised estimation error squared, and its degrees of freedom.
NEES, PARTS = "velocity_nees", 2
#: Probability of the band of the mean, and of the counted ellipse.
BAND = 0.95


def consistency(nees: Float[np.ndarray, " n"], parts: int = PARTS) -> dict[str, Any]:
    """Consistency of at least one estimate from its NEES (normalised estimation error squared) with `parts` parts.

    Keys: mean NEES with its 95 % band for correct covariances, fraction of errors `inside` their 95 % ellipse with its
    90 % interval, and `word`: "consistent", "too sure" (errors larger than stated) or "too cautious".
    """
    n, mean = nees.size, float(nees.mean())
    tail = 0.5 * (1.0 - BAND)
    lower, upper = (float(stats.chi2.ppf(q, parts * n)) / n for q in (tail, 1.0 - tail))
    inside = int((nees <= stats.chi2.ppf(BAND, parts)).sum())
    low, high = proportion_interval(inside, n, CONFIDENCE)
    word = "too sure" if mean > upper else "too cautious" if mean < lower else "consistent"
    band = {"n": n, "mean": mean, "lower": lower, "upper": upper}
    return band | {"inside": inside / n, "inside_lower": low, "inside_upper": high, "word": word}


def consistencies(frame: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """Consistency of all algorithms in the rows with covariances, by name."""
    tested = str(frame["algorithm"].iloc[0]) if "algorithm" in frame and len(frame) else "tested"
    frames = {tested: frame, **{name: select_algorithm(frame, name) for name in compared_names(frame)}}
    by_name = {name: numbers(own, NEES) for name, own in frames.items() if NEES in own}
    finite = {name: nees[np.isfinite(nees)] for name, nees in by_name.items()}
    return {name: consistency(nees) for name, nees in finite.items() if nees.size}


def consistency_section(subject: Subject) -> Section | None:
    """Consistency of stated covariances with errors; None if no algorithm states any."""
    results = consistencies(subject.frame)
    if not results:
        return None
    rows = []
    for name, one in results.items():
        inside = f"{percent(one['inside'])} ({rates.range_text(one['inside_lower'], one['inside_upper'])})"
        band = f"{number(one['lower'])} to {number(one['upper'])}"
        rows.append([name, f"{one['n']:,}", number(one["mean"]), band, inside, one["word"]])
    head = ["Algorithm", "Estimates", "Mean NEES", "95 % band", "Within 95 % ellipse", "Covariances are"]
    blocks = [Block(grid=Grid(head, rows), note=note_text("common.consistency", parts=PARTS))]
    return Section("consistency", "Consistency", "Stated covariances against errors", blocks, results)


def _fault_outcomes(rows: Rows, subject: Subject) -> dict[str, Bool[np.ndarray, " n"]]:
    answered = rates.members(rows, "valid")
    within = rates.success_mask(rows, str(subject.metric), math.nan if subject.bound is None else subject.bound)
    return {"valid": answered & within, "invalid": ~answered, "wrong": answered & ~within}


def commonest_refusal(rows: Rows) -> str:
    """The most frequent outcome of cases without an answer; empty for none."""
    if "outcome" not in rows:
        return ""
    refusals = rows.loc[~rates.members(rows, "valid"), "outcome"].value_counts()
    return str(refusals.index[0]) if len(refusals) else ""


#: Off-nominal cases: valid, missing and wrong answers by fault and its size.
FAULT_OUTCOMES = OutcomesBySize(
    outcomes=_fault_outcomes,
    styles={"valid": ("valid", "full"), "invalid": ("invalid", "hatched"), "wrong": ("wrong", "crossed")},
    cases="Cases",
    caption="Full: answers within the bound. Hatched: no answer. Crossed: wrong answers.",
    wording=lambda fault, size: (label(fault), "" if math.isnan(size) or fault == "none" else f"{size:g}"),
    further=(("Most frequent refusal", "commonest_refusal", commonest_refusal, lambda text: text or NOTHING),),
)


def faults_section(subject: Subject) -> Section | None:
    """Outcomes by fault and size; None without faults or bound."""
    if subject.metric is None or subject.bound is None or not rates.is_flag(subject.frame, "answered"):
        return None
    note = note_text(
        "common.faults",
        bound=f"{subject.bound:g}",
        unit=split_unit(subject.metric)[1],
        confidence=format_fraction(CONFIDENCE),
    )
    return SectionDeclaration("faults", "Faults", "Faults by size", (FAULT_OUTCOMES,), note=note)(subject)
