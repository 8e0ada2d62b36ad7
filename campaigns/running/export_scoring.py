"""Offline campaigns: cases are exported to another team without their ground truth, and the team's answers are scored.

The export and the scoring are campaigns. The rows of the export campaign contain the ground truth and are stored in a
separate folder. The scoring campaign runs the same cases again, with a table of answers instead of an algorithm.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import CampaignDefinition, Retain
from marsyard.campaigns.definition.identity import definition_hash
from marsyard.campaigns.definition.parameter_paths import replace_value
from marsyard.campaigns.errors import CampaignError, StoreError, report_write_errors
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.running.engine import resume_campaign, run_campaign
from marsyard.campaigns.running.progress import ProgressObserver
from marsyard.campaigns.running.stored_campaign import load_stored_campaign
from marsyard.campaigns.store import record
from marsyard.campaigns.store.table import TABLE_FILE, read_rows
from marsyard.scenarios.interface import HasAlgorithms
from marsyard.scenarios.offline_algorithms import ANSWERS, CASES, read_answers
from marsyard.scenarios.tasks import Task

#: Files that describe an exported folder, for programs and for the team under test.
MANIFEST_FILE, README_FILE = "export.json", "README.md"
#: Version of the layout of the manifest.
SCHEMA = 1
#: Maximum number of cases in a message.
_MAX_LISTED = 8


def truth_folder(directory: Path) -> Path:
    """Return the default folder of the ground truth, next to the exported folder."""
    return directory.with_name(f"{directory.name}-truth")


def export_campaign(
    campaign: Campaign, directory: Path, truth: Path, executor: ExecutorConfig, observer: ProgressObserver
) -> None:
    """Export a campaign's cases, or continue an interrupted export of the same campaign.

    - campaign: its algorithm is `export:` with the path of the exported folder
    - directory, truth: exported folder, and folder of the campaign's rows with the ground truth

    Raises CampaignError if the folders contain other files, or are not writable.
    """
    if truth.resolve().is_relative_to(directory.resolve()):
        raise CampaignError(f"--truth {truth}: is inside {directory}, which the team under test receives")
    if (truth / record.RECORD_FILE).is_file():
        stored = record.stored_definition(truth)
        if definition_hash(stored) != definition_hash(campaign.definition):
            raise StoreError(f"{truth} contains the truth of another export; choose other folders")
        resume_campaign(truth, executor, observer)
    else:
        if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
            raise StoreError(f"{directory} already exists and is not empty; choose a new folder with --out")
        run_campaign(campaign, truth, executor, observer)
    _write_manifest(campaign, directory)


def _write_manifest(campaign: Campaign, directory: Path) -> None:
    """Write the manifest and the README of an exported folder."""
    task, name, cases = _find_task(campaign), campaign.definition.name, campaign.definition.total_cases
    answer_format = task.offline
    columns = () if answer_format is None else answer_format.columns
    has_one_line = answer_format is None or answer_format.join is None
    lines = "one line for each case" if has_one_line else "the lines of each case in order"
    refusal = "A case without an answer has an\noutcome and no numbers; outcomes" if has_one_line else "Outcomes"
    outcomes = ", ".join(answer_format.form.outcomes.__members__) if answer_format else ""
    manifest = {"schema": SCHEMA, "campaign": name, "task": task.name, "cases": cases, "columns": list(columns)}
    text = f"""# {cases} cases of {name}

Each folder of `{CASES}/` is one case (task: {task.name}): `case.json`, 16-bit images and
cameras, in the format of docs/custom-algorithms.md. The folder contains no ground truth.

Answer with a comma-separated table: a header line with these columns, then {lines}:

    {",".join(columns)}

`case` is the number of the folder. The suffix of a column's name is its unit. {refusal}: {outcomes}.
"""
    if answer_format and answer_format.note:
        text += f"{answer_format.note}\n"
    with report_write_errors(directory):
        (directory / MANIFEST_FILE).write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")
        (directory / README_FILE).write_text(text, encoding="utf-8")


def create_scoring_campaign(directory: Path, truth: Path, answers: Path) -> Campaign:
    """Create the campaign that scores the answers in a table: the exported campaign with the table as its algorithm.

    Raises CampaignError if the folders contain no finished export, or the table does not answer each case once.
    """
    path = directory / MANIFEST_FILE
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
        if manifest["schema"] != SCHEMA:
            raise ValueError(f"has schema {manifest['schema']}; this version of Marsyard reads {SCHEMA}")
        export_identity = str(manifest["campaign"]), int(manifest["cases"])
    except OSError as error:
        reason = f"{path.name}: {error.strerror or error}"
        raise StoreError(f"{directory} contains no finished export: {reason}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise StoreError(f"{path} is damaged: {error}") from error
    stored = record.stored_definition(truth)
    if record.read(truth)["state"] != "finished":
        raise CampaignError(f"{truth} is not finished: export again to continue")
    if export_identity != (stored.name, stored.total_cases):
        raise CampaignError(f"{directory} and {truth} belong to different exports")
    export = load_stored_campaign(truth, stored)
    _check_answers(_find_task(export), stored, answers)
    table = export.scenario.algorithm_table if isinstance(export.scenario, HasAlgorithms) else ()
    parameters = replace_value(stored.parameters, [*table, "algorithm"], f"{ANSWERS}{answers.resolve()}")
    scoring = stored.model_copy(update={"parameters": parameters, "retain": Retain()})
    return Campaign(CampaignDefinition.model_validate(scoring.model_dump()), export.scenario)


def _check_answers(task: Task[Any, Any], definition: CampaignDefinition, answers: Path) -> None:
    """Raise CampaignError unless the table answers each case of the export once."""
    if task.offline is None:
        raise CampaignError(f"{definition.name} cannot be answered in a table")
    try:
        answers_by_case = read_answers(answers, task.offline)
    except ValueError as error:
        raise CampaignError(str(error)) from error
    total = definition.total_cases
    unknown_cases = sorted(case for case in answers_by_case if case >= total)
    if unknown_cases:
        raise CampaignError(f"{answers}: unknown case {_list_first(unknown_cases)}; allowed: 0 to {total - 1}")
    missing_cases = [case for case in range(total) if case not in answers_by_case]
    if missing_cases:
        _, refusal, *_ = task.offline.form.outcomes.__members__  # the first outcome is that of an answer
        advice = f"a case without an answer needs a line with its outcome, such as {refusal}"
        raise CampaignError(
            f"{answers}: no answer to {len(missing_cases)} of {total} cases: {_list_first(missing_cases)}; {advice}"
        )


def _list_first(cases: Sequence[int]) -> str:
    """Format the first case numbers."""
    return ", ".join(map(str, cases[:_MAX_LISTED])) + (", ..." if len(cases) > _MAX_LISTED else "")


def _find_task(campaign: Campaign) -> Task[Any, Any]:
    """Return the task of a campaign's algorithms. Raises CampaignError if the scenario has none."""
    if not isinstance(campaign.scenario, HasAlgorithms):
        raise CampaignError(f"the scenario of {campaign.definition.name} has no selectable algorithms")
    return campaign.scenario.task


def find_cases_with_changed_images(truth: Path, scored: Path) -> list[int]:
    """Return the cases whose images differ between export and scoring."""
    exported_hashes = {row["case"]: row.get("image_hash") for row in read_rows(truth / TABLE_FILE)}
    rows = read_rows(scored / TABLE_FILE)
    return [int(row["case"]) for row in rows if row.get("image_hash") != exported_hashes.get(row["case"])]
