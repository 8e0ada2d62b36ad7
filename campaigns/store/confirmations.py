"""Record of confirmations: a file of JSON lines, to which runs with `--confirm` append their start and their results.

The lines form a chain: each entry contains the SHA-256 of all bytes before it (`previous`). The file belongs under
version control, next to the algorithm; entries are never changed or removed. Kinds of entries:

- `chain`: beginning of the chain; lines before it are entries of earlier versions
- `start`: a confirmation before its first case, with its content, seeds and number of cases
- `extension`: a larger number of cases of a confirmation (`marsyard append`, `--until-decided`)
- `result`: statuses of the requirements at a look, and the evidence that later looks need
"""

import fcntl
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import IO, Any

from marsyard.campaigns.definition.calibration_terrains import calibration_overlap, uses_imported_terrain
from marsyard.campaigns.definition.campaign import Campaign, find_value, replace_values
from marsyard.campaigns.definition.claims import (
    DEFINITION,
    FrozenAlgorithm,
    bank_seeds,
    confirmation_bank_seeds,
    confirmation_seed,
    freeze_algorithm,
    requirement_key,
)
from marsyard.campaigns.definition.evidence import Confirmation, Evidence, EvidenceKind, classify_evidence
from marsyard.campaigns.errors import CampaignError, StoreError, report_write_errors
from marsyard.campaigns.store.git_registration import find_campaign_file_problem, find_registration_problem
from marsyard.campaigns.store.machine import git_commit
from marsyard.campaigns.store.record import utc_now
from marsyard.scenarios.interface import HasAlgorithms

_KINDS = ("chain", "start", "extension", "result")
#: Keys of the start of a confirmation; those of earlier versions have no `claim`.
_START_KEYS = ("campaign", "number", "seed", "started_utc", "git_commit", "folder", "cases")
_CHAINED_KEYS = ("claim", "bank_seeds", "first_cases", "max_cases", "overlap", "requirements")


@dataclass(frozen=True)
class ConfirmationRecord:
    """Contents of a record of confirmations.

    - confirmations: in the order of their start
    - head: SHA-256 of the file; the next entry contains it
    - is_chained: whether the chain has begun
    """

    confirmations: tuple[Confirmation, ...] = ()
    head: str = hashlib.sha256().hexdigest()
    is_chained: bool = False

    def of_claim(self, claim: str) -> list[Confirmation]:
        """Return the confirmations of a claim, by number."""
        return [entry for entry in self.confirmations if entry.is_chained and entry.claim == claim]


def read_record(path: Path) -> ConfirmationRecord:
    """Read a record and verify its chain; an empty record if the file does not exist.

    Raises StoreError if the file cannot be read, a line is damaged, or the chain is broken.
    """
    if not path.exists():
        return ConfirmationRecord()
    try:
        return _parse_record(path, path.read_bytes())
    except OSError as error:
        raise StoreError(f"{path} cannot be read: {error.strerror or error}") from error


def classify_run(campaign: Campaign) -> Evidence:
    """Determine the kind of evidence of a run that is no confirmation. Raises StoreError like `read_record`."""
    path = campaign.confirmations
    evidence = classify_evidence(campaign, read_record(path).confirmations, freeze_algorithm(campaign))
    if not evidence.is_confirmation:
        return evidence
    return replace(evidence, record=str(path.resolve()), registration=find_registration_problem(path))


def read_confirmations(path: Path) -> list[Confirmation]:
    """Read the confirmations in the order of their start; none if the file does not exist.

    Raises StoreError like `read_record`.
    """
    return list(read_record(path).confirmations)


def _parse_record(path: Path, content: bytes) -> ConfirmationRecord:
    """Parse the lines of a record, and verify their hashes."""
    entries: dict[object, Confirmation] = {}
    digest, is_chained = hashlib.sha256(), False
    for index, line in enumerate(content.splitlines(keepends=True)):
        location, head = f"{path}:{index + 1}", digest.hexdigest()
        digest.update(line)
        try:
            stored = json.loads(line)
            kind = stored.get("entry")
            is_valid = line.endswith(b"\n") and (kind is None if not is_chained and kind != "chain" else kind in _KINDS)
            if not is_valid:
                raise ValueError("damaged line, or entry outside of the chain")
            if kind is None:
                _add_former_entry(entries, stored)
                continue
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise StoreError(f"{location} is not an entry of a record of confirmations") from error
        if stored.get("previous") != head:
            raise StoreError(f"{location}: the chain of hashes is broken: an earlier entry was changed or removed")
        is_chained = True
        try:
            _add_entry(entries, kind, stored, digest.hexdigest())
        except (ValueError, KeyError, TypeError) as error:
            raise StoreError(f"{location} is not an entry of a record of confirmations: {error}") from error
    return ConfirmationRecord(tuple(entries.values()), digest.hexdigest(), is_chained)


def _add_former_entry(entries: dict[object, Confirmation], stored: Mapping[str, Any]) -> None:
    """Add an entry of an earlier version; one with `results` completes that of its start."""
    key = (str(stored["campaign"]), str(stored["namespace"]), int(stored["number"]))
    if "results" in stored:
        entries[key] = replace(entries[key], results=dict(stored["results"]), cases=int(stored["cases"]))
        return
    frozen = FrozenAlgorithm.read(stored["frozen"])
    values = {name: stored[name] for name in _START_KEYS}
    entries[key] = Confirmation(frozen=frozen, claim=frozen.claim, is_chained=False, **values)


def _add_entry(entries: dict[object, Confirmation], kind: str, stored: Mapping[str, Any], head: str) -> None:
    """Add an entry of the chain; `head` is the hash with this entry.

    Raises ValueError if the entry contradicts those before it.
    """
    if kind == "chain":
        return
    key = (str(stored["claim"]), int(stored["number"]))
    if kind == "start":
        values = {name: stored[name] for name in (*_START_KEYS, *_CHAINED_KEYS)}
        entry = Confirmation(frozen=FrozenAlgorithm.read(stored["frozen"]), head=head, **values)
        claim_entries = [item for item in entries.values() if item.is_chained and item.claim == entry.claim]
        if entry.claim != entry.frozen.claim or entry.number != len(claim_entries) + 1:
            raise ValueError("the claim or its number does not agree with the content")
        if entry.seed != confirmation_seed(entry.claim, claim_entries[-1].head if claim_entries else ""):
            raise ValueError("the seed does not follow from the claim and the entries before it")
        entries[key] = entry
    elif kind == "extension":
        entries[key] = replace(entries[key], cases=int(stored["cases"]), head=head)
    else:
        entry, results = entries[key], dict(stored["results"])
        failed = (*entry.failed, *(name for name, status in results.items() if status == "FAIL"))
        entries[key] = replace(
            entry,
            results=results,
            cases=max(entry.cases, int(stored["cases"])),
            counted_cases=int(stored["cases"]),
            counts=dict(stored["counts"]),
            failed=tuple(dict.fromkeys(failed)),
            head=head,
        )


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

    Raises StoreError if the record is invalid, and CampaignError if custom algorithms would run inside of the workers.
    """
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
    registration = find_registration_problem(path) or find_campaign_file_problem(path, campaign.command)
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
        seeds.number,
        frozen.claim,
        str(path.resolve()),
        registration,
        campaign.calibration_overlap,
        uses_imported_terrain(campaign),
    )


def _check_repetition(cases: int, max_cases: int | None, entry: Confirmation) -> None:
    """Raise CampaignError if a run has not the number of cases of the unfinished confirmation that it repeats."""
    if (max_cases, cases) == (entry.max_cases, entry.cases) or (max_cases == entry.max_cases is not None):
        return
    option = f"-n {entry.cases}" if entry.max_cases is None else f"-n {entry.max_cases} --until-decided"
    raise CampaignError(
        f"confirmation {entry.number} of this claim is not finished: continue it with `marsyard resume` in its folder "
        f"({entry.folder}), or repeat it with all its cases: --confirm {option}"
    )


def extend_confirmation(evidence: Evidence, cases: int) -> None:
    """Announce a larger number of cases of a confirmation in its record. Raises StoreError like `add_result`."""
    path = Path(evidence.record)
    with _open_locked(path) as file:
        record, entry = _find_own_entry(path, file, evidence)
        if cases > entry.cases:
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


def find_own_entry(record: ConfirmationRecord, evidence: Evidence) -> Confirmation | None:
    """Return the entry of a run; None if the record does not contain it."""
    entries = record.of_claim(evidence.claim)
    return next((entry for entry in entries if entry.number == evidence.number), None)


def _find_own_entry(path: Path, file: IO[bytes], evidence: Evidence) -> tuple[ConfirmationRecord, Confirmation]:
    """Read an open record, and return it with the entry of a run. Raises StoreError if it has none."""
    record = _parse_record(path, file.read())
    entry = find_own_entry(record, evidence)
    if entry is None:
        raise StoreError(f"{path} does not contain confirmation {evidence.number} of claim {evidence.claim[:8]}")
    return record, entry


def _start_chain(file: IO[bytes], path: Path) -> ConfirmationRecord:
    """Read an open record; begin its chain if it has none."""
    content = file.read()
    record = _parse_record(path, content)
    if record.is_chained:
        return record
    line = _append(file, "chain", {"created_utc": utc_now()}, record.head)
    return _parse_record(path, content + line)


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


def list_related_claims(record: ConfirmationRecord, own: Sequence[Confirmation]) -> list[list[Confirmation]]:
    """List other claims that began before the last confirmation of a claim: their confirmations, in order.

    - own: the confirmations of the claim

    Another claim is related by the name of the campaign, the algorithm, the content of its definition, or a
    requirement.
    """
    entries = record.confirmations
    earlier = entries[: max(entries.index(entry) for entry in own)]
    first = own[0]
    related: dict[str, list[Confirmation]] = {}
    for entry in earlier:
        if entry.claim == first.claim:
            continue
        names = set(entry.requirements.values()) | set(entry.results or ())
        if (
            is_variant(entry, first)
            or entry.frozen.algorithm == first.frozen.algorithm
            or not names.isdisjoint(first.requirements.values())
        ):
            related.setdefault(entry.claim, []).append(entry)
    return list(related.values())


def is_variant(entry: Confirmation, other: Confirmation) -> bool:
    """Whether two claims are about the same campaign: by its name, or by the content of its definition."""
    own_content, other_content = (item.frozen.hashes.get(DEFINITION) for item in (entry, other))
    return entry.campaign == other.campaign or own_content == other_content
