"""Verdict of a campaign with several requirements: overall verdict and exit status."""

from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd

from marsyard.campaigns.definition.evidence import Evidence, EvidenceKind
from marsyard.reports.populations import engine_failed
from marsyard.reports.remedy import find_remedy
from marsyard.reports.sampling_design import INDEPENDENT, SamplingDesign
from marsyard.reports.verdicts import ESTIMATE, Status, Verdict
from marsyard.reports.wording import count

#: Headline of an exploration that meets all requirements: it is no confirmation.
EXPLORATORY_PASS = "PASS (exploration)"  # noqa: S105  (a verdict, not a password)
#: Exit status of PASS with a qualification.
QUALIFIED_EXIT_CODE = 4


@dataclass(frozen=True)
class OverallVerdict:
    """Verdict of a campaign.

    - status: worst status of the requirements, or status of a study; None without requirements or without a verdict
    - crashed: number of crashed cases
    - sentence: explanation
    - without_status: headline if `status` is None
    - is_exploration: whether the run is an exploration, which the headline of PASS states
    - additional_cases: additional cases, all without a failure, that would decide the campaign; None if unknown
    """

    status: Status | None
    crashed: int
    sentence: str
    without_status: str = "NO REQUIREMENT"
    is_exploration: bool = False
    additional_cases: int | None = None

    @property
    def word(self) -> str:
        """The headline."""
        if self.status is Status.PASS and self.is_exploration:
            return EXPLORATORY_PASS
        return self.without_status if self.status is None else str(self.status)


def combine_verdicts(
    verdicts: Sequence[Verdict],
    frame: pd.DataFrame,
    sampling: SamplingDesign = INDEPENDENT,
    evidence: Evidence | None = None,
) -> OverallVerdict:
    """Return the worst of the verdicts: FAIL, INSUFFICIENT, MET BY RATE, PASS with a qualification, PASS."""
    crashed = int(engine_failed(frame).sum())
    statuses = [verdict.status for verdict in verdicts]
    crash_text = f" {count(crashed, 'case')} crashed." if crashed else ""
    if not statuses:
        return OverallVerdict(None, crashed, "The campaign has no requirement." + crash_text)
    worst = next(status for status in Status if status in statuses)
    if not sampling.independent:
        rate_statuses = [verdict.status for verdict in verdicts if verdict.decide_by == ESTIMATE and verdict.n]
        met_text = f"{rate_statuses.count(Status.MET_BY_RATE)} of {count(len(rate_statuses), 'requirement')}"
        rate_text = f"{met_text} met by the rate of these cases. " if rate_statuses else ""
        return OverallVerdict(worst, crashed, rate_text + sampling.no_probability_reason + crash_text)
    n_withheld = sum(verdict.withheld_status is not None for verdict in verdicts)
    if n_withheld and worst is Status.INSUFFICIENT:
        would_be_met = f"{n_withheld} of {count(len(statuses), 'requirement')} would be met."
        reason = "" if evidence is None else f" {evidence.text}"
        return OverallVerdict(worst, crashed, f"{would_be_met}{reason}{crash_text}")
    worst_count, total = statuses.count(worst), count(len(statuses), "requirement")
    fraction = f"{worst_count} of {total}"
    subject = (
        "the requirement" if len(statuses) == 1 else f"any of the {total}" if worst_count == len(statuses) else fraction
    )
    n_undecided = statuses.count(Status.INSUFFICIENT)
    undecided_text = f", {n_undecided} undecided" if n_undecided else ""
    remedy = find_remedy(verdicts, len(frame))
    remedy_text = f" {remedy.text}" if remedy.text else ""
    sentence = {
        Status.PASS: f"{count(len(statuses), 'requirement')} met.",
        Status.MET_BY_RATE: f"{fraction} met by the rate only, not at the required confidence.",
        Status.UNREGISTERED: f"{fraction} met, but no registered record shows the earlier runs.",
        Status.OTHER_CLAIMS: f"{fraction} met, after other claims about this campaign that did not pass.",
        Status.FAIL: f"{fraction} not met{undecided_text}.",
        Status.INSUFFICIENT: f"{count(len(frame), 'case')} are too few to decide {subject}.{remedy_text}",
    }[worst]
    is_exploration = evidence is not None and evidence.kind is EvidenceKind.EXPLORATION
    additional_cases = remedy.cases if worst is Status.INSUFFICIENT and sampling.max_cases is None else None
    return OverallVerdict(
        worst, crashed, sentence + crash_text, is_exploration=is_exploration, additional_cases=additional_cases
    )


def compute_exit_code(verdicts: Sequence[Verdict], crashed: bool) -> int:
    """Return the exit code: 1 for a failed requirement or a crashed case, 3 for an undecided one, 0 otherwise.

    MET BY RATE results in 3, unless the requirement has `accept_rate`; PASS with a qualification results in 4.
    """
    if crashed or any(verdict.status is Status.FAIL for verdict in verdicts):
        return 1
    has_rate_verdict = any(verdict.status is Status.MET_BY_RATE and not verdict.accept_rate for verdict in verdicts)
    if has_rate_verdict or any(verdict.status is Status.INSUFFICIENT for verdict in verdicts):
        return 3
    return QUALIFIED_EXIT_CODE if any(verdict.status.is_qualified for verdict in verdicts) else 0
