"""Stored campaigns loaded again, and single cases of them run again and compared with their stored rows."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.configuration import CampaignConfiguration, key_text, problems_of
from marsyard.campaigns.definition.identity import Identity, identity_of
from marsyard.campaigns.errors import CampaignError, ConfigurationError, Problem
from marsyard.campaigns.execution.cases import run_cases
from marsyard.campaigns.execution.worker_process import Executor
from marsyard.campaigns.execution.workers import LocalExecutor
from marsyard.campaigns.outcomes import UNFINISHED
from marsyard.campaigns.store.products import KEEP_ALL, PackedProducts
from marsyard.campaigns.store.record import read, stored_configuration
from marsyard.campaigns.store.rows import Row
from marsyard.campaigns.store.table import stored_row
from marsyard.scenarios.systems import UnknownScenarioError, scenario


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
    differing = []
    for name in dict.fromkeys((*row, *other)):
        # NaN differs from itself
        values = [None if one is None or one != one else one for one in (row.get(name), other.get(name))]
        if "time" not in name and name not in excluded and values[0] != values[1]:
            differing.append(name)
    return tuple(differing)


def load_stored_campaign(directory: Path, configuration: CampaignConfiguration) -> Campaign:
    """Campaign of a stored configuration, with its scenario and algorithms imported.

    Raises ConfigurationError where the scenario or an algorithm cannot be imported, or a parameter is not accepted.
    """
    try:
        campaign = Campaign(configuration, scenario(configuration.scenario))
        campaign.base_parameters()
    except (UnknownScenarioError, ValidationError) as error:
        problems = [("scenario", str(error))]
        if isinstance(error, ValidationError):
            found = problems_of(error, campaign.scenario.parameters_type)
            problems = [(key_text(("parameters", *key)), message) for key, message in found]
        hint = "modules of your own are searched for in the current folder"
        problems.append(("", f"nothing was run or changed; {hint}: start the command where the campaign was run"))
        raise ConfigurationError([Problem(str(directory), *problem) for problem in problems]) from error
    return campaign
