"""Sections that every campaign has where its rows hold their columns."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter
from scipy import stats

from marsyard.reports.columns import axis_columns, driver_columns, label, magnitude_label, numbers, split_unit
from marsyard.reports.comparison import compared_names, own_frame
from marsyard.reports.figures import ELLIPSE
from marsyard.reports.kinds import OutcomesBySize, Rows, SectionDeclaration
from marsyard.reports.populations import is_flag, members, succeeded, terrain_groups
from marsyard.reports.rates import CONFIDENCE, Share, interval_text, range_text, share_of
from marsyard.reports.sampled import sampled
from marsyard.reports.section import Block, Grid, Section, Subject, grid_of, plate
from marsyard.reports.statistics.changes import holm
from marsyard.reports.statistics.drivers import Driver, driver
from marsyard.reports.statistics.plane import circular_error, error_ellipse
from marsyard.reports.statistics.proportions import proportion_interval
from marsyard.reports.statistics.samples import mean_interval, quantile_bounds
from marsyard.reports.svg import REQUIREMENT, SERIES, in_page_style, new_axes
from marsyard.reports.verdicts import judge_campaign
from marsyard.reports.wording import NOTHING, coefficient, interval, number, p_text, percent, stated

#: Column of true and false that says whether a case's geometry leaves room for the algorithm to work at all.
ROOM = "room"


def answers_section(subject: Subject) -> Section | None:
    """Shares of cases with an answer, with room, and of answers beyond the bound: availability and "do no harm"; None
    where rows hold no answers.
    """
    shares = answer_shares(subject)
    if not shares:
        return None
    grid = grid_of(
        shares.items(),
        {
            "": lambda pair: pair[0],
            "Cases": lambda pair: f"{pair[1].hits:,} of {pair[1].n:,}",
            "Share": lambda pair: percent(pair[1].share),
            f"{stated(CONFIDENCE)} interval": lambda pair: range_text(pair[1].lower, pair[1].upper),
            "Allowing for shared terrains": lambda pair: (
                NOTHING if pair[1].shared_lower is None else interval_text(pair[1], shared=True)
            ),
        },
    )
    note = (
        "Intervals: two-sided, Clopper and Pearson for independent cases; allowing for shared terrains by an effective "
        "number of cases, or by whole terrains where failures are too few to estimate it. A wrong answer is one that "
        "was reported although its error is beyond the bound: the harm that an estimator can do."
    )
    data = {name: asdict(one) for name, one in shares.items()}
    return Section("answers", "Answers", "Answers given and answers wrong", [Block(grid=grid, note=note)], data)


def answer_shares(subject: Subject) -> Mapping[str, Share]:
    """The shares by name; only those that the rows hold."""
    frame = subject.whole
    if not is_flag(frame, "answered") or frame.empty:
        return {}
    answered = members(frame, "valid")
    shares = {"answered, of all cases": share_of(answered, frame)}
    if is_flag(frame, ROOM):
        room, completed = members(frame, ROOM), members(frame, "completed")
        shares["answered, of cases whose geometry leaves room"] = share_of(answered[room], frame[room])
        shares["geometry leaves no room, of completed cases"] = share_of(~room[completed], frame[completed])
    if subject.metric is not None and subject.bound is not None:
        wrong = ~succeeded(frame[answered], subject.metric, subject.bound)
        name = f"wrong by more than {subject.bound:g} {split_unit(subject.metric)[1]}, of answers"
        shares[name] = share_of(wrong, frame[answered])
    return shares


#: Shares of the errors within the radii.
SHARES = (0.5, 0.95, 0.99)


def scatter_section(subject: Subject) -> Section | None:
    """Ellipse and circular errors of a metric of two parts; None where it has none, or too few cases do."""
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
    groups = terrain_groups(subject.whole)
    circles = [circular_error(errors, share, CONFIDENCE, groups) for share in SHARES]
    unit = split_unit(metric)[1]
    x, y = (number(value) for value in ellipse.centre)
    text = (
        f"{stated(ELLIPSE)} ellipse, for normal errors: centre {x}, {y} {unit}, half axes {number(ellipse.semi_major)} "
        f"and {number(ellipse.semi_minor)} {unit}, major axis at {number(ellipse.angle_deg)} deg from "
        f"{label(parts[0])} towards {label(parts[1])}. {percent(ellipse.inside)} of these errors lie inside."
    )
    rows = [[stated(one.probability), number(one.estimate), interval(one.lower, one.upper)] for one in circles]
    grid = Grid(["Share of errors", f"Radius ({unit})", f"Bounds, {stated(CONFIDENCE)} each"], rows)
    note = (
        "Radius about the truth that holds the share; that of 50 % is the circular error probable. Bounds by order "
        "statistics: of whole terrains, or of the effective number of cases, where cases share terrains. The ellipse "
        "holds the next error with its probability, however few cases there are."
    )
    data = {"ellipse": asdict(ellipse), "circles": [asdict(one) for one in circles]}
    return Section("scatter", "Scatter", "Scatter of the errors", [Block(text=text, grid=grid, note=note)], data)


#: Conditions that are ranked, and cases that are looked at: the first ones, which are enough to rank by.
MAX_CONDITIONS, MAX_CASES = 12, 20_000


def drivers_section(subject: Subject) -> Section | None:
    """Conditions ranked by what they explain of errors and of failures; None where none can be ranked."""
    metric = subject.metric
    if metric is None:
        return None
    frame = subject.frame.head(MAX_CASES)
    responses = {"the size of errors": np.abs(numbers(frame, metric))}
    if subject.bound is not None:
        responses["failures"] = (~succeeded(frame, metric, subject.bound)).astype(np.float64)
    ranked = {name: ranked_drivers(frame, metric, response) for name, response in responses.items()}
    known = {name: found for name, found in ranked.items() if found}
    if not known:
        return None
    note = (
        "Share: part of the variance of the ranks that the condition alone explains, for a curve of any shape "
        f"(first-order index). Intervals at {stated(CONFIDENCE)} confidence, fewer cases taken where terrains share "
        "condition and response. p: that it explains nothing, corrected for the number of conditions (Holm). A failure "
        "is a case without an answer within the bound. Nothing is claimed about causes."
    )
    blocks = [Block(heading=f"What explains {name}", grid=_ranked_grid(found)) for name, found in known.items()]
    data = {
        name: [{"condition": column, **asdict(one), "corrected_p": p} for column, one, p in found]
        for name, found in known.items()
    }
    return Section("explained", "Explained", "What explains errors and failures", [*blocks, Block(note=note)], data)


Ranked = Sequence[tuple[str, Driver, float]]


def ranked_drivers(frame: pd.DataFrame, metric: str, response: Float[np.ndarray, " n"]) -> Ranked:
    """Conditions with what each explains of a response and its corrected p, those that explain most first."""
    groups = terrain_groups(frame)
    found: Mapping[str, Driver] = {
        column: one
        for column in driver_columns(frame, metric, MAX_CONDITIONS)
        if (one := driver(numbers(frame, column), response, groups, CONFIDENCE)) is not None
    }
    p_values = dict(zip(found, holm([one.p_value for one in found.values()]), strict=True))
    order = sorted(found, key=lambda column: (-found[column].share, column))
    return [(column, found[column], p_values[column]) for column in order]


def _ranked_grid(ranked: Ranked) -> Grid:
    head = ["Condition", "Cases", "Rank correlation", "Interval", "Share", "Interval", "p"]
    rows = [
        [
            label(column),
            f"{one.n:,}",
            coefficient(one.correlation),
            f"{coefficient(one.lower)} to {coefficient(one.upper)}",
            percent(one.share),
            range_text(one.share_lower, one.share_upper),
            p_text(p),
        ]
        for column, one, p in ranked
    ]
    return Grid(head, rows)


#: Up to this ratio of the most cases to the fewest an axis has ticks within its decades too.
_FEW_DECADES = 50
#: Numbers of cases at which figures are taken, evenly spread in their logarithm, and the least of them.
POINTS, FEWEST = 12, 8
QUANTILE = 0.95


@dataclass(frozen=True)
class Point:
    """A figure of the first so many cases, and its bounds; NaN or infinite where there are none."""

    cases: int
    estimate: float
    lower: float
    upper: float


def convergence_section(subject: Subject) -> Section | None:
    """Success rates, mean and 95 % quantile of the errors against the number of cases; None for fewer than sixteen."""
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
    note = (
        "Of the first so many cases, in the order of their numbers, which is no order at all. Band: one-sided bounds "
        "at the confidence asked; of mean and quantile at 90 %, open upwards where cases are too few for a bound. "
        "Dashed: what is asked."
    )
    return Section("convergence", "Convergence", "Convergence", [Block(plates=plates, note=note)], data)


def sizes(cases: int) -> list[int]:
    """The numbers of cases at which figures are taken."""
    spread = np.geomspace(FEWEST, cases, POINTS)
    return sorted({round(float(size)) for size in spread})


def requirement_curves(subject: Subject) -> list[tuple[str, float, list[Point]]]:
    """Each requirement's name, the rate asked, and the rates of the first cases; none where it cannot be judged."""
    how = sampled(subject.run.configuration)
    frame, requirements = subject.whole, subject.run.requirements
    judged = [(size, judge_campaign(frame.head(size), requirements, how)) for size in sizes(len(frame))]
    curves = []
    for place, last in enumerate(judged[-1][1]):
        points = [
            Point(size, one[place].estimate, one[place].lower, one[place].upper)
            for size, one in judged
            if not math.isnan(one[place].estimate)
        ]
        if len(points) > 1:
            curves.append((last.requirement_id, last.probability, points))
    return curves


def error_curves(frame: pd.DataFrame, metric: str | None) -> dict[str, tuple[str, str, list[Point]]]:
    """Name, axis and points of the mean and of the 95 % quantile of the magnitudes of the first cases; none where the
    cases are too few.
    """
    if metric is None:
        return {}
    magnitude, groups = np.abs(numbers(frame, metric)), terrain_groups(frame)
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
    """A figure's estimate and bounds against the number of cases."""
    figure, axes = new_axes(4.2, 2.8)
    cases = [point.cases for point in points]
    estimates = np.array([point.estimate for point in points])
    lower = np.array([point.lower for point in points])
    upper = np.array([point.upper for point in points])
    known = np.concatenate([estimates, lower, upper, [math.nan if asked is None else asked]])
    known = known[np.isfinite(known)]
    if known.size:
        margin = 0.06 * float(np.ptp(known)) or 0.06
        bottom, top = float(known.min()) - margin, float(known.max()) + margin
        axes.set_ylim(bottom, top)
        axes.fill_between(
            cases, np.where(np.isfinite(lower), lower, bottom), np.where(np.isfinite(upper), upper, top),
            where=~np.isnan(lower), color=SERIES[0], alpha=0.25, linewidth=0.0,
        )  # fmt: skip
    axes.plot(cases, estimates, color=SERIES[0], marker="o", markersize=3.5)
    if asked is not None and math.isfinite(asked):
        axes.axhline(asked, color=REQUIREMENT, linewidth=1.4, linestyle="--")
    axes.set(xscale="log", xlabel="cases", ylabel=name)
    if cases[-1] < _FEW_DECADES * cases[0]:
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_formatter(NullFormatter())
    return figure


#: The column, and the parts that the error behind it has.
NEES, PARTS = "velocity_nees", 2
#: Probability of the bands, and of the ellipse whose hits are counted.
BAND = 0.95


@dataclass(frozen=True)
class Consistency:
    """What the covariances of one algorithm are worth.

    Attributes
    ----------
    name
        Its label.
    n
        Estimates with a covariance.
    mean, lower, upper
        Mean NEES, and the band in which it lies with 95 % probability if the covariances are right.
    inside, inside_lower, inside_upper
        Share of errors within their 95 % ellipse, and its 90 % interval (Clopper-Pearson).
    word
        "consistent", "too sure" (errors larger than stated) or "too cautious".
    """

    name: str
    n: int
    mean: float
    lower: float
    upper: float
    inside: float
    inside_lower: float
    inside_upper: float
    word: str


def consistency(name: str, nees: Float[np.ndarray, " n"], parts: int = PARTS) -> Consistency:
    """The consistency of estimates from their NEES, shape (n,), of errors of so many parts; n must be at least 1."""
    n = nees.size
    if n == 0:
        raise ValueError("no estimate has a covariance")
    tail = 0.5 * (1.0 - BAND)
    lower, upper = (float(stats.chi2.ppf(q, parts * n)) / n for q in (tail, 1.0 - tail))
    inside = int((nees <= stats.chi2.ppf(BAND, parts)).sum())
    mean = float(nees.mean())
    word = "too sure" if mean > upper else "too cautious" if mean < lower else "consistent"
    bounds = proportion_interval(inside, n, CONFIDENCE)
    return Consistency(name, n, mean, lower, upper, inside / n, *bounds, word)


def consistencies(frame: pd.DataFrame) -> list[Consistency]:
    """Those of all algorithms in the rows that state covariances."""
    judged = str(frame["algorithm"].iloc[0]) if "algorithm" in frame and len(frame) else "judged"
    frames = {judged: frame, **{name: own_frame(frame, name) for name in compared_names(frame)}}
    by_name = {name: numbers(own, NEES) for name, own in frames.items() if NEES in own}
    known = {name: nees[np.isfinite(nees)] for name, nees in by_name.items()}
    return [consistency(name, nees) for name, nees in known.items() if nees.size]


def consistency_section(subject: Subject) -> Section | None:
    """How stated covariances agree with errors; None where no algorithm states any."""
    found = consistencies(subject.frame)
    if not found:
        return None
    grid = grid_of(
        found,
        {
            "Algorithm": lambda one: one.name,
            "Estimates": lambda one: f"{one.n:,}",
            "Mean NEES": lambda one: number(one.mean),
            "95 % band": lambda one: f"{number(one.lower)} to {number(one.upper)}",
            "Within 95 % ellipse": lambda one: (
                f"{percent(one.inside)} ({range_text(one.inside_lower, one.inside_upper)})"
            ),
            "Covariances are": lambda one: one.word,
        },
    )
    note = (
        f"NEES: the squared error in units of the stated covariance; {PARTS} on average where the covariance is right. "
        "The band takes cases as independent and errors as normal; the share within the ellipse has a 90 % interval. "
        "Too sure: errors are larger than stated."
    )
    data = {one.name: {key: value for key, value in asdict(one).items() if key != "name"} for one in found}
    return Section(
        "consistency", "Consistency", "Stated covariances against errors", [Block(grid=grid, note=note)], data
    )


#: Off-nominal cases: answers within the bound, no answers, and wrong answers, for every fault and size of fault.
FAULT_OUTCOMES = OutcomesBySize(
    outcomes=lambda rows, subject: _fault_outcomes(rows, subject),
    styles={"valid": ("valid", "full"), "invalid": ("invalid", "hatched"), "wrong": ("wrong", "crossed")},
    cases="Cases",
    caption="Full: answers within the bound. Hatched: no answer. Crossed: wrong answers.",
    wording=lambda fault, size: (label(fault), "" if math.isnan(size) or fault == "none" else f"{size:g}"),
    further=(
        ("Commonest refusal", "commonest_refusal", lambda rows: commonest_refusal(rows), lambda text: text or NOTHING),
    ),
)


def faults_section(subject: Subject) -> Section | None:
    """One table over faults and sizes; None where no row has a fault, or errors have no bound."""
    if subject.metric is None or subject.bound is None or not is_flag(subject.frame, "answered"):
        return None
    note = (
        f"Valid: answered within {subject.bound:g} {split_unit(subject.metric)[1]}. Invalid: no answer, as the "
        "algorithm said, or crashed. Wrong: answered, but beyond the bound; with the two-sided Clopper-Pearson "
        f"interval of its share of all cases at {stated(CONFIDENCE)} confidence."
    )
    return SectionDeclaration("faults", "Faults", "Faults by size", (FAULT_OUTCOMES,), note=note)(subject)


def _fault_outcomes(rows: Rows, subject: Subject) -> dict[str, Bool[np.ndarray, " n"]]:
    answered = members(rows, "valid")
    within = succeeded(rows, str(subject.metric), math.nan if subject.bound is None else subject.bound)
    return {"valid": answered & within, "invalid": ~answered, "wrong": answered & ~within}


def commonest_refusal(rows: Rows) -> str:
    """The outcome that most of the cases without an answer had; empty for none."""
    refusals = (
        rows.loc[~members(rows, "valid"), "outcome"].value_counts() if "outcome" in rows else pd.Series(dtype=int)
    )
    return str(refusals.index[0]) if len(refusals) else ""
