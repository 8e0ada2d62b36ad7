"""Two stored campaigns side by side: what each shows of the same figures, and whether they differ.

Where both ran the same draws (name, seed, dispersions) cases are compared in pairs
(`marsyard.reports.statistics.paired`). Otherwise terrain by terrain, or by whole terrains where they have none in
common (`marsyard.reports.statistics.changes`). The p are corrected for their number by Holm's method.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from marsyard.reports.columns import label, numbers, primary_metric
from marsyard.reports.comparison import CONFIDENCE
from marsyard.reports.populations import is_flag, members, succeeded, terrain_groups
from marsyard.reports.sampled import sampled
from marsyard.reports.sections import Grid
from marsyard.reports.statistics.changes import Sample, difference_p, holm
from marsyard.reports.statistics.paired import compared_errors, compared_successes
from marsyard.reports.stored import StoredRun, table
from marsyard.reports.wording import NOTHING, number, percent


@dataclass(frozen=True)
class Figure:
    """One figure of a campaign, case by case.

    Attributes
    ----------
    name
        What it is called, and compared by.
    larger_is_better
        Whether it is a rate of successes.
    values
        0 and 1 of a rate, or magnitudes; NaN where the case does not count, shape (n,).
    """

    name: str
    larger_is_better: bool
    values: Float[np.ndarray, " n"]

    @property
    def text(self) -> str:
        """The rate with its cases, or median and 95 % quantile."""
        known = self.values[np.isfinite(self.values)]
        if known.size == 0:
            return NOTHING
        if self.larger_is_better:
            return f"{percent(float(known.mean()))} of {known.size:,}"
        return f"{number(float(np.median(known)))}, 95 % {number(float(np.quantile(known, 0.95)))}"

    @property
    def level(self) -> float:
        """The rate, or the median; NaN for no cases."""
        known = self.values[np.isfinite(self.values)]
        if known.size == 0:
            return math.nan
        return float(known.mean() if self.larger_is_better else np.median(known))


@dataclass(frozen=True)
class Contrast:
    """One figure of both campaigns, and the corrected two-sided probability of such a difference by chance."""

    name: str
    first: Figure
    second: Figure
    p_value: float


def figures_of(run: StoredRun) -> tuple[pd.DataFrame, list[Figure]]:
    """The drawn cases of a campaign, and the figures that campaigns are compared by: success by each requirement,
    answers, cases that came to an end, and the magnitudes of the requirements' metrics.
    """
    frame = sampled(run.configuration).drawn(run.frame)
    found: dict[str, Figure] = {}
    metrics = dict.fromkeys([primary_metric(frame, run.requirements)])
    for asked in run.requirements:
        name, metric, bound = str(asked.get("id", "?")), str(asked.get("metric", "")), asked.get("bound")
        if metric not in frame or not (isinstance(bound, int | float) or is_flag(frame, metric)):
            continue
        try:
            chosen = members(frame, str(asked.get("population", "all")))
        except ValueError:
            continue
        limit, scale = (
            float(one) if isinstance(one, int | float) else math.nan for one in (bound, asked.get("scale", 1))
        )
        success = succeeded(frame, metric, limit, scale)
        found[name] = Figure(name, True, np.where(chosen, success.astype(np.float64), np.nan))
        if isinstance(bound, int | float):
            metrics[metric] = None
    for measured in metrics:
        if measured is not None:
            found[measured] = Figure(label(measured), False, np.abs(_finite(numbers(frame, measured))))
    if is_flag(frame, "answered"):
        found["answered"] = Figure("answered", True, members(frame, "valid").astype(np.float64))
    found["came to an end"] = Figure("came to an end", True, members(frame, "completed").astype(np.float64))
    return frame, list(found.values())


def contrasts(first: StoredRun, second: StoredRun) -> tuple[bool, list[Contrast]]:
    """Whether the campaigns' cases are pairs, and the figures that both have."""
    frames, of_each = zip(*(figures_of(run) for run in (first, second)), strict=True)
    paired = same_draws(first, second)
    theirs = {figure.name: figure for figure in of_each[1]}
    both = [(figure, theirs[figure.name]) for figure in of_each[0] if figure.name in theirs]
    test = _paired_p if paired else _unpaired_p if same_grounds(first, second) else _apart_p
    p_values = holm([test(frames[0], mine, frames[1], other) for mine, other in both])
    return paired, [Contrast(mine.name, mine, other, p) for (mine, other), p in zip(both, p_values, strict=True)]


def same_draws(first: StoredRun, second: StoredRun) -> bool:
    """Whether a case of one number is the same case in both."""
    return all(first.said(key) == second.said(key) for key in ("name", "scenario", "seed", "dispersions", "design"))


def same_grounds(first: StoredRun, second: StoredRun) -> bool:
    """Whether a terrain of one number is the same terrain in both: all parameters but the algorithm's are the same."""
    worlds = [
        {name: value for name, value in table(run.said("parameters")).items() if name != "algorithm"}
        for run in (first, second)
    ]
    return worlds[0] == worlds[1] and first.said("scenario") == second.said("scenario")


def contrast_grid(names: Sequence[str], found: Sequence[Contrast]) -> Grid:
    """The figures side by side, as texts."""
    head = ["", *names, "p"]
    return Grid(head, [[one.name, one.first.text, one.second.text, p_text(one.p_value)] for one in found])


def contrast_data(found: Sequence[Contrast]) -> list[dict[str, Any]]:
    """The same as plain data: a rate or a median of each campaign with its cases; None for what is not known."""
    return [
        {
            "name": one.name,
            "first": _level_data(one.first),
            "second": _level_data(one.second),
            "p": None if math.isnan(one.p_value) else one.p_value,
        }
        for one in found
    ]


def _level_data(figure: Figure) -> dict[str, Any]:
    cases = int(np.isfinite(figure.values).sum())
    return {"rate" if figure.larger_is_better else "median": figure.level if cases else None, "cases": cases}


def p_text(value: float) -> str:
    """A probability as the tables have it."""
    if math.isnan(value):
        return NOTHING
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def sample_of(frame: pd.DataFrame, figure: Figure) -> Sample:
    """A figure with the terrain of each case, by its name so that it is the same in other campaigns."""
    groups = terrain_groups(frame)
    if groups is None:
        return Sample(figure.values, np.zeros(figure.values.size, dtype=np.int64))
    named = pd.to_numeric(frame["terrain"], errors="coerce").to_numpy(dtype=np.float64, na_value=np.nan)
    # cases of unknown terrain, and terrains that are no numbers, stand alone: below zero
    alone = ~np.isfinite(named)
    return Sample(figure.values, np.where(alone, -1.0 - groups, np.nan_to_num(named)).astype(np.int64))


def _unpaired_p(first: pd.DataFrame, mine: Figure, second: pd.DataFrame, other: Figure) -> float:
    return difference_p(sample_of(first, mine), sample_of(second, other))


def _apart_p(first: pd.DataFrame, mine: Figure, second: pd.DataFrame, other: Figure) -> float:
    """As `_unpaired_p`, of campaigns that have no terrain in common, whatever their numbers."""
    here, there = sample_of(first, mine), sample_of(second, other)
    if not here.terrains.size or not there.terrains.size:
        return math.nan
    apart = there.terrains + (1 + int(here.terrains.max()) - int(there.terrains.min()))
    return difference_p(here, Sample(there.values, apart))


def _paired_p(first: pd.DataFrame, mine: Figure, second: pd.DataFrame, other: Figure) -> float:
    _, here, there = np.intersect1d(first["case"], second["case"], return_indices=True)
    a, b = mine.values[here], other.values[there]
    both = np.isfinite(a) & np.isfinite(b)
    if not both.any():
        return math.nan
    groups = terrain_groups(first)
    shared = None if groups is None else groups[here][both]
    if mine.larger_is_better:
        return compared_successes(a[both] > 0.5, b[both] > 0.5, shared)[2]
    return compared_errors(b[both] - a[both], shared, CONFIDENCE)[3]


def _finite(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    return np.where(np.isfinite(values), values, np.nan)
