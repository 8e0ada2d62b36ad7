"""Runs single cases of a stored campaign again, and compares them with what was stored."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from campaigns.configuration import CampaignConfiguration
from campaigns.errors import CampaignError, StoreError
from campaigns.execution import Row, run_cases
from campaigns.products import save_products
from campaigns.record import stored_configuration
from campaigns.store import TABLE_FILE, read_rows
from campaigns.workers import Workers


@dataclass(frozen=True)
class Replay:
    """A case run again.

    Attributes
    ----------
    case
        The case's number.
    row
        Its row this time.
    stored
        Its row as stored, or None if it has none yet.
    differing
        The columns in which the two differ, those with `time` in their name aside.
    products
        What the scenario delivered for figures.
    """

    case: int
    row: Row
    stored: Row | None
    differing: tuple[str, ...]
    products: Mapping[str, Any]


def case_directory(directory: Path, case: int) -> Path:
    """Where a campaign keeps the products of a case."""
    return directory / "cases" / str(case)


def replay(directory: Path, case: int) -> Replay:
    """Runs one case of a stored campaign again, in a worker as the campaign does.

    Raises
    ------
    CampaignError
        Where the folder holds no campaign, or the campaign has no such case.
    """
    configuration = stored_configuration(directory)
    if not 0 <= case < configuration.cases:
        raise CampaignError(f"{directory} has no case {case}; allowed: 0 to {configuration.cases - 1}")
    stored = _stored_row(directory, case)
    with Workers(1) as workers:
        return replay_with(workers, configuration, case, stored)


def replay_with(workers: Workers, configuration: CampaignConfiguration, case: int, stored: Row | None) -> Replay:
    """Runs one case again in workers that are there, and compares it with a row."""
    (completed,) = run_cases(workers, configuration.model_dump_json(), [case], keep_products=True)
    differing = differing_columns(completed.row, stored) if stored is not None else ()
    return Replay(case, completed.row, stored, differing, completed.products)


def _stored_row(directory: Path, case: int) -> Row | None:
    """A case's row in the table, or None if there is none."""
    if not (directory / TABLE_FILE).exists():
        return None
    return next((row for row in read_rows(directory / TABLE_FILE) if row.get("case") == case), None)


def differing_columns(row: Row, other: Row) -> tuple[str, ...]:
    """Columns in which two rows differ: bit for bit, NaN equal to NaN and to nothing, times aside."""
    names = [name for name in dict.fromkeys((*row, *other)) if "time" not in name]
    return tuple(name for name in names if not _same(row.get(name), other.get(name)))


def _same(value: Any, other: Any) -> bool:
    """Whether two values are the same; a missing number is a NaN."""
    if _absent(value) or _absent(other):
        return _absent(value) and _absent(other)
    return bool(value == other)


def _absent(value: Any) -> bool:
    return value is None or value != value


def save_replay(directory: Path, replayed: Replay) -> None:
    """Writes a replayed case's row and products into a folder.

    Raises
    ------
    StoreError
        Where the folder cannot be written.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        (directory / "row.json").write_text(json.dumps(dict(replayed.row), indent=2) + "\n", encoding="utf-8")
        save_products(directory, replayed.products)
    except OSError as error:
        raise StoreError(f"{directory} cannot be written: {error.strerror or error}") from error
