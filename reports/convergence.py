"""Section of the report on convergence: success rate and error quantiles against the number of cases."""

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

from marsyard.reports import rates
from marsyard.reports.column_values import numbers
from marsyard.reports.decision import evaluate_requirement
from marsyard.reports.figure_style import REQUIREMENT, SERIES, in_page_style, new_axes
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.sampling_design import read_sampling_design
from marsyard.reports.section import Block, Section, Subject, svg_figure
from marsyard.reports.statistics.samples import mean_interval, quantile_bounds
from marsyard.reports.wording import format_fraction, magnitude_label, note_text

#: A logarithmic axis with a smaller ratio of maximum to minimum also has ticks at 2 and 5.
_MAX_TICK_RATIO = 50
#: Number of points of a convergence curve, spaced logarithmically, and the minimum number of cases.
MAX_POINTS, MIN_CASES = 12, 8
#: Quantile of the errors.
QUANTILE = 0.95


@dataclass(frozen=True)
class Point:
    """A point of a convergence curve: estimate from the first `cases` cases; bounds are NaN or infinite if unknown."""

    cases: int
    estimate: float
    lower: float
    upper: float


@dataclass(frozen=True)
class Curve:
    """A quantity against the number of cases, with its name in captions, label of its axis, and required value."""

    name: str
    axis_label: str
    points: Sequence[Point]
    required: float | None = None


def convergence_section(subject: Subject) -> Section | None:
    """Plot success rates, mean and 95 % quantile of the errors against the number of cases; None below 16 cases."""
    frame = subject.all_cases
    if len(frame) < 2 * MIN_CASES:
        return None
    rate_curves = success_rate_curves(subject)
    svg_figures = [
        svg_figure(curve_figure(curve), f"converge{index}", f"{curve.name}: success rate and its bounds.")
        for index, curve in enumerate(rate_curves)
    ]
    data = {curve.name: curve.points for curve in rate_curves}
    for key, curve in error_curves(frame, subject.metric, subject.bound).items():
        svg_figures.append(svg_figure(curve_figure(curve), f"converge-{key}", f"{curve.name} and its bounds."))
        data[f"{subject.metric}: {curve.name}"] = curve.points
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


def success_rate_curves(subject: Subject) -> list[Curve]:
    """Compute the success rate of each requirement that can be evaluated, from the first n cases."""
    sampling = read_sampling_design(subject.run.definition)
    frame = subject.all_cases
    sizes = curve_sizes(len(frame))
    curves = []
    for requirement in subject.run.requirements:
        verdicts = [evaluate_requirement(frame.head(size), requirement, sampling) for size in sizes]
        points = [
            Point(size, verdict.estimate, verdict.lower, verdict.upper)
            for size, verdict in zip(sizes, verdicts, strict=True)
            if not math.isnan(verdict.estimate)
        ]
        if len(points) > 1:
            curves.append(Curve(verdicts[-1].requirement_id, "success rate", points, verdicts[-1].probability))
    return curves


def error_curves(frame: pd.DataFrame, metric: str | None, bound: float | None) -> dict[str, Curve]:
    """Compute `mean` and `quantile` of the first n errors; empty for too few cases."""
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
    name, quantile = magnitude_label(metric), format_fraction(QUANTILE)
    return {
        "mean": Curve("Mean of the errors", f"mean of {name}", means),
        "quantile": Curve(f"{quantile} quantile of the errors", f"{quantile} of {name}", quantiles, bound),
    }


@in_page_style
def curve_figure(curve: Curve) -> Figure:
    """Draw an estimate and its bounds against the number of cases."""
    figure, axes = new_axes(4.2, 2.8)
    cases, estimates, lower, upper = np.array([astuple(point) for point in curve.points]).T
    required = curve.required
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
    axes.set(xscale="log", xlabel="cases", ylabel=curve.axis_label)
    if cases[-1] < _MAX_TICK_RATIO * cases[0]:
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_formatter(NullFormatter())
    return figure
