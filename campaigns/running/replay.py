"""Runs single cases of a stored campaign again, and compares them with what was stored."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marsyard.campaigns.definition.configuration import CampaignConfiguration
from marsyard.campaigns.definition.identity import Identity, identity_of
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.cases import run_cases
from marsyard.campaigns.execution.work import Workers
from marsyard.campaigns.execution.workers import LocalWorkers
from marsyard.campaigns.outcomes import UNFINISHED
from marsyard.campaigns.running.stored import loaded_campaign
from marsyard.campaigns.store.columns import Row
from marsyard.campaigns.store.products import PackedProducts
from marsyard.campaigns.store.record import read, stored_configuration
from marsyard.campaigns.store.retention import KEEP_ALL
from marsyard.campaigns.store.table import stored_row


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
        What the scenario delivered for figures; None where it delivered nothing, or nothing that can be stored.
    note
        Why there are none; empty where nothing is amiss.
    changed
        In what the configuration, the code and the packages' versions differ from those that the campaign ran with.
    """

    case: int
    row: Row
    stored: Row | None
    differing: tuple[str, ...]
    products: PackedProducts | None
    note: str = ""
    changed: tuple[str, ...] = ()

    @property
    def failed(self) -> bool:
        """Whether the case did not come to its end this time, although the stored row says that it did."""
        stored = self.stored
        return self.row["outcome"] in UNFINISHED and stored is not None and stored["outcome"] not in UNFINISHED


def replay(directory: Path, case: int) -> Replay:
    """Runs one case of a stored campaign again, in a worker as the campaign does.

    Raises
    ------
    CampaignError
        Where the folder holds no campaign, the campaign has no such case, or its scenario or an algorithm cannot be
        imported; no case is run then.
    """
    configuration = stored_configuration(directory)
    if not 0 <= case < configuration.total_cases:
        raise CampaignError(f"{directory} has no case {case}; allowed: 0 to {configuration.total_cases - 1}")
    loaded_campaign(directory, configuration)
    stored = stored_row(directory, case)
    identity = read(directory).get("identity")
    changed = Identity.read(identity).differences(identity_of(configuration)) if identity else []
    with LocalWorkers(1) as workers:
        return replay_with(workers, configuration, case, stored, tuple(changed))


def replay_with(
    workers: Workers, configuration: CampaignConfiguration, case: int, stored: Row | None, changed: tuple[str, ...] = ()
) -> Replay:
    """Runs one case again in workers that are there, and compares it with a row."""
    ((completed,),) = run_cases(workers, configuration, [case], keep=KEEP_ALL)
    differing = differing_columns(completed.row, stored) if stored is not None else ()
    return Replay(case, completed.row, stored, differing, completed.products, completed.note, changed)


def differing_columns(row: Row, other: Row) -> tuple[str, ...]:
    """Columns in which two rows differ: bit for bit, NaN equal to NaN and to nothing, times aside.

    Where a case did not come to its end its traceback is left aside: a process that is ended does not stand at the same
    place twice.
    """
    aside = {"traceback"} if row.get("outcome") in UNFINISHED else set()
    names = [name for name in dict.fromkeys((*row, *other)) if "time" not in name and name not in aside]
    return tuple(name for name in names if not _same(row.get(name), other.get(name)))


def _same(value: Any, other: Any) -> bool:
    """Whether two values are the same; a missing number is a NaN."""
    if _absent(value) or _absent(other):
        return _absent(value) and _absent(other)
    return bool(value == other)


def _absent(value: Any) -> bool:
    return value is None or value != value
