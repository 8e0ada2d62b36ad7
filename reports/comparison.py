"""Comparison of algorithms on the same cases, and of two stored campaigns.

Algorithms are paired case by case: successes are compared by discordant cases, errors by the differences of cases that
both answered (`marsyard.reports.statistics.changes`). Campaigns with the same draws (name, seed, dispersions) are
paired as well; others are compared terrain by terrain, or by whole terrains without common terrains. Shared
terrains count by terrain. All p are corrected for their number by Holm's method.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from marsyard.reports import rates
from marsyard.reports.rates import CONFIDENCE, success_mask
from marsyard.reports.sampling_design import read_sampling_design
from marsyard.reports.section import Block, Grid, Section, Subject, build_grid
from marsyard.reports.statistics.changes import Sample, compare_errors, compare_successes, difference_p, holm
from marsyard.reports.stored import StoredRun, table
from marsyard.reports.wording import (
    NOTHING,
    format_fraction,
    label,
    note_text,
    number,
    numbers,
    p_text,
    percent,
    primary_metric,
    split_unit,
)


@dataclass(frozen=True)
class Contender:
    """Results of one algorithm.

    failed: cases in which it crashed or broke a limit
    succeeded: cases within the bound; None without a bound
    median, p95: of the metric's magnitude over the answered cases
    """

    name: str
    cases: int
    answered: int
    failed: int
    succeeded: int | None
    median: float
    p95: float


@dataclass(frozen=True)
class Difference:
    """Another algorithm against the one under test on the same cases; both p are corrected for their number (Holm).

    only_first, only_other: cases in which only the one under test, or only the other, is within the bound, if any
    success_p: two-sided probability of so uneven a split if both succeed equally often
    pairs: cases that both answered
    mean, lower, upper: mean of the other's magnitude less that of the algorithm under test, with its interval
    error_p: two-sided probability of such differences if they are symmetric about zero (Wilcoxon)
    """

    name: str
    only_first: int | None
    only_other: int | None
    success_p: float
    pairs: int
    mean: float
    lower: float
    upper: float
    error_p: float


def compared_names(frame: pd.DataFrame) -> list[str]:
    """Labels of the compared algorithms in the rows."""
    names = [str(column).removesuffix(".answered") for column in frame.columns if str(column).endswith(".answered")]
    return [name for name in names if rates.is_flag(frame, f"{name}.answered")]


def select_algorithm(frame: pd.DataFrame, name: str) -> pd.DataFrame:
    """The rows with a compared algorithm in place of the algorithm under test."""
    prefix = f"{name}."
    own = {str(column): str(column).removeprefix(prefix) for column in frame.columns if str(column).startswith(prefix)}
    renamed = frame.drop(columns=[column for column in own.values() if column in frame])
    return renamed.rename(columns=own)


def contender(frame: pd.DataFrame, name: str, metric: str | None, bound: float | None) -> Contender:
    """Results of the algorithm under test in the rows."""
    magnitude = np.abs(numbers(frame, metric)) if metric is not None else np.full(len(frame), np.nan)
    finite = magnitude[np.isfinite(magnitude)]
    within = None
    if metric is not None and bound is not None:
        within = int(success_mask(frame, metric, bound).sum()) if metric in frame else 0
    return Contender(
        name=name,
        cases=len(frame),
        answered=int(frame["answered"].eq(True).sum()),
        failed=int(frame["outcome"].isin(rates.ENGINE_FAILURES).sum()),
        succeeded=within,
        median=float(np.median(finite)) if finite.size else math.nan,
        p95=float(np.quantile(finite, 0.95)) if finite.size else math.nan,
    )


def difference(first: pd.DataFrame, other: pd.DataFrame, name: str, metric: str, bound: float | None) -> Difference:
    """Another algorithm against the first, from rows of the same cases in the same order."""
    mine, its = (np.abs(numbers(frame, metric)) for frame in (first, other))
    both, groups = np.isfinite(mine) & np.isfinite(its), rates.terrain_groups(first)
    split: tuple[int | None, int | None, float] = (None, None, math.nan)
    if bound is not None:
        split = compare_successes(mine <= bound, its <= bound, groups)
    shared = None if groups is None else groups[both]
    mean, lower, upper, p = compare_errors((its - mine)[both], shared, CONFIDENCE)
    return Difference(name, *split, int(both.sum()), mean, lower, upper, p)


def comparison(
    frame: pd.DataFrame, metric: str | None, bound: float | None
) -> tuple[list[Contender], list[Difference]]:
    """Results of all algorithms, the one under test first, and differences of the others; empty for a single one."""
    names = compared_names(frame)
    # cases that ended before any algorithm ran have no answers to compare
    frame = frame[np.logical_and.reduce([frame[f"{name}.answered"].notna() for name in names])] if names else frame
    if not names or frame.empty:
        return [], []
    tested = str(frame["algorithm"].iloc[0]) if "algorithm" in frame else "tested"
    others = {name: select_algorithm(frame, name) for name in names}
    contenders = [contender(frame, tested, metric, bound)]
    contenders += [contender(own, name, metric, bound) for name, own in others.items()]
    if metric is None:
        return contenders, []
    differences = [difference(frame, own, name, metric, bound) for name, own in others.items() if metric in own]
    of_success, of_errors = (holm([getattr(one, key) for one in differences]) for key in ("success_p", "error_p"))
    return contenders, [
        replace(one, success_p=success, error_p=error)
        for one, success, error in zip(differences, of_success, of_errors, strict=True)
    ]


def comparison_section(subject: Subject) -> Section | None:
    """The algorithms side by side; None for a single algorithm."""
    contenders, differences = comparison(subject.frame, subject.metric, subject.bound)
    if not contenders:
        return None
    grids = comparison_grids(contenders, differences, subject.metric)
    tested = contenders[0].name
    note = note_text("common.comparison", tested=tested, confidence=format_fraction(CONFIDENCE))
    blocks = [Block(grid=grids[0])]
    if differences:
        blocks.append(Block(heading=f"Against {tested}", grid=grids[1], note=note))
    data = {
        "algorithms": [asdict(one) for one in contenders],
        "against": tested,
        "differences": [asdict(one) for one in differences],
    }
    return Section("algorithms", "Algorithms", "Algorithms on the same cases", blocks, data)


def comparison_grids(
    contenders: Sequence[Contender], differences: Sequence[Difference], metric: str | None
) -> tuple[Grid, Grid]:
    """Tables of results and of differences."""
    unit = f" ({split_unit(metric)[1]})" if metric is not None and split_unit(metric)[1] else ""
    first = build_grid(
        contenders,
        {
            "Algorithm": lambda one: one.name,
            "Answered": lambda one: percent(one.answered / one.cases),
            "Failed": lambda one: f"{one.failed:,}",
            "Within bound": lambda one: NOTHING if one.succeeded is None else percent(one.succeeded / one.cases),
            f"Median{unit}": lambda one: number(one.median),
            f"95 %{unit}": lambda one: number(one.p95),
        },
    )
    tested = contenders[0].name if contenders else ""
    rows = [
        [
            one.name,
            *(NOTHING if only is None else f"{only:,}" for only in (one.only_first, one.only_other)),
            p_text(one.success_p),
            f"{one.pairs:,}",
            f"{number(one.mean)} ({number(one.lower)} to {number(one.upper)})" if one.pairs else NOTHING,
            p_text(one.error_p),
        ]
        for one in differences
    ]
    return first, Grid(["Algorithm", f"Only {tested}", "Only it", "p", "Pairs", f"Difference{unit}", "p"], rows)


@dataclass(frozen=True)
class Figure:
    """One figure of a campaign, case by case.

    larger_is_better: whether it is a rate of successes
    values: 0 and 1 of a rate, or magnitudes; NaN for cases that do not count
    """

    name: str
    larger_is_better: bool
    values: Float[np.ndarray, " n"]

    @property
    def text(self) -> str:
        """The rate with its cases, or median and 95 % quantile."""
        values = self.known
        if values.size == 0:
            return NOTHING
        if self.larger_is_better:
            return f"{percent(self.level)} of {values.size:,}"
        return f"{number(self.level)}, 95 % {number(float(np.quantile(values, 0.95)))}"

    @property
    def known(self) -> Float[np.ndarray, " known"]:
        """Values of the cases that count."""
        return np.asarray(self.values[np.isfinite(self.values)])

    @property
    def level(self) -> float:
        """The rate, or the median; NaN for no cases."""
        values = self.known
        if values.size == 0:
            return math.nan
        return float(values.mean() if self.larger_is_better else np.median(values))


@dataclass(frozen=True)
class Contrast:
    """One figure of both campaigns, and the corrected two-sided p of their difference."""

    name: str
    first: Figure
    second: Figure
    p_value: float


def list_figures(run: StoredRun) -> tuple[pd.DataFrame, list[Figure]]:
    """The drawn cases of a campaign, and its figures: success by requirement, answers, completion, and magnitudes."""
    frame = read_sampling_design(run.configuration).draw(run.frame)
    figures: dict[str, Figure] = {}
    metrics = dict.fromkeys([primary_metric(frame, run.requirements)])
    for asked in run.requirements:
        name, metric, bound = str(asked.get("id", "?")), str(asked.get("metric", "")), asked.get("bound")
        is_bounded = isinstance(bound, int | float)
        if metric not in frame or not (is_bounded or rates.is_flag(frame, metric)):
            continue
        try:
            chosen = rates.members(frame, str(asked.get("population", "all")))
        except ValueError:
            continue
        limit, scale = (float(x) if isinstance(x, int | float) else math.nan for x in (bound, asked.get("scale", 1)))
        success = success_mask(frame, metric, limit, scale)
        figures[name] = Figure(name, True, np.where(chosen, success.astype(np.float64), np.nan))
        if is_bounded:
            metrics[metric] = None
    for measured in filter(None, metrics):
        magnitude = np.abs(numbers(frame, measured))
        figures[measured] = Figure(label(measured), False, np.where(np.isfinite(magnitude), magnitude, np.nan))
    if rates.is_flag(frame, "answered"):
        figures["answered"] = Figure("answered", True, rates.members(frame, "valid").astype(np.float64))
    figures["came to an end"] = Figure("came to an end", True, rates.members(frame, "completed").astype(np.float64))
    return frame, list(figures.values())


def compare_campaigns(first: StoredRun, second: StoredRun) -> tuple[bool, list[Contrast]]:
    """Whether the campaigns' cases are pairs, and the contrasts of the figures that both have."""
    frames, of_each = zip(*(list_figures(run) for run in (first, second)), strict=True)
    paired = same_draws(first, second)
    theirs = {figure.name: figure for figure in of_each[1]}
    both = [(figure, theirs[figure.name]) for figure in of_each[0] if figure.name in theirs]
    test = _paired_p if paired else partial(_unpaired_p, common=have_same_terrains(first, second))
    p_values = holm([test(frames[0], mine, frames[1], other) for mine, other in both])
    return paired, [Contrast(mine.name, mine, other, p) for (mine, other), p in zip(both, p_values, strict=True)]


def same_draws(first: StoredRun, second: StoredRun) -> bool:
    """Whether equal case numbers are the same case in both campaigns."""
    return all(
        first.recorded(key) == second.recorded(key) for key in ("name", "scenario", "seed", "dispersions", "design")
    )


def have_same_terrains(first: StoredRun, second: StoredRun) -> bool:
    """Whether equal terrain numbers are the same terrain: all parameters but the algorithm's are equal."""
    worlds = [
        {name: value for name, value in table(run.recorded("parameters")).items() if name != "algorithm"}
        for run in (first, second)
    ]
    return worlds[0] == worlds[1] and first.recorded("scenario") == second.recorded("scenario")


def campaign_diff_grid(names: Sequence[str], found: Sequence[Contrast]) -> Grid:
    """Table of the figures side by side."""
    head = ["", *names, "p"]
    return Grid(head, [[one.name, one.first.text, one.second.text, p_text(one.p_value)] for one in found])


def campaign_diff_data(found: Sequence[Contrast]) -> list[dict[str, Any]]:
    """The contrasts as plain data: rate or median of each campaign with its cases; None for NaN."""

    def level(figure: Figure) -> dict[str, Any]:
        cases = figure.known.size
        return {"rate" if figure.larger_is_better else "median": figure.level if cases else None, "cases": cases}

    return [
        {
            "name": one.name,
            "first": level(one.first),
            "second": level(one.second),
            "p": None if math.isnan(one.p_value) else one.p_value,
        }
        for one in found
    ]


def build_sample(frame: pd.DataFrame, figure: Figure) -> Sample:
    """A figure with the stored terrain number of each case, which is comparable between campaigns."""
    groups = rates.terrain_groups(frame)
    if groups is None:
        return Sample(figure.values, np.zeros(figure.values.size, dtype=np.int64))
    named = pd.to_numeric(frame["terrain"], errors="coerce").to_numpy(dtype=np.float64, na_value=np.nan)
    # cases of unknown or non-numeric terrain get their own negative number
    alone = ~np.isfinite(named)
    return Sample(figure.values, np.where(alone, -1.0 - groups, np.nan_to_num(named)).astype(np.int64))


def _unpaired_p(first: pd.DataFrame, mine: Figure, second: pd.DataFrame, other: Figure, *, common: bool) -> float:
    here, there = build_sample(first, mine), build_sample(second, other)
    if not common:  # equal numbers are other terrains, so renumber them
        if not here.terrains.size or not there.terrains.size:
            return math.nan
        apart = there.terrains + (1 + int(here.terrains.max()) - int(there.terrains.min()))
        there = Sample(there.values, apart)
    return difference_p(here, there)


def _paired_p(first: pd.DataFrame, mine: Figure, second: pd.DataFrame, other: Figure) -> float:
    _, here, there = np.intersect1d(first["case"], second["case"], return_indices=True)
    a, b = mine.values[here], other.values[there]
    both = np.isfinite(a) & np.isfinite(b)
    if not both.any():
        return math.nan
    groups = rates.terrain_groups(first)
    shared = None if groups is None else groups[here][both]
    if mine.larger_is_better:
        return compare_successes(a[both] > 0.5, b[both] > 0.5, shared)[2]
    return compare_errors(b[both] - a[both], shared, CONFIDENCE)[3]
