"""Whether a campaign that stops itself has said what it can: at each look, what is decided and what cannot be."""

from __future__ import annotations

from collections.abc import Sequence

from marsyard.reports.sampled import Sampled
from marsyard.reports.statistics.proportions import proportion_lower, proportion_upper
from marsyard.reports.statistics.sequential import confidence_at, looks_of
from marsyard.reports.verdicts import ESTIMATE, Status, Verdict


def next_look(verdicts: Sequence[Verdict], how: Sampled, cases: int) -> int | None:
    """The number of cases at which to look again; None where the campaign may stop.

    It may where every requirement is met or not met, or can be neither by the last look, whatever the cases left do.
    Requirements that are decided by the estimate are not waited for.
    """
    if how.most_cases is None or cases >= how.most_cases:
        return None
    left = how.most_cases - cases
    share = looks_of(how.most_cases)[-1].share
    if not any(_open(verdict, left, share) for verdict in verdicts):
        return None
    return next(look.cases for look in looks_of(how.most_cases) if look.cases > cases)


def _open(verdict: Verdict, left: int, share: float) -> bool:
    """Whether a requirement is undecided, and the cases left can still decide it."""
    if verdict.status is not Status.INSUFFICIENT or verdict.decide_by == ESTIMATE:
        return False
    if not 0.0 < verdict.probability < 1.0 or not 0.0 < verdict.confidence < 1.0:
        return False
    confidence = confidence_at(verdict.confidence, share)
    succeeded, n = verdict.n - verdict.failures, verdict.n + left
    # as for independent cases, all of the population: bounds for shared terrains are never tighter
    may_pass = proportion_lower(succeeded + left, n, confidence) >= verdict.probability
    may_fail = proportion_upper(succeeded, n, confidence) < verdict.probability
    return may_pass or may_fail
