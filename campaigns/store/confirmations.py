"""Append confirmations to their record: their start with derived seeds, more cases, and results."""

import fcntl
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import IO, Any

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.claims import (
    DEFINITION,
    Confirmation,
    FrozenAlgorithm,
    bank_seeds,
    confirmation_bank_seeds,
    confirmation_seed,
    freeze_algorithm,
    hash_stored_definition,
    requirement_key,
)
from marsyard.campaigns.definition.evidence import (
    Evidence,
    EvidenceKind,
    calibration_overlap,
    classify_evidence,
    uses_imported_terrain,
)
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.definition.parameter_paths import find_value, replace_values
from marsyard.campaigns.errors import CampaignError, StoreError, report_write_errors
from marsyard.campaigns.store.confirmation_record import ConfirmationRecord, find_own_entry, parse_record, read_record
from marsyard.campaigns.store.git_history import (
    find_campaign_file_problem,
    find_registration_problem,
    git_commit,
    is_catalogue_file,
)
from marsyard.campaigns.store.record import utc_now
from marsyard.scenarios.interface import HasAlgorithms, HasRecordedCases


def classify_run(campaign: Campaign) -> Evidence:
    """Determine the kind of evidence of a run that is no confirmation. Raises StoreError like `read_record`."""
    path = campaign.confirmations
    evidence = classify_evidence(campaign, read_record(path).confirmations, freeze_algorithm(campaign))
    if not evidence.is_confirmation:
        return evidence
    return replace(evidence, record=str(path.resolve()), registration=find_registration_problem(path))


@dataclass(frozen=True)
class _Seeds:
    """Number, seed and bank seeds of a confirmation; `resumed` is an unfinished confirmation that they repeat."""

    number: int
    seed: int
    bank_seeds: Mapping[str, int]
    resumed: Confirmation | None = None


def _derive_seeds(campaign: Campaign, claim: str, record: ConfirmationRecord) -> _Seeds:
    """Derive the seeds of the next confirmation of a claim.

    The first confirmation depends on the claim alone, a later one on the record up to the latest entry of the claim: a
    record that lost its last entries, or has entries of other claims, gives the same seeds. An unfinished confirmation
    is repeated: a run that is stopped and started again has the same cases.
    """
    entries = record.of_claim(claim)
    if entries and entries[-1].is_unfinished:
        entry = entries[-1]
        return _Seeds(entry.number, entry.seed, entry.bank_seeds, entry)
    head = entries[-1].head if entries else ""
    banks = confirmation_bank_seeds(campaign.definition, claim, head)
    return _Seeds(len(entries) + 1, confirmation_seed(claim, head), banks)


def select_confirmation_seed(campaign: Campaign) -> Campaign:
    """Return the campaign with the seeds of its next confirmation.

    Raises StoreError if the record is invalid, and CampaignError if custom algorithms would run inside of the workers,
    or if the cases are recorded.
    """
    if isinstance(campaign.scenario, HasRecordedCases):
        raise CampaignError(
            "recorded cases are the same for every seed, and were seen by the first run; allowed: without --confirm"
        )
    table = campaign.scenario.algorithm_table if isinstance(campaign.scenario, HasAlgorithms) else ()
    if find_value(campaign.definition.parameters, ".".join((*table, "executable", "isolated"))) is False:
        raise CampaignError(
            "executable.isolated is false; allowed in a confirmation: true, so that no algorithm can reach the truth"
        )
    seeds = _derive_seeds(campaign, freeze_algorithm(campaign).claim, read_record(campaign.confirmations))
    parameters = replace_values(campaign.definition.parameters, seeds.bank_seeds)
    definition = campaign.definition.model_copy(update={"seed": seeds.seed, "parameters": parameters})
    overlap = calibration_overlap(replace(campaign, definition=definition), bank_seeds(campaign.definition))
    command = campaign.command
    if command:
        overrides = (word for path, seed in seeds.bank_seeds.items() for word in ("--set", f"{path}={seed}"))
        command = (*command, "--seed", str(seeds.seed), *overrides)
    return replace(campaign, definition=definition, command=command, confirms=True, calibration_overlap=overlap)


def reserve_confirmation(campaign: Campaign, directory: Path) -> Evidence:
    """Enter a confirmation in the record before its first case.

    Raises StoreError if the record is invalid or not writable, or another run has taken the seed in the meantime, and
    CampaignError if the run repeats an unfinished confirmation with another number of cases.
    """
    path, frozen, definition = campaign.confirmations, freeze_algorithm(campaign), campaign.definition
    registration = find_registration_problem(path) or find_campaign_file_problem(path, campaign.file)
    with _open_locked(path) as file:
        record = _start_chain(file, path)
        seeds = _derive_seeds(campaign, frozen.claim, record)
        if seeds.seed != definition.seed:
            raise StoreError(f"{path}: another confirmation has taken the seed {definition.seed}; run again")
        if seeds.resumed is None:
            entry = {
                "campaign": definition.name,
                "claim": frozen.claim,
                "number": seeds.number,
                "seed": seeds.seed,
                "bank_seeds": dict(seeds.bank_seeds),
                "cases": definition.total_cases,
                "first_cases": definition.cases,
                "max_cases": definition.max_cases,
                "overlap": campaign.calibration_overlap,
                "scenario": definition.scenario,
                "definition": hash_stored_definition(definition.model_dump(mode="json")),
                "is_included": _is_included(campaign, frozen),
                "requirements": {
                    requirement_key(item.model_dump(mode="json")): item.id for item in definition.requirements
                },
                "folder": directory.name,
                "started_utc": utc_now(),
                "git_commit": git_commit(),
                "frozen": asdict(frozen),
            }
            _append(file, "start", entry, record.head)
        else:
            _check_repetition(definition.total_cases, definition.max_cases, seeds.resumed)
    return Evidence(
        EvidenceKind.CONFIRMATION,
        number=seeds.number,
        claim=frozen.claim,
        record=str(path.resolve()),
        registration=registration,
        overlap=campaign.calibration_overlap,
        imported_terrain=uses_imported_terrain(campaign),
    )


def _is_included(campaign: Campaign, frozen: FrozenAlgorithm) -> bool:
    """Whether a campaign is one of the catalogue, without a change of its definition or requirements."""
    if campaign.file is None or not is_catalogue_file(campaign.file):
        return False
    hashes = freeze_algorithm(load_campaign(str(campaign.file))).hashes
    return all(hashes[name] == frozen.hashes[name] for name in (DEFINITION, "requirements"))


def _check_repetition(cases: int, max_cases: int | None, entry: Confirmation) -> None:
    """Raise CampaignError if a run has not the number of cases of the unfinished confirmation that it repeats.

    With `--until-decided`, this number is the maximum: the entry announces the cases of the looks until now.
    """
    if max_cases == entry.max_cases and (max_cases is not None or cases == entry.cases):
        return
    option = f"-n {entry.cases}" if entry.max_cases is None else f"-n {entry.max_cases} --until-decided"
    raise CampaignError(
        f"confirmation {entry.number} of this claim is not finished: continue it with `marsyard resume` in its folder "
        f"({entry.folder}), or repeat it with all its cases: --confirm {option}"
    )


def extend_confirmation(evidence: Evidence, cases: int, *, repeats: bool = False) -> None:
    """Announce a larger number of cases of a confirmation in its record. Raises StoreError like `add_result`.

    repeats: whether crashed cases run again, so that the counts in the record will change
    """
    path = Path(evidence.record)
    if not path.is_file():
        raise StoreError(f"the record of confirmations cannot be found: {path} does not exist; put it back there")
    with _open_locked(path) as file:
        record, entry = _find_own_entry(path, file, evidence)
        if cases > entry.cases or repeats:
            values = {"claim": entry.claim, "number": entry.number, "cases": cases, "utc": utc_now()}
            _append(file, "extension", values, record.head)


def add_result(evidence: Evidence, cases: int, results: Mapping[str, str], counts: Mapping[str, Any]) -> None:
    """Append a look at a confirmation to its record, unless the record contains it or announces more cases.

    Raises StoreError if the record is invalid or not writable, or does not contain the confirmation.
    """
    path = Path(evidence.record)
    with _open_locked(path) as file:
        record, entry = _find_own_entry(path, file, evidence)
        if cases < entry.cases or (entry.counted_cases == cases and entry.counts == counts):
            return
        values = {"claim": entry.claim, "number": entry.number, "cases": cases, "finished_utc": utc_now()}
        _append(file, "result", {**values, "results": dict(results), "counts": dict(counts)}, record.head)


def create_record(path: Path) -> None:
    """Create an empty record. Raises StoreError if the file exists or cannot be written."""
    if path.exists():
        raise StoreError(f"{path} exists")
    with _open_locked(path) as file:
        _start_chain(file, path)


def _find_own_entry(path: Path, file: IO[bytes], evidence: Evidence) -> tuple[ConfirmationRecord, Confirmation]:
    """Read an open record, and return it with the entry of a run. Raises StoreError if it has none."""
    record = parse_record(path, file.read())
    entry = find_own_entry(record, evidence)
    if entry is None:
        raise StoreError(f"{path} does not contain confirmation {evidence.number} of claim {evidence.claim[:8]}")
    return record, entry


def _start_chain(file: IO[bytes], path: Path) -> ConfirmationRecord:
    """Read an open record; begin its chain if it has none."""
    content = file.read()
    record = parse_record(path, content)
    if record.is_chained:
        return record
    line = _append(file, "chain", {"created_utc": utc_now()}, record.head)
    return parse_record(path, content + line)


def _append(file: IO[bytes], kind: str, values: Mapping[str, Any], head: str) -> bytes:
    """Append an entry to an open record, and return its line."""
    entry = {"entry": kind, "previous": head, **values}
    line = (json.dumps(entry, ensure_ascii=False) + "\n").encode()
    file.write(line)
    file.flush()
    return line


@contextmanager
def _open_locked(path: Path) -> Iterator[IO[bytes]]:
    """Open the record for reading and appending, locked against other processes."""
    with report_write_errors(path), path.open("ab+") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.seek(0)
        yield file
