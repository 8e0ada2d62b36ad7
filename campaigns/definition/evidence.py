"""Kind of evidence of a run (calibration, confirmation or exploration), determined from its seed and its content.

Options that were set by looking at results fit the cases of these results. Only new cases, drawn once after the
algorithm was frozen, can confirm it. `marsyard run --confirm` derives the seed of such a run from its claim
(`marsyard.campaigns.definition.claims`), and appends the run to a record of confirmations
(`marsyard.campaigns.store.confirmations`).
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any, Self

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.claims import Confirmation, FrozenAlgorithm, bank_seeds, confirmation_seed
from marsyard.campaigns.definition.parameter_paths import replace_values
from marsyard.scenarios.interface import IdentifiesTerrains
from marsyard.sim.terrain.bank import IMPORTED_TERRAIN

#: Maximum fraction of the cases of a confirmation on terrains of calibration runs.
MAX_CALIBRATION_OVERLAP = 0.1


class EvidenceKind(StrEnum):
    """Kind of evidence of a run; `Evidence.text` explains each kind, and `KINDS_WITHOUT_PASS` cannot result in PASS."""

    CONFIRMATION = "confirmation"
    REPETITION = "repetition of a confirmation"
    CALIBRATION = "calibration"
    EXPLORATION = "exploration"
    REUSED_SEED = "reused confirmation seed"
    CHANGED = "not the frozen evaluation"
    MIXED = "mixed programs"


#: Kinds of evidence that allow no PASS: the cases were known before the algorithm was frozen, or the evaluation is not
#: the frozen one.
KINDS_WITHOUT_PASS = frozenset(
    {EvidenceKind.CALIBRATION, EvidenceKind.REUSED_SEED, EvidenceKind.CHANGED, EvidenceKind.MIXED}
)


@dataclass(frozen=True)
class Evidence:
    """Kind of evidence of a run, stored in its record.

    - number: number of the confirmation whose seed the run uses; 0 without one
    - claim: identity of the content that is confirmed; empty for other kinds
    - record: file of the record of confirmations; empty for other kinds
    - record_from_folder: its path from the folder of the run, which is valid after both have moved together
    - registration: why the record was not registered when the run started; empty if it was
    - overlap: fraction of the cases of a confirmation on terrains of calibration runs; None if unknown
    - imported_terrain: whether the cases are on an imported DTM, so that no confirmation can use fresh terrains
    - changes: differences from the frozen algorithm, if the seed was reused; the options set on these cases; or the
      changes of the program during the run
    - notes: what the record of confirmations shows; determined at each evaluation, not stored
    """

    kind: EvidenceKind = EvidenceKind.EXPLORATION
    number: int = 0
    claim: str = ""
    record: str = ""
    record_from_folder: str = ""
    registration: str = ""
    overlap: float | None = None
    imported_terrain: bool = False
    changes: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @classmethod
    def read(cls, stored: object) -> Self:
        """Read from the record of a run; without a valid entry it is an exploration."""
        if not isinstance(stored, Mapping):
            return cls()
        overlap = stored.get("overlap")
        try:
            return cls(
                EvidenceKind(str(stored.get("kind"))),
                number=int(stored.get("number", 0)),
                claim=str(stored.get("claim", "")),
                record=str(stored.get("record", "")),
                record_from_folder=str(stored.get("record_from_folder", "")),
                registration=str(stored.get("registration", "")),
                overlap=None if overlap is None else float(overlap),
                imported_terrain=bool(stored.get("imported_terrain", False)),
                changes=tuple(map(str, stored.get("changes") or ())),
            )
        except (TypeError, ValueError):
            return cls()

    def to_table(self) -> dict[str, Any]:
        """Return the stored fields as JSON types."""
        values = {**asdict(self), "kind": str(self.kind), "changes": list(self.changes)}
        del values["notes"]
        return values

    @property
    def is_confirmation(self) -> bool:
        """Whether the run is a confirmation of its claim, or repeats one."""
        return self.kind in (EvidenceKind.CONFIRMATION, EvidenceKind.REPETITION)

    @property
    def excludes_pass(self) -> bool:
        """Whether this evidence allows no PASS: by its kind, or because its terrains were used for calibration."""
        overlaps = self.overlap is not None and self.overlap > MAX_CALIBRATION_OVERLAP
        return self.kind in KINDS_WITHOUT_PASS or (self.is_confirmation and overlaps)

    @property
    def title(self) -> str:
        """The kind of evidence with its number, in a few words."""
        if self.kind is EvidenceKind.CALIBRATION:
            return "calibrated on these cases"
        return f"{self.kind} {self.number}" if self.number and self.kind is not EvidenceKind.CHANGED else str(self.kind)

    @property
    def text(self) -> str:
        """Meaning of the kind of evidence for the verdicts, in sentences."""
        changes = "; ".join(self.changes)
        parameter_names = ", ".join(name if "." in name else f"{name}.*" for name in self.changes)
        text = {
            EvidenceKind.CONFIRMATION: f"Confirmation {self.number} of claim {self.claim[:8]}: the seed was derived "
            "from the frozen content and the record.",
            EvidenceKind.REPETITION: f"The run repeats confirmation {self.number} of claim {self.claim[:8]} without a "
            "change; it is no new evidence.",
            EvidenceKind.CALIBRATION: f"Calibrated on these cases: the parameters {parameter_names} were set by "
            f"looking at the results of these cases. PASS is possible only on new cases (`marsyard run --confirm`).",
            EvidenceKind.EXPLORATION: "Exploration: the seed was chosen freely. A confirmation is a run with "
            "--confirm, on cases that nobody has seen.",
            EvidenceKind.REUSED_SEED: f"The seed belongs to confirmation {self.number}, and the run differs from it: "
            f"{changes}. PASS needs a run with --confirm, which draws a new seed.",
            EvidenceKind.MIXED: f"The program changed during the run: {changes}. The cases are not those of one "
            "program; PASS needs a new run.",
            EvidenceKind.CHANGED: f"Not the frozen evaluation: {changes}. PASS needs a run with --confirm.",
        }[self.kind]
        return " ".join((text, *self.terrain_texts, *self.notes))

    @property
    def terrain_texts(self) -> tuple[str, ...]:
        """The terrains that the cases share with calibration runs or with all confirmations, in sentences."""
        texts: list[str] = []
        if self.kind is not EvidenceKind.CONFIRMATION:
            return ()
        if self.imported_terrain:
            texts.append("The terrain is an imported DTM: all confirmations are on the same ground.")
        if self.overlap is None:
            texts.append("It is unknown whether its terrains were used for calibration.")
        elif self.overlap > 0.0:
            limit = f"more than {100.0 * MAX_CALIBRATION_OVERLAP:.0f} % allow no PASS"
            texts.append(f"{100.0 * self.overlap:.0f} % of its cases are on terrains of calibration runs; {limit}.")
        return tuple(texts)


def classify_evidence(campaign: Campaign, confirmations: Sequence[Confirmation], frozen: FrozenAlgorithm) -> Evidence:
    """Determine the kind of evidence of a run that was not started as a confirmation.

    confirmations: entries of the record of confirmations
    """
    definition = campaign.definition
    name, seed = definition.name, definition.seed
    for entry in confirmations:
        if entry.seed != seed or (not entry.is_chained and entry.campaign != name):
            continue
        own_bank_seeds = bank_seeds(definition)
        changes = entry.frozen.differences(frozen)
        changes += [
            f"{path} ({json.dumps(value)}, now {json.dumps(own_bank_seeds.get(path))})"
            for path, value in entry.bank_seeds.items()
            if own_bank_seeds.get(path) != value
        ]
        kind = EvidenceKind.REUSED_SEED if changes else EvidenceKind.REPETITION
        return Evidence(kind, entry.number, entry.claim, overlap=entry.overlap, changes=tuple(changes))
    runs = () if definition.calibration is None else definition.calibration.runs
    calibration_runs = [run for run in runs if (run.campaign, run.seed) == (name, seed)]
    if calibration_runs:
        options = dict.fromkeys(option for run in calibration_runs for option in run.options)
        return Evidence(EvidenceKind.CALIBRATION, changes=tuple(options))
    if seed == confirmation_seed(frozen.claim, ""):
        reason = "it was run without --confirm, so the seed is not in the record of confirmations"
        return Evidence(EvidenceKind.REUSED_SEED, 1, frozen.claim, changes=(reason,))
    return Evidence()


def calibration_overlap(campaign: Campaign, original_bank_seeds: Mapping[str, int]) -> float | None:
    """Compute the fraction of cases on terrains of the declared calibration runs; None if terrains have no identity.

    - campaign: a confirmation, with its seed and the seeds of its terrain banks
    - original_bank_seeds: seeds of the terrain banks of the campaign file, which its calibration runs used

    Calibration runs are assumed to have as many cases as the campaign.
    """
    definition, calibration = campaign.definition, campaign.definition.calibration
    runs = () if calibration is None else calibration.runs
    seeds = {run.seed for run in runs if run.campaign == definition.name}
    if not isinstance(campaign.scenario, IdentifiesTerrains):
        return None if seeds else 0.0
    parameters = replace_values(definition.parameters, original_bank_seeds)
    known_terrains: set[str] = set()
    for seed in seeds:
        changes = {"seed": seed, "parameters": parameters}
        calibration_run = Campaign(definition.model_copy(update=changes), campaign.scenario)
        known_terrains.update(*_list_terrains(calibration_run))
    if not known_terrains:
        return 0.0
    cases = _list_terrains(campaign)
    return sum(not known_terrains.isdisjoint(terrains) for terrains in cases) / len(cases)


def uses_imported_terrain(campaign: Campaign) -> bool:
    """Whether the cases are on an imported DTM, which a new seed of the terrain bank does not change."""
    if not isinstance(campaign.scenario, IdentifiesTerrains):
        return False
    identities = campaign.scenario.terrain_identities(campaign.base_parameters(), 0)
    return any(identity.startswith(IMPORTED_TERRAIN) for identity in identities)


def _list_terrains(campaign: Campaign) -> list[tuple[str, ...]]:
    """List the identities of the terrains of each case; a case with invalid draws has none."""
    assert isinstance(campaign.scenario, IdentifiesTerrains)  # noqa: S101  (checked by the caller)
    terrains = []
    for case in range(campaign.definition.total_cases):
        try:
            terrains.append(campaign.scenario.terrain_identities(campaign.parameters(case), case))
        except ValueError:
            terrains.append(())
    return terrains
