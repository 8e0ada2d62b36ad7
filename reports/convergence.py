"""Each figure against the number of cases: whether more of them would still change it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

from reports.columns import magnitude_label, numbers
from reports.plates import plate
from reports.sampled import sampled
from reports.section import Block, Section, Subject
from reports.statistics.samples import quantile_bounds
from reports.svg import REQUIREMENT, SERIES, in_page_style, new_axes
from reports.verdicts import judge_campaign

#: Up to this ratio of the most cases to the fewest an axis has ticks within its decades too.
_FEW_DECADES = 50
#: Numbers of cases at which figures are taken, evenly spread in their logarithm, and the least of them.
POINTS, FEWEST = 12, 8
QUANTILE, CONFIDENCE = 0.95, 0.9


@dataclass(frozen=True)
class Point:
    """A figure of the first so many cases, and its bounds; NaN or infinite where there are none."""

    cases: int
    estimate: float
    lower: float
    upper: float


def convergence_section(subject: Subject) -> Section | None:
    """Success rates and the 95 % quantile of the errors against the number of cases; None for fewer than sixteen."""
    frame = subject.whole
    if len(frame) < 2 * FEWEST:
        return None
    curves = requirement_curves(subject)
    plates = [
        plate(curve_figure(points, "success rate", asked), f"converge{k}", f"{name}: success rate and its bounds.")
        for k, (name, asked, points) in enumerate(curves)
    ]
    data = {name: [asdict(point) for point in points] for name, _, points in curves}
    if subject.metric is not None:
        points = quantile_curve(frame, subject.metric)
        if points:
            figure = curve_figure(points, f"95 % of {magnitude_label(subject.metric)}", subject.bound)
            plates.append(plate(figure, "convergeq", "95 % quantile of the errors and its bounds."))
            data[f"{subject.metric}: 95 % quantile"] = [asdict(point) for point in points]
    if not plates:
        return None
    note = (
        "Of the first so many cases, in the order of their numbers, which is no order at all. Band: one-sided bounds "
        "at the confidence asked; of a quantile at 90 %, by order statistics. Dashed: what is asked."
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


def quantile_curve(frame: pd.DataFrame, metric: str) -> list[Point]:
    """The 95 % quantile of the magnitudes of the first cases."""
    magnitude = np.abs(numbers(frame, metric))
    points = []
    for size in sizes(len(frame)):
        first = magnitude[:size]
        known = first[np.isfinite(first)]
        if known.size >= FEWEST:
            bounds = quantile_bounds(known, QUANTILE, CONFIDENCE)
            points.append(Point(size, float(np.quantile(known, QUANTILE)), *bounds))
    return points if len(points) > 1 else []


@in_page_style
def curve_figure(points: Sequence[Point], name: str, asked: float | None) -> Figure:
    """A figure's estimate and bounds against the number of cases."""
    figure, axes = new_axes(4.2, 2.8)
    cases = [point.cases for point in points]
    estimates = np.array([point.estimate for point in points])
    lower = np.array([point.lower for point in points])
    upper = np.array([point.upper for point in points])
    if np.isfinite(estimates).any():
        ends = np.concatenate([estimates, lower[np.isfinite(lower)], upper[np.isfinite(upper)]])
        top, bottom = float(ends.max()), float(ends.min())
        axes.fill_between(
            cases, np.nan_to_num(lower, nan=0.0, neginf=bottom), np.where(np.isfinite(upper), upper, top),
            where=np.isfinite(lower) | np.isfinite(upper), color=SERIES[0], alpha=0.25, linewidth=0.0,
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
