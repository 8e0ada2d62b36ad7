"""Joint evidence of all confirmations of a claim, from their record (`marsyard.campaigns.store.confirmations`).

A confirmation is a look at the cases of all confirmations of its claim. The first look of the first confirmation uses
the ordinary bounds, every later look uses `SequentialTest`. The probability that a wrong PASS ever occurs is therefore
at most 1 - confidence, for any number of confirmations.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from marsyard.campaigns.definition.claims import Confirmation, hash_stored_definition, requirement_key
from marsyard.campaigns.definition.evidence import Evidence
from marsyard.campaigns.errors import StoreError
from marsyard.campaigns.store.confirmation_record import find_own_entry, is_variant, list_related_claims, read_record
from marsyard.campaigns.store.git_history import UNKNOWN, find_registration_problem
from marsyard.reports.case_evidence import RequirementEvidence
from marsyard.reports.decision import collect_evidence
from marsyard.reports.sampling_design import SamplingDesign
from marsyard.reports.stored import StoredRun
from marsyard.reports.verdicts import Status, Verdict
from marsyard.reports.wording import count

#: Statuses that a claim can have passed with.
_PASSED = frozenset(status for status in Status if status is Status.PASS or status.is_qualified)
#: Maximum number of related claims that are listed in a verdict.
_MAX_LISTED = 10


@dataclass(frozen=True)
class JointEvidence:
    """Contents of the record of confirmations about the claim of a run.

    - is_confirmation: whether the run is a confirmation, or repeats one
    - registration_problem: why the record does not show all earlier runs; empty if it does
    - own: entry of the run; None if the record does not contain it
    - others: other confirmations of the claim, by number
    - related: confirmations of other claims that began earlier, by claim (`list_related_claims`)
    """

    is_confirmation: bool = False
    registration_problem: str = ""
    own: Confirmation | None = None
    others: Sequence[Confirmation] = field(default_factory=tuple)
    related: Sequence[Sequence[Confirmation]] = field(default_factory=tuple)

    @property
    def numbers(self) -> list[int]:
        """Numbers of all confirmations whose cases are joined."""
        own = [] if self.own is None else [self.own.number]
        return sorted([*own, *(entry.number for entry in self.others if entry.counts)])

    def earlier_evidence(self, requirement: Mapping[str, Any]) -> RequirementEvidence | None:
        """Join the evidence of the other confirmations for a requirement; None if there is none."""
        key, joined = requirement_key(requirement), None
        for entry in self.others:
            if key not in entry.counts:
                continue
            part = RequirementEvidence.from_table(entry.counts[key], is_first=entry.number == 1)
            joined = part if joined is None else joined.join(part)
        return joined

    def describe_obstacle(self, cases: int) -> str:
        """Describe a missing entry or an unfinished confirmation, which prevents PASS; empty if all are finished.

        cases: number of cases of the run
        """
        if self.is_confirmation and self.own is None:
            return (
                "Earlier results of this claim are unknown: its record of confirmations cannot be found, is damaged, "
                "or lacks this run. PASS needs the record."
            )
        if self.own is not None and cases < self.own.cases:
            return (
                f"The record announces {count(self.own.cases, 'case')} of confirmation {self.own.number}; this folder "
                f"contains {cases:,}. PASS needs all of them."
            )
        unfinished = next((entry for entry in self.others if entry.is_unfinished), None)
        if unfinished is None:
            return ""
        return (
            f"Confirmation {unfinished.number} was started on {unfinished.started_utc[:10]} in the folder "
            f"{unfinished.folder} and is not finished. PASS needs its result: `marsyard resume`, or --confirm again."
        )

    def find_failure(self, requirement_id: str) -> Confirmation | None:
        """Return the first confirmation of the claim at which a requirement was FAIL; None without one."""
        entries = [*self.others, *([] if self.own is None else [self.own])]
        failed = [entry for entry in entries if requirement_id in entry.failed]
        return min(failed, key=lambda entry: entry.number, default=None)

    def is_qualified(self, requirement_id: str) -> bool:
        """Whether PASS of a requirement needs a decision of a person."""
        return bool(self.registration_problem) or self.has_unpassed_variant(requirement_id)

    def has_unpassed_variant(self, requirement_id: str) -> bool:
        """Whether an earlier claim about the campaign (`is_variant`) has not passed a requirement, or is unfinished."""
        own = self.own
        variants = [entries[-1] for entries in self.related if own is not None and is_variant(entries[-1], own)]
        return own is not None and any(
            entry.is_unfinished or not _has_passed(entry, own, requirement_id) for entry in variants
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """The state of the record, and other claims with their results, in sentences."""
        texts = [self.registration_problem] if self.registration_problem else []
        if len(self.numbers) > 1:
            numbers = ", ".join(map(str, self.numbers))
            texts.append(f"The verdicts are those of the joint evidence of the confirmations {numbers} of this claim.")
        if self.related:
            claims = "; ".join(_describe_claim(entries) for entries in self.related[-_MAX_LISTED:])
            omitted = f", the last {_MAX_LISTED} of them" if len(self.related) > _MAX_LISTED else ""
            texts.append(f"Other claims: {len(self.related)}{omitted}: {claims}.")
        return tuple(texts)


def _has_passed(entry: Confirmation, own: Confirmation, requirement_id: str) -> bool:
    """Whether an earlier claim has passed a requirement of a claim (`own`), or all of its own if it has another one.

    Between campaigns of the catalogue the name identifies the requirement; in a user's campaign the content does.
    """
    results = entry.results or {}
    if entry.is_included and own.is_included:
        return results.get(requirement_id) in _PASSED
    common = [
        entry.requirements[key]
        for key, name in own.requirements.items()
        if name == requirement_id and key in entry.requirements
    ]
    return all(results.get(name) in _PASSED for name in common or results)


def _describe_claim(entries: Sequence[Confirmation]) -> str:
    """Describe a claim by its campaign, its algorithm and its latest results."""
    entry = entries[-1]
    results = ", ".join(f"{name} {status}" for name, status in (entry.results or {}).items()) or "no requirement"
    results = "not finished" if entry.is_unfinished else results
    claim = f"claim {entry.claim[:8]}" if entry.is_chained else "an earlier version"
    return f"{entry.campaign} with {entry.frozen.algorithm} ({claim}, {entry.started_utc[:10]}): {results}"


def find_record_changes(run: StoredRun, own: Confirmation | None, design: SamplingDesign) -> list[str]:
    """Describe how a folder differs from the entry of its run in the record of confirmations, each in a few words.

    Its definition and requirements can differ, and after the result was recorded also the numbers of its cases.
    """
    if own is None:
        return []
    definition, cases, changes = run.definition, len(run.all_cases), []
    if (definition.get("cases"), definition.get("max_cases")) != (own.first_cases, own.max_cases) or (
        own.definition and hash_stored_definition(definition) != own.definition
    ):
        changes.append("a definition other than that in the record")
    requirements = {requirement_key(item): str(item.get("id")) for item in run.requirements}
    if requirements != own.requirements:
        changes.append("requirements other than those in the record")
    if cases > own.cases:
        changes.append(f"{count(cases, 'case')}, {own.cases:,} in the record")
    elif not changes and cases == own.counted_cases and collect_counts(run, own, design) != own.counts:
        changes.append("results of cases other than those in the record")
    return changes


def collect_counts(run: StoredRun, own: Confirmation, design: SamplingDesign) -> dict[str, Any]:
    """Count the cases of each requirement for the record of confirmations, by `requirement_key`."""
    parts = {
        requirement_key(requirement): collect_evidence(
            run.all_cases, requirement, design, has_own_terrains=bool(own.bank_seeds)
        )
        for requirement in run.requirements
    }
    return {key: part.to_table() for key, part in parts.items() if part is not None}


def read_joint_evidence(evidence: Evidence) -> JointEvidence:
    """Read what the record of confirmations contains about the claim of a run."""
    if not evidence.is_confirmation:
        return JointEvidence()
    path = Path(evidence.record)
    try:
        record = read_record(path)
    except StoreError as error:
        return JointEvidence(is_confirmation=True, registration_problem=f"{UNKNOWN}: {error}.")
    registration = find_registration_problem(path)
    own = find_own_entry(record, evidence)
    if own is None:
        problem = f"{UNKNOWN}: {path} does not contain this run."
        if not path.is_file():
            moved = evidence.record_from_folder and f", nor {evidence.record_from_folder} from the folder of the run"
            problem = f"{UNKNOWN}: the record cannot be found. {path} does not exist{moved}. Put it back there."
        return JointEvidence(is_confirmation=True, registration_problem=problem)
    entries = record.of_claim(own.claim)
    others = [entry for entry in entries if entry.number != own.number]
    return JointEvidence(
        is_confirmation=True,
        registration_problem=evidence.registration or registration,
        own=own,
        others=others,
        related=list_related_claims(record, entries),
    )


def qualify_verdict(verdict: Verdict, joint: JointEvidence, cases: int) -> Verdict:
    """Replace the status of a verdict where the record of confirmations shows more than the numbers.

    FAIL of an earlier look remains; an unfinished confirmation results in INSUFFICIENT. PASS is marked if the record is
    not registered, or if other claims about the campaign have not passed.
    """
    failure = joint.find_failure(verdict.requirement_id)
    if failure is not None and verdict.status is not Status.FAIL:
        reason = (
            f"Confirmation {failure.number} of this claim resulted in FAIL, which is final: a changed algorithm is a "
            "new claim."
        )
        return replace(verdict, status=Status.FAIL, reason=reason, additional_cases=None)
    obstacle = joint.describe_obstacle(cases)
    if obstacle and verdict.status.is_met:
        return verdict.withhold(obstacle)
    if verdict.status is not Status.PASS:
        return verdict
    if joint.registration_problem:
        return replace(verdict, status=Status.UNREGISTERED)
    return (
        replace(verdict, status=Status.OTHER_CLAIMS) if joint.has_unpassed_variant(verdict.requirement_id) else verdict
    )


def describe_contribution(verdict: Verdict, own: RequirementEvidence | None, joint: JointEvidence) -> Verdict:
    """Add the numbers of the run itself to a verdict that joins several confirmations."""
    if own is None or len(joint.numbers) < 2:
        return verdict
    text = f"This run alone: {own.population.failures:,} of {count(own.population.n, 'case')} failed."
    return replace(verdict, joint_text=text)
