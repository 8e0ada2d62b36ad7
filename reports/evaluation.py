"""Evaluation of a stored campaign: overall verdict, exit status, and the next look of a sequential campaign."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from marsyard.reports.rates import engine_failed
from marsyard.reports.sampling_design import INDEPENDENT, SamplingDesign, read_sampling_design
from marsyard.reports.statistics.proportions import (
    ClusterMethod,
    confidence_at,
    planned_looks,
    proportion_lower,
    proportion_upper,
)
from marsyard.reports.stored import StoredRun, read_run
from marsyard.reports.verdicts import ESTIMATE, Status, Verdict, evaluate_requirements
from marsyard.reports.wording import count


@dataclass(frozen=True)
class OverallVerdict:
    """A campaign's verdict in one word and one sentence; `status` is None without requirements."""

    status: Status | None
    crashed: int
    sentence: str

    @property
    def word(self) -> str:
        """The headline."""
        return "NO REQUIREMENT" if self.status is None else str(self.status)


def overall(verdicts: Sequence[Verdict], frame: pd.DataFrame, how: SamplingDesign = INDEPENDENT) -> OverallVerdict:
    """The verdict of the worst requirement, in the order FAIL, INSUFFICIENT, MET BY RATE, PASS."""
    crashed = int(engine_failed(frame).sum())
    statuses = [verdict.status for verdict in verdicts]
    tail = f" {count(crashed, 'case')} crashed." if crashed else ""
    if not statuses:
        return OverallVerdict(None, crashed, "The campaign asks for no requirement." + tail)
    order = (Status.FAIL, Status.INSUFFICIENT, Status.MET_BY_RATE)
    worst = next((status for status in order if status in statuses), Status.PASS)
    if not how.independent:
        by_rate = [verdict.status for verdict in verdicts if verdict.decide_by == ESTIMATE and verdict.n]
        met = f"{by_rate.count(Status.MET_BY_RATE)} of {count(len(by_rate), 'requirement')}"
        head = f"{met} met by the rate of these cases. " if by_rate else ""
        return OverallVerdict(worst, crashed, head + how.no_probability + tail)
    share = f"{statuses.count(worst)} of {count(len(statuses), 'requirement')}"
    sentence = {
        Status.PASS: f"{count(len(statuses), 'requirement')} met.",
        Status.MET_BY_RATE: f"{share} met by the rate alone, not at the confidence.",
        Status.FAIL: f"{share} not met.",
        Status.INSUFFICIENT: f"{share} cannot be decided by {count(len(frame), 'case')}.{_further_text(verdicts)}",
    }[worst]
    return OverallVerdict(worst, crashed, sentence + tail)


def exit_code(verdicts: Sequence[Verdict], crashed: bool) -> int:
    """The exit code: 1 for a failed requirement or a crashed case, 3 for an undecided one, 0 otherwise.

    MET BY RATE gives 3, unless the requirement has `accept_rate`.
    """
    if crashed or any(one.status is Status.FAIL for one in verdicts):
        return 1
    by_rate = any(one.status is Status.MET_BY_RATE and not one.accept_rate for one in verdicts)
    return 3 if by_rate or any(one.status is Status.INSUFFICIENT for one in verdicts) else 0


def _further_text(verdicts: Sequence[Verdict]) -> str:
    """The additional cases that decide all requirements, or why more cases cannot; may be empty."""
    limited = next((verdict for verdict in verdicts if verdict.advice), None)
    if limited is not None:
        return f" {limited.advice}"
    needed = [verdict for verdict in verdicts if verdict.further_cases is not None]
    if not needed:
        return ""
    largest = max(needed, key=lambda verdict: verdict.further_cases or 0)
    counted = largest.clustered is not None and largest.clustered.method is ClusterMethod.TERRAIN_COUNT
    where = ", each on a new terrain," if counted else ""
    return f" {count(largest.further_cases or 0, 'additional case')} without a failure{where} would decide."


@dataclass(frozen=True)
class Evaluation:
    """A stored campaign with its sampling design and its verdicts."""

    run: StoredRun
    how: SamplingDesign
    verdicts: Sequence[Verdict]
    whole: OverallVerdict

    @property
    def exit_code(self) -> int:
        """The exit status of the verdicts."""
        return exit_code(self.verdicts, bool(self.whole.crashed))


def evaluate_run(directory: Path, requirements: Sequence[Mapping[str, Any]] | None = None) -> Evaluation:
    """Evaluate a campaign by its own or the given requirements; raises StoreError if the folder holds no rows."""
    run = read_run(directory, requirements)
    how = read_sampling_design(run.configuration)
    verdicts = evaluate_requirements(run.whole, run.requirements, how)
    return Evaluation(run, how, verdicts, overall(verdicts, run.whole, how))


def next_look(verdicts: Sequence[Verdict], how: SamplingDesign, cases: int) -> int | None:
    """The number of cases at the next look; None if the campaign may stop.

    It may stop if every requirement is decided, or no result of the remaining cases can decide it. Requirements that
    are decided by the estimate do not count.
    """
    if how.max_cases is None or cases >= how.max_cases:
        return None
    left = how.max_cases - cases
    share = planned_looks(how.max_cases)[-1].share
    for one in verdicts:
        if one.status is not Status.INSUFFICIENT or one.decide_by == ESTIMATE:
            continue
        if not 0.0 < one.probability < 1.0 or not 0.0 < one.confidence < 1.0:
            continue
        confidence = confidence_at(one.confidence, share)
        succeeded, n = one.n - one.failures, one.n + left
        # bounds for independent cases: those for shared terrains are never tighter
        may_pass = proportion_lower(succeeded + left, n, confidence) >= one.probability
        if may_pass or proportion_upper(succeeded, n, confidence) < one.probability:
            return next(look.cases for look in planned_looks(how.max_cases) if look.cases > cases)
    return None
