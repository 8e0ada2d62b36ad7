"""Campaigns whose algorithm is run elsewhere: cases written down without their truth, and answers to them scored.

Both are campaigns as any other. The one that exports lies in the folder of the truth: its rows hold what is true of
each case, and make it known which cases are written. The one that scores runs the same cases again, with the answers
of a table in an algorithm's place.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marsyard.campaigns.definition.campaign import Campaign, replaced
from marsyard.campaigns.definition.configuration import CampaignConfiguration, Retain
from marsyard.campaigns.definition.identity import configuration_hash
from marsyard.campaigns.errors import CampaignError, StoreError, writing
from marsyard.campaigns.execution.crew import Crew
from marsyard.campaigns.running.engine import Watch, resume_campaign, run_campaign
from marsyard.campaigns.store import record
from marsyard.campaigns.store.table import TABLE_FILE, read_rows
from marsyard.scenarios.estimators import Task
from marsyard.scenarios.interface import TakesAlgorithms
from marsyard.scenarios.offline import ANSWERS, CASES, answers_of
from marsyard.scenarios.registry import scenario

#: What an exported folder says of itself, and to whoever answers.
MANIFEST_FILE, README_FILE = "export.json", "README.md"
SCHEMA = 1

#: Cases named in a message, at most.
_NAMED = 8


@dataclass(frozen=True)
class Exported:
    """Where cases are written, and where what is true of them."""

    directory: Path
    truth: Path


def truth_folder(directory: Path) -> Path:
    """Where the truth of an exported folder lies, if nobody says otherwise: beside it."""
    return directory.with_name(f"{directory.name}-truth")


def export_campaign(campaign: Campaign, exported: Exported, crew: Crew, watch: Watch) -> None:
    """Writes a campaign's cases down; goes on where an earlier export of the same campaign was interrupted.

    Parameters
    ----------
    campaign
        Its algorithm is `export:` and the folder.
    exported
        The folders, of which neither need be there.
    crew, watch
        Who does it, and who is told.

    Raises
    ------
    CampaignError
        Where the folders hold something else, or cannot be written.
    """
    _check_apart(exported)
    if (exported.truth / record.RECORD_FILE).is_file():
        stored = record.stored_configuration(exported.truth)
        if configuration_hash(stored) != configuration_hash(campaign.configuration):
            raise StoreError(f"{exported.truth} holds the truth of another export; choose other folders")
        resume_campaign(exported.truth, crew, watch)
    else:
        _check_empty(exported.directory)
        run_campaign(campaign, exported.truth, crew, watch)
    _write_manifest(campaign, exported.directory)


def _check_apart(exported: Exported) -> None:
    """Refuses to put the truth where it would be handed away."""
    if exported.truth.resolve().is_relative_to(exported.directory.resolve()):
        raise CampaignError(f"--truth {exported.truth}: lies within {exported.directory}, which is handed away")


def _check_empty(directory: Path) -> None:
    if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise StoreError(f"{directory} is there already, and is not empty; name a new folder with --out")


def _write_manifest(campaign: Campaign, directory: Path) -> None:
    form = _task(campaign).offline
    columns = () if form is None else form.columns
    told = {
        "schema": SCHEMA,
        "campaign": campaign.configuration.name,
        "task": _task(campaign).name,
        "cases": campaign.configuration.total_cases,
        "columns": list(columns),
    }
    text = "\n".join(
        [
            f"# {campaign.configuration.total_cases} cases of {campaign.configuration.name}",
            "",
            f"Each folder of `{CASES}/` is one case (task: {_task(campaign).name}): `case.json`, 16-bit pictures and",
            "cameras, in the exchange of docs/own-algorithms.md. Nothing here is the truth.",
            "",
            "Answer in a table with commas, one line for each case, with a first line of these columns:",
            "",
            f"    {','.join(columns)}",
            "",
            "`case` is the folder's number. Units are those that the names end with. A case without an answer has an",
            f"outcome and no numbers; outcomes: {', '.join(form.outcomes.__members__) if form else ''}.",
            *([form.note] if form and form.note else []),
            "",
        ]
    )
    with writing(directory):
        (directory / MANIFEST_FILE).write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")
        (directory / README_FILE).write_text(text, encoding="utf-8")


def scored_campaign(exported: Exported, answers: Path) -> Campaign:
    """The exported campaign with a table's answers in its algorithm's place.

    Raises
    ------
    CampaignError
        Where the folders hold no finished export, or the table does not answer each case once.
    """
    manifest = _manifest(exported.directory)
    stored = record.stored_configuration(exported.truth)
    if record.read(exported.truth)["state"] != "finished":
        raise CampaignError(f"{exported.truth} is not finished: export again to go on")
    if (manifest["campaign"], manifest["cases"]) != (stored.name, stored.total_cases):
        raise CampaignError(f"{exported.directory} and {exported.truth} belong to different exports")
    exporting = Campaign(stored, scenario(stored.scenario))
    _check_answers(exporting, answers)
    return _answered(exporting, answers)


def _manifest(directory: Path) -> dict[str, Any]:
    path = directory / MANIFEST_FILE
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        if told["schema"] != SCHEMA:
            raise ValueError(f"has schema {told['schema']}; this version of Marsyard reads {SCHEMA}")
        return {"campaign": str(told["campaign"]), "cases": int(told["cases"])}
    except OSError as error:
        raise StoreError(f"{directory} holds no finished export: {path.name}: {error.strerror or error}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise StoreError(f"{path} is damaged: {error}") from error


def _check_answers(campaign: Campaign, answers: Path) -> None:
    """Refuses a table that cannot be read, lacks cases or has too many."""
    form = _task(campaign).offline
    if form is None:
        raise CampaignError(f"{campaign.configuration.name} cannot be answered in a table")
    try:
        found = answers_of(answers, form)
    except ValueError as error:
        raise CampaignError(str(error)) from error
    total = campaign.configuration.total_cases
    unknown = sorted(case for case in found if case >= total)
    if unknown:
        raise CampaignError(f"{answers}: there is no case {_some(unknown)}; allowed: 0 to {total - 1}")
    missing = [case for case in range(total) if case not in found]
    if missing:
        failures = list(form.outcomes.__members__)[1:]
        raise CampaignError(
            f"{answers}: no answer to {len(missing)} of {total} cases: {_some(missing)}; "
            f"a case without one is stated with its outcome, such as {failures[0]}"
        )


def _some(cases: Sequence[int]) -> str:
    more = ", ..." if len(cases) > _NAMED else ""
    return ", ".join(str(case) for case in cases[:_NAMED]) + more


def _answered(campaign: Campaign, answers: Path) -> Campaign:
    configuration = campaign.configuration
    table = campaign.scenario.algorithm_table if isinstance(campaign.scenario, TakesAlgorithms) else ()
    parameters = replaced(configuration.parameters, [*table, "algorithm"], f"{ANSWERS}{answers.resolve()}")
    changed = configuration.model_copy(update={"parameters": parameters, "retain": Retain()})
    return Campaign(CampaignConfiguration.model_validate(changed.model_dump()), campaign.scenario)


def _task(campaign: Campaign) -> Task[Any, Any]:
    if not isinstance(campaign.scenario, TakesAlgorithms):
        raise CampaignError(f"the scenario of {campaign.configuration.name} has no choice of algorithms")
    return campaign.scenario.task


def other_pictures(truth: Path, scored: Path) -> list[int]:
    """Cases whose pictures were others when they were scored than when they were exported."""
    exported = {row["case"]: row.get("image_hash") for row in read_rows(truth / TABLE_FILE)}
    rows = read_rows(scored / TABLE_FILE)
    return [int(row["case"]) for row in rows if row.get("image_hash") != exported.get(row["case"])]
