"""Evaluation of a stored campaign: verdicts, overall verdict, exit status, and looks at a growing campaign.

A study is a run of `marsyard rare`, `search`, `budget` or `robust`; its verdict does not follow from success rates.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from marsyard.campaigns.definition.claims import Confirmation, hash_requirements
from marsyard.campaigns.definition.evidence import KINDS_WITHOUT_PASS, Evidence, EvidenceKind
from marsyard.campaigns.store.confirmation_record import locate_record
from marsyard.campaigns.store.confirmations import add_result
from marsyard.campaigns.store.rows import ROWS_FILE, readable_store
from marsyard.campaigns.studies.results import BUDGET, RARE, ROBUST, SEARCH
from marsyard.reports.decision import collect_evidence, evaluate_requirements
from marsyard.reports.joint import (
    JointEvidence,
    collect_counts,
    describe_contribution,
    find_record_changes,
    qualify_verdict,
    read_joint_evidence,
)
from marsyard.reports.overall import QUALIFIED_EXIT_CODE, OverallVerdict, combine_verdicts, compute_exit_code
from marsyard.reports.populations import engine_failed
from marsyard.reports.robustness import Robustness
from marsyard.reports.robustness_evaluation import evaluate_robustness
from marsyard.reports.sampling_design import SamplingDesign, read_sampling_design
from marsyard.reports.statistics.proportions import proportion_lower, proportion_upper
from marsyard.reports.statistics.sequential import confidence_at, planned_looks
from marsyard.reports.stored import StoredRun, read_columns, read_run, table
from marsyard.reports.validity import Validity, assess_validity
from marsyard.reports.variants import (
    RobustStudy,
    VariantVerdict,
    evaluate_steps,
    evaluate_variants,
    read_robust_studies,
)
from marsyard.reports.verdicts import ESTIMATE, Status, Verdict
from marsyard.reports.wording import count

#: Headline of a study that decides no requirement.
_NO_VERDICT = "NO VERDICT"


@dataclass(frozen=True)
class Evaluation:
    """A stored campaign with its sampling design, its verdicts, and its kind of evidence.

    - evidence: kind of evidence; a confirmation is a run with a new seed after the algorithm was frozen, a calibration
      allows no PASS
    - verdicts: verdict of each requirement; empty for a study
    - is_qualified: whether a met requirement needs a decision of a person (`marsyard.reports.joint`)
    - own: entry of the run in the record of confirmations; None without one
    """

    run: StoredRun
    sampling: SamplingDesign
    evidence: Evidence
    verdicts: Sequence[Verdict]
    overall_verdict: OverallVerdict
    is_qualified: bool = False
    own: Confirmation | None = None

    @cached_property
    def validity(self) -> Validity:
        """Cases outside of the conditions in which the simulation was checked, and missed checks."""
        return assess_validity(replace(self.run, frame=self.sampling.exclude_nominal_case(self.run.frame)))

    @property
    def exit_code(self) -> int:
        """The exit status of the verdicts, or of the study."""
        if not self.verdicts and self.overall_verdict.status is not None:
            codes = {Status.PASS: 0, Status.FAIL: 1, Status.UNVERIFIED: QUALIFIED_EXIT_CODE}
            return codes.get(self.overall_verdict.status, 3)
        exit_code = compute_exit_code(self.verdicts, bool(self.overall_verdict.crashed))
        return exit_code or (QUALIFIED_EXIT_CODE if self.is_qualified else 0)

    @cached_property
    def robustness(self) -> tuple[Robustness, ...]:
        """Changes that turn PASS into FAIL, from the cases of the run and from those of its studies `robust`."""
        steps = evaluate_steps(self.run, self._robust_studies, self.verdicts)
        return (*steps, *evaluate_robustness(self.run, self.verdicts, self.sampling))

    @cached_property
    def variants(self) -> tuple[VariantVerdict, ...]:
        """Verdicts in the named variants that studies `robust` have run; none is PASS if that of the run cannot be."""
        results = evaluate_variants(self._robust_studies, self.verdicts)
        if not self.evidence.excludes_pass:
            return results
        return tuple(replace(item, status=Status.INSUFFICIENT) if item.status.is_met else item for item in results)

    @cached_property
    def _robust_studies(self) -> list[RobustStudy]:
        return read_robust_studies(self.run) if self.verdicts else []


def evaluate_run(
    directory: Path, requirements: Sequence[Mapping[str, Any]] | None = None, record: Path | None = None
) -> Evaluation:
    """Evaluate the campaign in a folder, or other requirements on its rows. Raises StoreError without rows.

    record: record of confirmations instead of that of the run, such as a copy of it
    """
    run = read_run(directory, requirements)
    sampling = read_sampling_design(run.definition)
    if table(run.record.get("study")):
        overall = _evaluate_study(run.record, run.all_cases)
        if run.unverified and overall.status is Status.PASS:
            overall = replace(overall, status=Status.UNVERIFIED)
        return Evaluation(run, sampling, read_evidence(run.record), (), overall)
    evidence = read_evidence(run.record, uses_campaign_requirements=requirements is None)
    evidence = locate_record(evidence, directory)
    joint = read_joint_evidence(evidence if record is None else replace(evidence, record=str(record)))
    design = sampling.with_open_end if evidence.is_confirmation else sampling
    if changes := find_record_changes(run, joint.own, design):
        # FAIL in the record remains
        evidence = replace(evidence, kind=EvidenceKind.CHANGED, changes=tuple(changes))
    evidence = replace(evidence, notes=(*evidence.notes, *joint.notes, *_describe_requirements(run)))
    columns = read_columns(str(run.definition.get("scenario") or ""))
    # columns that are computed from the truth, and columns that the definition of a case determines
    from_truth, configured = ({}, ()) if columns is None else (columns.from_truth, columns.configured)
    earlier = [joint.earlier_evidence(requirement) for requirement in run.requirements]
    verdicts = evaluate_requirements(run.all_cases, run.requirements, design, from_truth, configured, earlier)
    unfinished_reason = _describe_unfinished(run) or _describe_wrong_rows(run)
    if unfinished_reason:
        verdicts = [_withhold_unfinished(verdict, unfinished_reason) for verdict in verdicts]
        overall = combine_verdicts(verdicts, run.all_cases)
        overall = overall if not verdicts else replace(overall, sentence=unfinished_reason)
        return Evaluation(run, sampling, evidence, verdicts, overall)
    verdicts = [
        _mark_unverified(_qualify(withhold_verdict(verdict, evidence), requirement, run, design, joint), run)
        for verdict, requirement in zip(verdicts, run.requirements, strict=True)
    ]
    overall = combine_verdicts(verdicts, run.all_cases, sampling, evidence)
    is_qualified = joint.is_confirmation and any(joint.is_qualified(verdict.requirement_id) for verdict in verdicts)
    is_qualified = is_qualified or bool(verdicts and run.unverified)
    return Evaluation(run, sampling, evidence, verdicts, overall, is_qualified, joint.own)


def _mark_unverified(verdict: Verdict, run: StoredRun) -> Verdict:
    """Mark PASS of rows without a chain of hashes: nothing shows that they are those of the cases."""
    is_pass = verdict.status is Status.PASS or verdict.status.is_qualified
    return replace(verdict, status=Status.UNVERIFIED) if run.unverified and is_pass else verdict


def _describe_requirements(run: StoredRun) -> tuple[str, ...]:
    """State that the requirements are not those in the hashes of the rows; empty if they are, or without hashes."""
    if run.unverified:
        return ()
    with readable_store(run.directory / ROWS_FILE) as store:
        stored = store.about.get("requirements", "")
    is_changed = stored and stored != hash_requirements(run.requirements)
    return ("The requirements are not those with which the campaign was started.",) if is_changed else ()


def _describe_wrong_rows(run: StoredRun) -> str:
    """Describe that the rows are not one for each case of a finished campaign; empty if they are."""
    numbers = run.all_cases["case"].tolist() if "case" in run.all_cases else []
    recorded = int(run.record.get("cases") or len(numbers))
    # the bounds depend on the blocks of cases, each of which was evaluated
    blocks = [run.definition.get("cases", recorded), *(run.definition.get("appended") or ())]
    for cases in (recorded, sum(blocks)):
        if sorted(numbers) != list(range(cases)):
            return f"The rows are not those of {count(cases, 'case')}: a verdict needs one row for each case from 0."
    return ""


def _qualify(
    verdict: Verdict, requirement: Mapping[str, Any], run: StoredRun, sampling: SamplingDesign, joint: JointEvidence
) -> Verdict:
    """Add the contribution of the record of confirmations to the verdict of a confirmation."""
    if not joint.is_confirmation:
        return verdict
    own = collect_evidence(run.all_cases, requirement, sampling, has_own_terrains=True)
    verdict = describe_contribution(verdict, own, joint)
    return qualify_verdict(verdict, joint, len(run.all_cases))


def _describe_unfinished(run: StoredRun) -> str:
    """Describe that not all cases of a campaign have run; empty for a finished campaign, or one without a record."""
    state = run.recorded("state")
    if state in (None, "finished"):
        return ""
    cases = f"{len(run.all_cases):,} of {count(int(run.recorded('cases') or 0), 'case')}"
    return f"The campaign is not finished ({cases}): a verdict needs all cases."


def _withhold_unfinished(verdict: Verdict, reason: str) -> Verdict:
    """Replace the verdict and the bounds of an unfinished campaign: its number of cases depends on earlier looks."""
    unknown: dict[str, Any] = dict.fromkeys(("lower", "upper", "plain_lower", "plain_upper"), math.nan)
    return replace(verdict.withhold(reason), advice="", all_cases=None, clustered=None, **unknown)


def _evaluate_study(record: Mapping[str, Any], frame: pd.DataFrame) -> OverallVerdict:
    """Return the verdict of a study; its cases are not random samples, so no requirement is evaluated by rates."""
    crashed = int(engine_failed(frame).sum())
    if search := SEARCH.read(record):
        parameters, found = search
        sentence = f"{count(found.violations, 'violation')} of {parameters.requirement} found. See the section."
        return OverallVerdict(Status.FAIL if found.violations else None, crashed, sentence, _NO_VERDICT)
    if ROBUST.read(record):
        return OverallVerdict(None, crashed, "The report of the run evaluates the study.", _NO_VERDICT)
    if BUDGET.read(record):
        return OverallVerdict(None, crashed, "The study computes an error budget. See the section.", _NO_VERDICT)
    if rare := RARE.read(record):
        limit, result = rare
        statement = f"a violation of {limit.requirement} has a probability of at most {limit.max_probability}"
        return OverallVerdict(Status(result.verdict), crashed, f"Statement: {statement}.")
    return OverallVerdict(Status.INSUFFICIENT, crashed, "The study is not finished.")


def read_evidence(record: Mapping[str, Any], *, uses_campaign_requirements: bool = True) -> Evidence:
    """Read the kind of evidence of a run from its record.

    If the program changed during the run, the cases are evidence for no program. A run is not a confirmation either if
    other requirements than the frozen ones of the campaign are evaluated.
    """
    evidence = Evidence.read(record.get("evidence"))
    stored_changes = record.get("changes")
    entries = stored_changes if isinstance(stored_changes, list) else []
    changes = [str(text) for entry in entries for text in table(entry).get("in") or ("unknown",)]
    if evidence.is_confirmation and not uses_campaign_requirements:
        changes.append("requirements other than those of the campaign")
    if not changes:
        return evidence
    if evidence.kind in KINDS_WITHOUT_PASS:
        return replace(evidence, notes=(f"The program changed during the run: {'; '.join(changes)}.",))
    kind = EvidenceKind.CHANGED if evidence.is_confirmation else EvidenceKind.MIXED
    return replace(evidence, kind=kind, changes=tuple(changes))


def withhold_verdict(verdict: Verdict, evidence: Evidence) -> Verdict:
    """Replace PASS and MET BY RATE by INSUFFICIENT for evidence that allows no PASS (`Evidence.excludes_pass`).

    Additional cases of such a run cannot lead to PASS either.
    """
    if not evidence.excludes_pass:
        return verdict
    if not verdict.status.is_met:
        return replace(verdict, additional_cases=None)
    reason = f"The verdict would be {verdict.status}. {evidence.text}"
    return replace(verdict.withhold(reason), withheld_status=verdict.status)


def record_look(evaluation: Evaluation) -> None:
    """Append the result of a finished confirmation to its record, if the record contains the run."""
    evidence, run = evaluation.evidence, evaluation.run
    if evidence.kind is not EvidenceKind.CONFIRMATION:
        return
    if evaluation.own is None:  # stated in the verdict
        return
    counts = collect_counts(run, evaluation.own, evaluation.sampling.with_open_end)
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
