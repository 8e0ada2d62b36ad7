"""A campaign's verdict in one word and one sentence, and the exit status that goes with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd

from marsyard.reports.populations import crashed_cases
from marsyard.reports.sampled import INDEPENDENT, Sampled
from marsyard.reports.statistics.clusters import ClusterMethod
from marsyard.reports.verdicts import ESTIMATE, Status, Verdict
from marsyard.reports.wording import count


@dataclass(frozen=True)
class Overall:
    """A campaign's verdict in one word and one sentence.

    `status` is None where no requirement was asked.
    """

    status: Status | None
    crashed: int
    sentence: str

    @property
    def word(self) -> str:
        """The headline."""
        return "NO REQUIREMENT" if self.status is None else str(self.status)


def overall(verdicts: Sequence[Verdict], frame: pd.DataFrame, how: Sampled = INDEPENDENT) -> Overall:
    """The campaign's verdict: that of the worst requirement, by the order FAIL, INSUFFICIENT, MET BY RATE, PASS."""
    crashed = crashed_cases(frame)
    statuses = [verdict.status for verdict in verdicts]
    tail = f" {count(crashed, 'case')} crashed." if crashed else ""
    if not statuses:
        return Overall(None, crashed, "The campaign asks for no requirement." + tail)
    order = (Status.FAIL, Status.INSUFFICIENT, Status.MET_BY_RATE)
    worst = next((status for status in order if status in statuses), Status.PASS)
    if not how.independent:
        return Overall(worst, crashed, _by_rates(verdicts) + how.no_probability + tail)
    sentence = {
        Status.PASS: f"{count(len(statuses), 'requirement')} met.",
        Status.MET_BY_RATE: (
            f"{statuses.count(Status.MET_BY_RATE)} of {count(len(statuses), 'requirement')} met by the rate alone, not "
            "at the confidence."
        ),
        Status.FAIL: f"{statuses.count(Status.FAIL)} of {count(len(statuses), 'requirement')} not met.",
        Status.INSUFFICIENT: (
            f"{statuses.count(Status.INSUFFICIENT)} of {count(len(statuses), 'requirement')} "
            f"cannot be decided by {count(len(frame), 'case')}.{_further(verdicts)}"
        ),
    }[worst]
    return Overall(worst, crashed, sentence + tail)


def _by_rates(verdicts: Sequence[Verdict]) -> str:
    """How many requirements the rates of a designed campaign's own cases meet; empty where none is decided by them."""
    statuses = [verdict.status for verdict in verdicts if verdict.decide_by == ESTIMATE and verdict.n]
    if not statuses:
        return ""
    met = statuses.count(Status.MET_BY_RATE)
    return f"{met} of {count(len(statuses), 'requirement')} met by the rate of these cases. "


def exit_code(verdicts: Sequence[Verdict], crashed: bool) -> int:
    """The exit code of a campaign: 1 a requirement failed or a case crashed, 3 some are not shown, 0 otherwise.

    A requirement that is MET BY RATE gives 3, unless it says `accept_rate`.
    """
    if crashed or any(one.status is Status.FAIL for one in verdicts):
        return 1
    by_rate = any(one.status is Status.MET_BY_RATE and not one.accept_rate for one in verdicts)
    return 3 if by_rate or any(one.status is Status.INSUFFICIENT for one in verdicts) else 0


def _further(verdicts: Sequence[Verdict]) -> str:
    """How many cases would decide what is open, or what keeps more cases from it, where that can be said."""
    limited = next((verdict for verdict in verdicts if verdict.advice), None)
    if limited is not None:
        return f" {limited.advice}"
    needed = [verdict for verdict in verdicts if verdict.further_cases is not None]
    if not needed:
        return ""
    most = max(needed, key=lambda verdict: verdict.further_cases or 0)
    counted = most.clustered is not None and most.clustered.method is ClusterMethod.TERRAIN_COUNT
    where = ", each on a terrain of its own," if counted else ""
    return f" {count(most.further_cases or 0, 'further case')}{where} would do if no more fail."
