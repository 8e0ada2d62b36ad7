"""Kind of evidence of a run (calibration, confirmation or exploration), determined from its seed and its algorithm.

Options that were set by looking at results fit the cases of these results. Only new cases, drawn once after the
algorithm was frozen, can confirm it. `marsyard run --confirm` draws the seed of such a run from a namespace, and
appends the run to a record of confirmations (`marsyard.campaigns.store.confirmations`).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any, Self

from marsyard.campaigns.definition.campaign import Campaign, leaves
from marsyard.campaigns.definition.configuration import CampaignConfiguration
from marsyard.campaigns.definition.identity import create_identity, describe_algorithms

#: Namespace of the seeds of confirmations without a table `[calibration]` in the campaign file.
NAMESPACE = "confirmation"
#: Keys that the hash `configuration` of a frozen algorithm does not contain: the seed, the number of cases, texts,
#: limits of the run, and the requirements, which have their own hash.
_KEYS_NOT_HASHED = frozenset(
    {"appended", "calibration", "cases", "description", "limits", "max_cases", "requirements", "retain", "seed"}
)
#: Maximum number of a confirmation whose seed is recognised although the record has no entry of it.
_MAX_RESERVED_NUMBER = 1000


class EvidenceKind(StrEnum):
    """Kind of evidence of a run; `Evidence.text` explains each kind, and `KINDS_WITHOUT_PASS` cannot result in PASS."""

    CONFIRMATION = "confirmation"
    REPETITION = "repetition of a confirmation"
    CALIBRATION = "calibration"
    EXPLORATION = "exploration"
    REUSED_SEED = "reused confirmation seed"
    CHANGED = "not the frozen evaluation"


#: Kinds of evidence that allow no PASS: the cases were known before the algorithm was frozen, or the evaluation is not
#: the frozen one.
KINDS_WITHOUT_PASS = frozenset({EvidenceKind.CALIBRATION, EvidenceKind.REUSED_SEED, EvidenceKind.CHANGED})


@dataclass(frozen=True)
class FrozenAlgorithm:
    """All choices that a confirmation freezes.

    - algorithm: name of the algorithm under test
    - options: options of all algorithms of the campaign, under the algorithm's name, and values under `parameters`
    - hashes: SHA-256 (16 digits) of `sources` (of the algorithms), `configuration` (parameters, dispersions, sampling
      design, input files), `requirements`, and `code` (of the simulation)
    """

    algorithm: str
    options: Mapping[str, Any]
    hashes: Mapping[str, str]

    @classmethod
    def read(cls, stored: Mapping[str, Any]) -> Self:
        """Read from the record of confirmations."""
        return cls(str(stored["algorithm"]), dict(stored["options"]), dict(stored["hashes"]))

    def differences(self, other: FrozenAlgorithm) -> list[str]:
        """Describe the differences from another frozen algorithm, each in a few words."""
        texts = []
        if self.algorithm != other.algorithm:
            texts.append(f"algorithm ({self.algorithm}, now {other.algorithm})")
        for name in sorted({*self.options, *other.options}):
            old, new = self.options.get(name), other.options.get(name)
            if old != new:
                texts.append(f"{name} ({json.dumps(old)}, now {json.dumps(new)})")
        names = sorted({*self.hashes, *other.hashes})
        changed_hashes = [name for name in names if self.hashes.get(name) != other.hashes.get(name)]
        if texts and "configuration" in changed_hashes:
            changed_hashes.remove("configuration")  # it includes the named parameters
        return [*texts, *changed_hashes]


def freeze_algorithm(campaign: Campaign) -> FrozenAlgorithm:
    """Describe all choices that a confirmation of a campaign freezes."""
    configuration = campaign.configuration
    algorithms = describe_algorithms(campaign)
    algorithm = next((entry["spec"] for entry in algorithms if entry["role"] == "tested"), configuration.scenario)
    options = {f"{entry['spec']}.{name}": value for entry in algorithms for name, value in entry["options"].items()}
    values = configuration.model_dump(mode="json")
    options |= dict(leaves(values["parameters"], "parameters"))
    frozen_values = {name: value for name, value in values.items() if name not in _KEYS_NOT_HASHED}
    identity = create_identity(configuration)
    contents = {
        "sources": [(entry["spec"], entry["source_hash"]) for entry in algorithms],
        "configuration": [frozen_values, identity.inputs],
        "requirements": values["requirements"],
        "code": identity.code,
    }
    return FrozenAlgorithm(algorithm, options, {name: _hash(content) for name, content in contents.items()})


def _hash(content: Any) -> str:
    """Compute the first 16 digits of the SHA-256 of a content in JSON."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def confirmation_namespace(configuration: CampaignConfiguration) -> str:
    """Return the namespace of the seeds of a campaign's confirmations."""
    return NAMESPACE if configuration.calibration is None else configuration.calibration.namespace


def confirmation_seed(namespace_text: str, campaign: str, number: int) -> int:
    """Compute the seed of a campaign's confirmation, numbered from 1: 48 bits of a SHA-256.

    >>> confirmation_seed("confirmation", "dimes-gusev", 1)
    86360033277001
    """
    digest = hashlib.sha256(f"{namespace_text}\0{campaign}\0{number}".encode()).digest()
    return int.from_bytes(digest[:6])


@dataclass(frozen=True)
class Confirmation:
    """One entry of the record of confirmations.

    - number: number of the confirmation of this campaign and namespace, from 1; it determines the seed
    - results: status of each requirement; None while the run is not finished
    """

    campaign: str
    namespace: str
    number: int
    seed: int
    frozen: FrozenAlgorithm
    started_utc: str
    git_commit: str | None = None
    folder: str = ""
    cases: int = 0
    results: Mapping[str, str] | None = None


@dataclass(frozen=True)
class Evidence:
    """Kind of evidence of a run, stored in its record.

    - number: number of the confirmation whose seed the run uses; 0 without one
    - algorithm_confirmations: number of confirmations of the algorithm (by name) on this campaign, including this one
    - record: file of the record of confirmations; empty for other kinds
    - changes: differences from the frozen algorithm, if the seed was reused; or the options set on these cases
    """

    kind: EvidenceKind = EvidenceKind.EXPLORATION
    namespace: str = ""
    number: int = 0
    algorithm_confirmations: int = 0
    record: str = ""
    changes: tuple[str, ...] = ()

    @classmethod
    def read(cls, stored: object) -> Self:
        """Read from the record of a run; runs of earlier versions are explorations."""
        if not isinstance(stored, Mapping):
            return cls()
        # name of `algorithm_confirmations` in records before version 0.2
        previous_name = {"algorithm_confirmations": stored["of_algorithm"]} if "of_algorithm" in stored else {}
        names = ("namespace", "number", "algorithm_confirmations", "record")
        values = previous_name | {name: stored[name] for name in names if name in stored}
        try:
            return cls(
                EvidenceKind(str(stored.get("kind"))), changes=tuple(map(str, stored.get("changes") or ())), **values
            )
        except ValueError:
            return cls()

    def to_table(self) -> dict[str, Any]:
        """Return the fields as JSON types."""
        return {**asdict(self), "kind": str(self.kind), "changes": list(self.changes)}

    @property
    def excludes_pass(self) -> bool:
        """Whether this kind of evidence allows no PASS, see `KINDS_WITHOUT_PASS`."""
        return self.kind in KINDS_WITHOUT_PASS

    @property
    def title(self) -> str:
        """The kind of evidence with its number, in a few words."""
        if self.kind is EvidenceKind.CALIBRATION:
            return "calibrated on these cases"
        return f"{self.kind} {self.number}" if self.number and self.kind is not EvidenceKind.CHANGED else str(self.kind)

    @property
    def text(self) -> str:
        """Meaning of the kind of evidence for the verdicts, in a sentence or two."""
        changes = "; ".join(self.changes)
        parameter_names = ", ".join(name if "." in name else f"{name}.*" for name in self.changes)
        return {
            EvidenceKind.CONFIRMATION: f"Confirmation {self.number} in the namespace '{self.namespace}': the seed was "
            f"drawn after the algorithm was frozen. {self._multiplicity_text()}",
            EvidenceKind.REPETITION: f"The run repeats confirmation {self.number} without a change; it is no new "
            "evidence.",
            EvidenceKind.CALIBRATION: f"Calibrated on these cases: the parameters {parameter_names} were set by "
            f"looking at the results of these cases. PASS is possible only on new cases (`marsyard run --confirm`).",
            EvidenceKind.EXPLORATION: "Exploration: the seed was chosen freely. A confirmation is a run with "
            "--confirm, on cases that nobody has seen.",
            EvidenceKind.REUSED_SEED: f"The seed belongs to confirmation {self.number}, and the run differs from it: "
            f"{changes}. PASS needs a run with --confirm, which draws a new seed.",
            EvidenceKind.CHANGED: f"Not the frozen evaluation: {changes}. PASS needs a run with --confirm.",
        }[self.kind]

    def _multiplicity_text(self) -> str:
        """Describe the effect of repeated confirmations: up to n times the risk of a false PASS (union bound)."""
        number = self.algorithm_confirmations
        if number <= 1:
            return "It is the first confirmation of this algorithm on this campaign."
        return (
            f"It is confirmation {number} of this algorithm on this campaign, counting all its options: "
            f"the probability that at least one of them is wrongly PASS is up to {number} times that of one."
        )


def classify_evidence(campaign: Campaign, confirmations: Sequence[Confirmation], frozen: FrozenAlgorithm) -> Evidence:
    """Determine the kind of evidence of a run that was not started as a confirmation.

    confirmations: entries of the record of confirmations
    """
    configuration = campaign.configuration
    name, seed = configuration.name, configuration.seed
    same_seed_entries = [entry for entry in confirmations if (entry.campaign, entry.seed) == (name, seed)]
    if same_seed_entries:
        entry = same_seed_entries[0]
        changes = entry.frozen.differences(frozen)
        kind = EvidenceKind.REUSED_SEED if changes else EvidenceKind.REPETITION
        return Evidence(kind, entry.namespace, entry.number, changes=tuple(changes))
    runs = () if configuration.calibration is None else configuration.calibration.runs
    calibration_runs = [run for run in runs if (run.campaign, run.seed) == (name, seed)]
    if calibration_runs:
        options = dict.fromkeys(option for run in calibration_runs for option in run.options)
        return Evidence(EvidenceKind.CALIBRATION, changes=tuple(options))
    # the seed of a confirmation that was not recorded
    own_namespace = confirmation_namespace(configuration)
    for number in range(1, _MAX_RESERVED_NUMBER + 1):
        if confirmation_seed(own_namespace, name, number) == seed:
            reason = "it was run without --confirm, so the seed is not in the record of confirmations"
            return Evidence(EvidenceKind.REUSED_SEED, own_namespace, number, changes=(reason,))
    return Evidence()
