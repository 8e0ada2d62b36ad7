"""Looks (evaluations) of a growing campaign: the result for the record of confirmations, and the next look."""

from collections.abc import Sequence

from marsyard.campaigns.definition.evidence import EvidenceKind
from marsyard.campaigns.store.confirmations import add_result
from marsyard.reports.evaluation import Evaluation
from marsyard.reports.joint import collect_counts, read_joint_evidence
from marsyard.reports.sampling_design import SamplingDesign
from marsyard.reports.statistics.proportions import proportion_lower, proportion_upper
from marsyard.reports.statistics.sequential import confidence_at, planned_looks
from marsyard.reports.verdicts import ESTIMATE, Status, Verdict


def record_look(evaluation: Evaluation) -> None:
    """Append the result of a finished confirmation to its record, if the record contains the run."""
    evidence, run = evaluation.evidence, evaluation.run
    if evidence.kind is not EvidenceKind.CONFIRMATION:
        return
    own = read_joint_evidence(evidence).own
    if own is None:  # stated in the verdict
        return
    counts = collect_counts(run, own, evaluation.sampling.with_open_end)
    results = {verdict.requirement_id: str(verdict.status) for verdict in evaluation.verdicts}
    add_result(evidence, len(run.all_cases), results, counts)


def next_look(verdicts: Sequence[Verdict], sampling: SamplingDesign, cases: int) -> int | None:
    """Return the number of cases at the next look (planned evaluation); None if the campaign may stop.

    The campaign may stop if every requirement is decided or can no longer be decided by the remaining cases.
    Requirements that are evaluated by the observed rate (`decide_by = "estimate"`) are ignored.
    """
    if sampling.max_cases is None or cases >= sampling.max_cases:
        return None
    remaining = sampling.max_cases - cases
    risk_fraction = planned_looks(sampling.max_cases)[-1].risk_fraction
    for verdict in verdicts:
        if verdict.status is not Status.INSUFFICIENT or verdict.decide_by == ESTIMATE:
            continue
        if not 0.0 < verdict.probability < 1.0 or not 0.0 < verdict.confidence < 1.0:
            continue
        confidence = confidence_at(verdict.confidence, risk_fraction)
        successes, n = verdict.n - verdict.failures, verdict.n + remaining
        # bounds for independent cases; bounds for shared terrains are not tighter
        can_pass = proportion_lower(successes + remaining, n, confidence) >= verdict.probability
        if can_pass or proportion_upper(successes, n, confidence) < verdict.probability:
            return next(look.cases for look in planned_looks(sampling.max_cases) if look.cases > cases)
    return None
