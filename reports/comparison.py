"""Algorithms compared on the same cases, and two stored campaigns compared with each other.

Algorithms are paired: both had the same pictures, or the same draws. Whether one succeeds more often is tested by the
cases in which just one of them does (`marsyard.reports.statistics.changes`); whose errors are smaller, by the
differences of the cases that both answered. Where cases share terrains, whole terrains are compared. Further algorithms
stand in the rows as `marsyard.scenarios.trial` puts them.

Campaigns that ran the same draws (name, seed, dispersions) are compared in pairs as well. Otherwise terrain by terrain,
or by whole terrains where they have none in common. The p are corrected for their number by Holm's method.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from marsyard.reports.columns import label, numbers, primary_metric, split_unit
from marsyard.reports.populations import ENGINE_FAILURES, is_flag, members, succeeded, terrain_groups
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.sampled import sampled
from marsyard.reports.section import Block, Grid, Section, Subject, grid_of
from marsyard.reports.statistics.changes import Sample, compared_errors, compared_successes, difference_p, holm
from marsyard.reports.stored import StoredRun, table
from marsyard.reports.wording import NOTHING, number, p_text, percent, stated


@dataclass(frozen=True)
class Contender:
    """What one algorithm did.

    Attributes
    ----------
    name
        Its label.
    cases, answered, failed
        Cases it was run on, those that it answered, and those in which it crashed or broke a limit.
    succeeded
        Cases within the bound; None where the page has none.
    median, p95
        Of the magnitude of the metric over the cases that it answered; NaN for none.
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
    """One algorithm against the one that is judged, on the same cases.

    Attributes
    ----------
    name
        The other's label.
    only_first, only_other
        Cases in which just the judged one, or just the other, is within the bound; None where there is no bound.
    success_p
        Two-sided probability of so uneven a split if both succeed equally often; NaN without a bound.
    pairs
        Cases that both answered.
    mean, lower, upper
        Mean of the other's magnitude less the judged one's, with its interval; negative: the other is better.
    error_p
        Two-sided probability of such differences if their distribution is symmetric about zero (Wilcoxon).

    Both probabilities are corrected for the number of algorithms (Holm).
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
    """Labels of the algorithms that the rows hold beside the one that is judged."""
    names = [str(column).removesuffix(".answered") for column in frame.columns if str(column).endswith(".answered")]
    return [name for name in names if is_flag(frame, f"{name}.answered")]


def own_frame(frame: pd.DataFrame, name: str) -> pd.DataFrame:
    """The rows as they would be if an algorithm that was compared had been the one that is judged."""
    prefix = f"{name}."
    own = {str(column): str(column).removeprefix(prefix) for column in frame.columns if str(column).startswith(prefix)}
    kept = frame.drop(columns=[column for column in own.values() if column in frame])
    return kept.rename(columns=own)


def contender(frame: pd.DataFrame, name: str, metric: str | None, bound: float | None) -> Contender:
    """What the rows say of the algorithm that is judged in them."""
    magnitude = np.abs(numbers(frame, metric)) if metric is not None else np.full(len(frame), np.nan)
    known = magnitude[np.isfinite(magnitude)]
    within = None
    if metric is not None and bound is not None:
        within = int(succeeded(frame, metric, bound).sum()) if metric in frame else 0
    return Contender(
        name=name,
        cases=len(frame),
        answered=int(frame["answered"].eq(True).sum()),
        failed=int(frame["outcome"].isin(ENGINE_FAILURES).sum()),
        succeeded=within,
        median=float(np.median(known)) if known.size else math.nan,
        p95=float(np.quantile(known, 0.95)) if known.size else math.nan,
    )


def difference(first: pd.DataFrame, other: pd.DataFrame, name: str, metric: str, bound: float | None) -> Difference:
    """One algorithm against another, from rows of the same cases in the same order."""
    mine, its = (np.abs(numbers(frame, metric)) for frame in (first, other))
    both, groups = np.isfinite(mine) & np.isfinite(its), terrain_groups(first)
    split: tuple[int | None, int | None, float] = (None, None, math.nan)
    if bound is not None:
        split = compared_successes(mine <= bound, its <= bound, groups)
    shared = None if groups is None else groups[both]
    mean, lower, upper, p = compared_errors((its - mine)[both], shared, CONFIDENCE)
    return Difference(name, *split, int(both.sum()), mean, lower, upper, p)


def comparison(
    frame: pd.DataFrame, metric: str | None, bound: float | None
) -> tuple[list[Contender], list[Difference]]:
    """All algorithms in the rows, the judged one first, and each other one against it; empty where there is one."""
    names = compared_names(frame)
    # what does not apply to a case that was ended as a whole is told elsewhere
    frame = frame[np.logical_and.reduce([frame[f"{name}.answered"].notna() for name in names])] if names else frame
    if not names or frame.empty:
        return [], []
    judged = str(frame["algorithm"].iloc[0]) if "algorithm" in frame else "judged"
    others = {name: own_frame(frame, name) for name in names}
    contenders = [contender(frame, judged, metric, bound)]
    contenders += [contender(own, name, metric, bound) for name, own in others.items()]
    if metric is None:
        return contenders, []
    found = [difference(frame, own, name, metric, bound) for name, own in others.items() if metric in own]
    of_success, of_errors = (holm([getattr(one, key) for one in found]) for key in ("success_p", "error_p"))
    return contenders, [
        replace(one, success_p=success, error_p=error)
        for one, success, error in zip(found, of_success, of_errors, strict=True)
    ]


def comparison_section(subject: Subject) -> Section | None:
    """The algorithms side by side; None where there is one only."""
    contenders, differences = comparison(subject.frame, subject.metric, subject.bound)
    if not contenders:
        return None
    grids = comparison_grids(contenders, differences, subject.metric)
    judged = contenders[0].name
    note = (
        f"Against {judged}, on the same cases. Only one within the bound: cases that tell the two apart; p of an exact "
        "McNemar test. Difference: the other's error less that of the judged one where both answered, its mean with a "
        f"{stated(CONFIDENCE)} BCa bootstrap interval; p of Wilcoxon's signed ranks. The p are two-sided, corrected "
        "for the number of algorithms (Holm). Where cases share terrains, intervals and p are of whole terrains."
    )
    blocks = [Block(grid=grids[0])]
    if differences:
        blocks.append(Block(heading=f"Against {judged}", grid=grids[1], note=note))
    data = {
        "algorithms": [asdict(one) for one in contenders],
        "against": judged,
        "differences": [asdict(one) for one in differences],
    }
    return Section("algorithms", "Algorithms", "Algorithms on the same cases", blocks, data)


def comparison_grids(
    contenders: Sequence[Contender], differences: Sequence[Difference], metric: str | None
) -> tuple[Grid, Grid]:
    """Tables of what each did and of the differences, as texts."""
    unit = f" ({split_unit(metric)[1]})" if metric is not None and split_unit(metric)[1] else ""
    first = grid_of(
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
    judged = contenders[0].name if contenders else ""
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
    return first, Grid(["Algorithm", f"Only {judged}", "Only it", "p", "Pairs", f"Difference{unit}", "p"], rows)


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
    """As `_unpaired_p`, of campaigns that have no terrain in common, also where they share numbers."""
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
