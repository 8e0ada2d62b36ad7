"""Several algorithms on the same cases: what each did, and what the pairs say of the differences.

Cases are paired: both algorithms had the same pictures, or the same draws. Whether one succeeds more often is told by
the cases in which just one of them does (`marsyard.reports.statistics.paired`); whose errors are smaller, by the
differences of the cases that both answered. Where cases share terrains, whole terrains are compared. Further algorithms
stand in the rows as `marsyard.scenarios.trial` puts them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import pandas as pd

from marsyard.reports.columns import numbers, split_unit
from marsyard.reports.populations import ENGINE_FAILURES, is_flag, succeeded, terrain_groups
from marsyard.reports.section import Block, Section, Subject
from marsyard.reports.sections import Grid
from marsyard.reports.statistics.changes import holm
from marsyard.reports.statistics.paired import compared_errors, compared_successes
from marsyard.reports.wording import NOTHING, number, percent, stated

CONFIDENCE = 0.9


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
    first = Grid(
        ["Algorithm", "Answered", "Failed", "Within bound", f"Median{unit}", f"95 %{unit}"],
        [
            [
                one.name,
                percent(one.answered / one.cases),
                f"{one.failed:,}",
                NOTHING if one.succeeded is None else percent(one.succeeded / one.cases),
                number(one.median),
                number(one.p95),
            ]
            for one in contenders
        ],
    )
    judged = contenders[0].name if contenders else ""
    second = Grid(
        ["Algorithm", f"Only {judged}", "Only it", "p", "Pairs", f"Difference{unit}", "p"],
        [
            [
                one.name,
                NOTHING if one.only_first is None else f"{one.only_first:,}",
                NOTHING if one.only_other is None else f"{one.only_other:,}",
                _p(one.success_p),
                f"{one.pairs:,}",
                f"{number(one.mean)} ({number(one.lower)} to {number(one.upper)})" if one.pairs else NOTHING,
                _p(one.error_p),
            ]
            for one in differences
        ],
    )
    return first, second


def _p(value: float) -> str:
    if math.isnan(value):
        return NOTHING
    return "< 0.001" if value < 0.001 else f"{value:.3f}"
