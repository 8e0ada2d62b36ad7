"""Stored campaigns loaded again, and single cases of them run again and compared with their stored rows."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.configuration import CampaignConfiguration, key_text, problems_of
from marsyard.campaigns.definition.identity import Identity, identity_of
from marsyard.campaigns.errors import CampaignError, ConfigurationError, Problem
from marsyard.campaigns.execution.cases import run_cases
from marsyard.campaigns.execution.work import Executor
from marsyard.campaigns.execution.workers import LocalExecutor
from marsyard.campaigns.outcomes import UNFINISHED
from marsyard.campaigns.store.products import PackedProducts
from marsyard.campaigns.store.record import read, stored_configuration
from marsyard.campaigns.store.retention import KEEP_ALL
from marsyard.campaigns.store.rows import Row
from marsyard.campaigns.store.table import stored_row
from marsyard.scenarios.registry import UnknownScenarioError, scenario


@dataclass(frozen=True)
class Replay:
    """A case that was run again.

    row, stored: its row now, and as stored (None if it has none yet).
    differing: columns in which the two differ, except those with `time` in their name.
    products: products for figures; None where the scenario returned none, or none that can be stored.
    note: why there are none; empty where nothing is wrong.
    changed: differences in configuration, code and package versions from the stored campaign.
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
        """Whether the case is unfinished now, although its stored row is finished."""
        stored = self.stored
        return self.row["outcome"] in UNFINISHED and stored is not None and stored["outcome"] not in UNFINISHED


def replay(directory: Path, case: int) -> Replay:
    """Run one case of a stored campaign again, in a worker process.

    Raises CampaignError where the folder holds no campaign, the case does not exist, or the scenario or an algorithm
    cannot be imported; no case is run then.
    """
    configuration = stored_configuration(directory)
    if not 0 <= case < configuration.total_cases:
        raise CampaignError(f"{directory} has no case {case}; allowed: 0 to {configuration.total_cases - 1}")
    load_stored_campaign(directory, configuration)
    stored = stored_row(directory, case)
    identity = read(directory).get("identity")
    changed = Identity.read(identity).differences(identity_of(configuration)) if identity else []
    with LocalExecutor(1) as workers:
        return replay_with(workers, configuration, case, stored, tuple(changed))


def replay_with(
    executor: Executor,
    configuration: CampaignConfiguration,
    case: int,
    stored: Row | None,
    changed: tuple[str, ...] = (),
) -> Replay:
    """Run one case again in given workers, and compare it with a row."""
    ((completed,),) = run_cases(executor, configuration, [case], keep=KEEP_ALL)
    differing = differing_columns(completed.row, stored) if stored is not None else ()
    return Replay(case, completed.row, stored, differing, completed.products, completed.note, changed)


def differing_columns(row: Row, other: Row) -> tuple[str, ...]:
    """Columns in which two rows differ bit for bit, except times; a missing number equals NaN.

    The traceback of an unfinished case is not compared: a process is not ended at the same instruction twice.
    """
    excluded = {"traceback"} if row.get("outcome") in UNFINISHED else set()
    names = [name for name in dict.fromkeys((*row, *other)) if "time" not in name and name not in excluded]
    return tuple(name for name in names if not _is_same(row.get(name), other.get(name)))


def _is_same(value: Any, other: Any) -> bool:
    if _is_missing(value) or _is_missing(other):
        return _is_missing(value) and _is_missing(other)
    return bool(value == other)


def _is_missing(value: Any) -> bool:
    return value is None or value != value


def load_stored_campaign(directory: Path, configuration: CampaignConfiguration) -> Campaign:
    """Campaign of a stored configuration, with its scenario and algorithms imported.

    Raises ConfigurationError where the scenario or an algorithm cannot be imported, or a parameter is not accepted.
    """
    try:
        campaign = Campaign(configuration, scenario(configuration.scenario))
    except UnknownScenarioError as error:
        raise _refusal(directory, [("scenario", str(error))]) from error
    try:
        campaign.base_parameters()
    except ValidationError as error:
        found = problems_of(error, campaign.scenario.parameters_type)
        raise _refusal(directory, [(key_text(("parameters", *key)), message) for key, message in found]) from error
    return campaign


def _refusal(directory: Path, problems: list[tuple[str, str]]) -> ConfigurationError:
    hint = "modules of your own are searched for in the current folder: start the command where the campaign was run"
    stated = [Problem(str(directory), key, message) for key, message in problems]
    return ConfigurationError([*stated, Problem(str(directory), "", f"nothing was run or changed; {hint}")])
