"""Record of confirmations, a file of JSON lines: read it, and verify its chain of hashes.

The lines form a chain: each entry contains the SHA-256 of all bytes before it (`previous`). The file belongs under
version control, next to the algorithm; entries are never changed or removed. Kinds of entries:

- `chain`: beginning of the chain; lines before it are entries of earlier versions
- `start`: a confirmation before its first case, with its content, seeds and number of cases
- `extension`: cases that a confirmation will run: more of them (`marsyard append`, `--until-decided`), or crashed ones
  again (`marsyard resume --retry`)
- `result`: statuses of the requirements at a look, and the evidence that later looks need
"""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from marsyard.campaigns.definition.claims import DEFINITION, Confirmation, FrozenAlgorithm, confirmation_seed
from marsyard.campaigns.definition.evidence import Evidence
from marsyard.campaigns.errors import StoreError

#: Kinds of entries of the chain; entries of earlier versions, which can precede it, have none.
_KINDS = ("chain", "start", "extension", "result")
#: Keys of the start of a confirmation; those of earlier versions have no `claim`.
_START_KEYS = ("campaign", "number", "seed", "started_utc", "git_commit", "folder", "cases")
_CHAINED_KEYS = ("claim", "bank_seeds", "first_cases", "max_cases", "overlap", "requirements")
#: Keys that the first entries of this project's record lack.
_ADDED_KEYS = ("scenario", "definition", "is_included")


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
        return parse_record(path, path.read_bytes())
    except OSError as error:
        raise StoreError(f"{path} cannot be read: {error.strerror or error}") from error


def parse_record(path: Path, content: bytes) -> ConfirmationRecord:
    """Parse the lines of a record, and verify their hashes."""
    entries: dict[object, Confirmation] = {}
    digest, is_chained = hashlib.sha256(), False
    for index, line in enumerate(content.splitlines(keepends=True)):
        location, head = f"{path}:{index + 1}", digest.hexdigest()
        digest.update(line)
        try:
            stored = json.loads(line)
            kind = stored.get("entry")
            if not line.endswith(b"\n") or kind not in (_KINDS if is_chained else (None, "chain")):
                raise ValueError("damaged line, or entry outside of the chain")
            if kind is None:
                _add_former_entry(entries, stored)
                continue
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
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
        values |= {name: stored[name] for name in _ADDED_KEYS if name in stored}
        entry = Confirmation(frozen=FrozenAlgorithm.read(stored["frozen"]), head=head, **values)
        claim_entries = [item for item in entries.values() if item.is_chained and item.claim == entry.claim]
        if entry.claim != entry.frozen.claim or entry.number != len(claim_entries) + 1:
            raise ValueError("the claim or its number does not agree with the content")
        if entry.seed != confirmation_seed(entry.claim, claim_entries[-1].head if claim_entries else ""):
            raise ValueError("the seed does not follow from the claim and the entries before it")
        entries[key] = entry
    elif kind == "extension":
        # results before the announced cases are not those of the present rows
        entries[key] = replace(entries[key], cases=int(stored["cases"]), counted_cases=0, head=head)
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


def find_own_entry(record: ConfirmationRecord, evidence: Evidence) -> Confirmation | None:
    """Return the entry of a run; None if the record does not contain it."""
    entries = record.of_claim(evidence.claim)
    return next((entry for entry in entries if entry.number == evidence.number), None)


def locate_record(evidence: Evidence, directory: Path) -> Evidence:
    """Return the evidence of the run in a folder with the file of its record, if the record has moved with the folder.

    The file at its first path precedes: a copy of the record next to a copy of the run can lack later entries.
    """
    moved = Path(os.path.normpath(directory.resolve() / evidence.record_from_folder))
    if not evidence.record_from_folder or Path(evidence.record).is_file() or not moved.is_file():
        return evidence
    return replace(evidence, record=str(moved))


def list_related_claims(record: ConfirmationRecord, own: Sequence[Confirmation]) -> list[list[Confirmation]]:
    """List other claims that began before the last confirmation of a claim: their confirmations, in order.

    - own: the confirmations of the claim

    Another claim is related by the campaign (`is_variant`), the algorithm, or a requirement.
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


def is_variant(entry: Confirmation, own: Confirmation) -> bool:
    """Whether an earlier claim can be about the same campaign as a claim (`own`).

    By the name or the content of the campaign. A campaign of the user can also be a renamed or changed copy of every
    other campaign of its scenario; only an unchanged campaign of the catalogue cannot.
    """
    content, own_content = (item.frozen.hashes.get(DEFINITION) for item in (entry, own))
    if entry.campaign == own.campaign or content == own_content:
        return True
    is_same_scenario = entry.scenario == own.scenario or entry.parameter_names == own.parameter_names
    return is_same_scenario and not own.is_included
