"""Each figure against the number of cases: whether more of them would still change it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

from marsyard.reports.columns import magnitude_label, numbers
from marsyard.reports.plates import plate
from marsyard.reports.populations import terrain_groups
from marsyard.reports.sampled import sampled
from marsyard.reports.section import Block, Section, Subject
from marsyard.reports.statistics.samples import mean_interval, quantile_bounds
from marsyard.reports.svg import REQUIREMENT, SERIES, in_page_style, new_axes
from marsyard.reports.verdicts import judge_campaign

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
