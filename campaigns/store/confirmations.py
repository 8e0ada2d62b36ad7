"""Record of confirmations: a file of JSON lines, to which runs with `--confirm` append their start and their result.

A confirmation evaluates a frozen algorithm (recorded by its options and source hash) on a seed that nobody has used
before. The seed is derived from a namespace (a text in the campaign file), the campaign's name and a running number.
The user therefore cannot choose a seed by its results.

The file belongs under version control, next to the algorithm. Entries are never changed or removed.
"""

from __future__ import annotations

import fcntl
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import IO, Any

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.evidence import (
    Confirmation,
    Evidence,
    EvidenceKind,
    FrozenAlgorithm,
    confirmation_namespace,
    confirmation_seed,
    freeze_algorithm,
)
from marsyard.campaigns.errors import StoreError, report_write_errors
from marsyard.campaigns.store.record import git_commit, utc_now

#: Keys of the entry of a start; the entry of a result has the key `results`.
_START_KEYS = ("campaign", "namespace", "number", "seed", "started_utc", "git_commit", "folder", "cases")


def read_confirmations(path: Path) -> list[Confirmation]:
    """Read the confirmations in the order of their start; none if the file does not exist.

    Raises StoreError if the file cannot be read or a line is damaged.
    """
    if not path.exists():
        return []
    try:
        return _parse_entries(path, path.read_text(encoding="utf-8"))
    except OSError as error:
        raise StoreError(f"{path} cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise StoreError(f"{path} is not a record of confirmations: {error}") from error


def _parse_entries(path: Path, text: str) -> list[Confirmation]:
    """Parse the lines of a record; a line with `results` completes the entry of its confirmation."""
    entries: dict[tuple[str, str, int], Confirmation] = {}
    for index, line in enumerate(text.splitlines()):
        try:
            stored = json.loads(line)
            key = (str(stored["campaign"]), str(stored["namespace"]), int(stored["number"]))
            if "results" in stored:
                entries[key] = replace(entries[key], results=dict(stored["results"]), cases=int(stored["cases"]))
            else:
                values = {name: stored[name] for name in _START_KEYS}
                entries[key] = Confirmation(frozen=FrozenAlgorithm.read(stored["frozen"]), **values)
        except (ValueError, KeyError, TypeError) as error:
            raise StoreError(f"{path}:{index + 1} is not an entry of a record of confirmations") from error
    return list(entries.values())


def select_confirmation_seed(campaign: Campaign) -> Campaign:
    """Return the campaign with the seed of its next confirmation. Raises StoreError if the record is invalid."""
    seed = _next_confirmation(campaign, read_confirmations(campaign.confirmations))[1]
    configuration = campaign.configuration.model_copy(update={"seed": seed})
    command = (*campaign.command, "--seed", str(seed)) if campaign.command else ()
    return replace(campaign, configuration=configuration, command=command, confirms=True)


def _next_confirmation(campaign: Campaign, entries: list[Confirmation]) -> tuple[int, int]:
    """Return number and seed of the next confirmation of a campaign."""
    name, own_namespace = campaign.configuration.name, confirmation_namespace(campaign.configuration)
    number = 1 + sum((entry.campaign, entry.namespace) == (name, own_namespace) for entry in entries)
    return number, confirmation_seed(own_namespace, name, number)


def reserve_confirmation(campaign: Campaign, directory: Path) -> Evidence:
    """Enter a confirmation in the record before its first case.

    Raises StoreError if the record is invalid or not writable, or another run has taken the seed in the meantime.
    """
    path, frozen, configuration = campaign.confirmations, freeze_algorithm(campaign), campaign.configuration
    with _open_locked(path) as file:
        entries = _parse_entries(path, file.read())
        number, seed = _next_confirmation(campaign, entries)
        if seed != configuration.seed:
            raise StoreError(f"{path}: another confirmation has taken the seed {configuration.seed}; run again")
        entry = Confirmation(
            campaign=configuration.name,
            namespace=confirmation_namespace(configuration),
            number=number,
            seed=seed,
            frozen=frozen,
            started_utc=utc_now(),
            git_commit=git_commit(),
            folder=directory.name,
            cases=configuration.total_cases,
        )
        values = {name: value for name, value in asdict(entry).items() if name != "results"}
        file.write(json.dumps(values, ensure_ascii=False) + "\n")
    previous_confirmations = [
        item for item in entries if (item.campaign, item.frozen.algorithm) == (entry.campaign, frozen.algorithm)
    ]
    kind = EvidenceKind.CONFIRMATION
    return Evidence(
        kind,
        entry.namespace,
        number,
        algorithm_confirmations=len(previous_confirmations) + 1,
        record=str(path.resolve()),
    )


def add_result(evidence: Evidence, campaign: str, cases: int, results: Mapping[str, str]) -> None:
    """Append the result of a confirmation to its record, unless the record contains the same result.

    Raises StoreError if the record is invalid or not writable, or does not contain the confirmation.
    """
    path, key = Path(evidence.record), (campaign, evidence.namespace, evidence.number)
    with _open_locked(path) as file:
        entries = {(item.campaign, item.namespace, item.number): item for item in _parse_entries(path, file.read())}
        if key not in entries:
            raise StoreError(f"{path} does not contain confirmation {evidence.number} of {campaign}")
        if entries[key].results == dict(results) and entries[key].cases == cases:
            return
        values: dict[str, Any] = dict(zip(("campaign", "namespace", "number"), key, strict=True))
        values |= {"cases": cases, "finished_utc": utc_now(), "results": dict(results)}
        file.write(json.dumps(values, ensure_ascii=False) + "\n")


@contextmanager
def _open_locked(path: Path) -> Iterator[IO[str]]:
    """Open the record for reading and appending, locked against other processes."""
    with report_write_errors(path), path.open("a+", encoding="utf-8") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.seek(0)
        yield file
