"""Record `campaign.json` of a campaign's folder (definition, program, machine, progress)."""

import json
import os
import platform
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from marsyard.campaigns.definition.campaign_file import CampaignDefinition
from marsyard.campaigns.definition.identity import Identity
from marsyard.campaigns.errors import StoreError, report_write_errors
from marsyard.campaigns.hidden_folders import hide_folders
from marsyard.campaigns.store.git_history import git_commit
from marsyard.campaigns.store.rows import ROWS_FILE, is_empty_store
from marsyard.campaigns.store.temporary_files import replace_file
from marsyard.sim.kernel_cache import processor_features

#: Version of the layout of a campaign's folder.
SCHEMA = 1
RECORD_FILE = "campaign.json"
#: JSON types of the keys of a record that commands read.
_KEY_TYPES: Mapping[str, tuple[type, str]] = {
    **dict.fromkeys(("name", "state"), (str, "a text")),
    **dict.fromkeys(("cases", "cases_finished", "cases_crashed"), (int, "a whole number")),
    **dict.fromkeys(("requirements", "sessions", "changes"), (list, "a list")),
    **dict.fromkeys(("definition", "identity", "environment"), (dict, "a table")),
}


def reject_links(directory: Path) -> None:
    """Raise StoreError if a campaign's folder contains a symbolic link, which could point to files of its reader."""
    folders = [str(directory)]
    while folders:
        # another process can remove a temporary folder
        with suppress(FileNotFoundError), os.scandir(folders.pop()) as entries:
            for entry in entries:
                if entry.is_symlink():
                    raise StoreError(f"{entry.path} is a symbolic link; a campaign's folder must contain its own files")
                if entry.is_dir():
                    folders.append(entry.path)


def utc_now() -> str:
    """Return the current time in ISO 8601 with a resolution of one second."""
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def write_first_record(
    directory: Path,
    definition: CampaignDefinition,
    identity: Identity,
    executor: str,
    *,
    command: Sequence[str] = (),
    algorithms: Sequence[Mapping[str, Any]] = (),
    evidence: Mapping[str, Any] | None = None,
    origin: Mapping[str, Any],
) -> None:
    """Write the record of a new campaign.

    - executor: description of the workers
    - command: words of the command that repeats the campaign in the current folder
    - algorithms: see `marsyard.campaigns.definition.algorithm_descriptions.describe_algorithms`
    - evidence: see `marsyard.campaigns.definition.evidence.Evidence`
    - origin: see `marsyard.campaigns.store.origin`
    """
    contents = definition.model_dump(mode="json")
    write(
        directory,
        {
            "schema": SCHEMA,
            "name": definition.name,
            "state": "running",
            "exit_code": None,
            "started_utc": utc_now(),
            "finished_utc": None,
            "cases": definition.total_cases,
            "cases_finished": 0,
            "cases_crashed": 0,
            "seed": definition.seed,
            "requirements": contents["requirements"],
            "definition": contents,
            "identity": asdict(identity),
            "command": {"words": [*map(hide_folders, command)], "folder": hide_folders(str(Path.cwd()))}
            if command
            else None,
            "algorithms": list(algorithms),
            "evidence": None if evidence is None else dict(evidence),
            "origin": dict(origin),
            "sessions": [describe_session("run", executor, 0)],
            "changes": [],
            "showcase": None,
            "versions": dict(identity.versions),
            "git_commit": git_commit(),
            "environment": describe_machine(),
        },
    )


def describe_session(command: str, executor: str, cases_before: int) -> dict[str, Any]:
    """Create the record's entry of one session (run, resume or append) of a campaign."""
    return {
        "command": command,
        "started_utc": utc_now(),
        "workers": executor,
        "cases_before": cases_before,
        "environment": describe_machine(),
    }


def describe_machine() -> dict[str, Any]:
    """Describe Python, platform and processor (with a hash of its features).

    Machines with equal descriptions compute bit-identical rows.
    """
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        text = ""
    model = re.search(r"^(?:model name|CPU part)\s*:\s*(.*)$", text, re.MULTILINE)
    return {
        "python": platform.python_version(),
        "implementation": platform.python_implementation(),
        "platform": platform.platform(),
        "machine": platform.machine(),
        "processor": model[1] if model else platform.processor(),
        "processor_features": processor_features(),
    }


def update(directory: Path, changes: Mapping[str, Any]) -> None:
    """Change keys of a campaign's record atomically."""
    write(directory, {**read(directory), **changes})


def write(directory: Path, record: Mapping[str, Any]) -> None:
    """Write a campaign's record atomically.

    Raises StoreError on failure; the previous record then remains.
    """
    path = directory / RECORD_FILE
    with report_write_errors(path), replace_file(path) as partial, partial.open("w", encoding="utf-8") as file:
        file.write(json.dumps(record, indent=2, ensure_ascii=False) + "\n")
        file.flush()
        os.fsync(file.fileno())


def read(directory: Path) -> dict[str, Any]:
    """Read a campaign's record.

    Raises StoreError if the folder contains no record or a symbolic link, or if the record has another version, missing
    keys, or values of another JSON type.
    """
    path = directory / RECORD_FILE
    if not directory.is_dir():
        raise StoreError(f"{directory}: no such folder")
    reject_links(directory)
    if not path.is_file():
        hint = ""
        if (directory / ROWS_FILE).is_file() and is_empty_store(directory / ROWS_FILE):
            hint = "; a run was stopped before its first case: start it again with --out of this folder"
        raise StoreError(f"{directory} does not contain a campaign: it has no {RECORD_FILE}{hint}")
    try:
        record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        schema = record["schema"]
    except OSError as error:
        raise StoreError(f"{path} cannot be read: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise StoreError(f"{path} is damaged: {error}") from error
    if schema != SCHEMA:
        raise StoreError(f"{path} has schema {schema}; this version of Marsyard reads {SCHEMA}")
    problems = [f"it has no {key}" for key in _KEY_TYPES if key not in record]
    for key, (kind, type_text) in _KEY_TYPES.items():
        if key in record and (not isinstance(record[key], kind) or isinstance(record[key], bool)):
            problems.append(f"{key} is not {type_text}")
    if not problems:
        identity, sessions = record["identity"], record["sessions"]
        has_tables = all(isinstance(identity.get(key), dict) for key in ("versions", "inputs"))
        if not has_tables or not {"definition", "code"} <= set(identity):
            problems.append("identity has no definition, code, versions or inputs")
        if not sessions or not isinstance(sessions[-1], dict):
            problems.append("sessions is empty")
    if problems:
        raise StoreError(f"{path} is damaged: {problems[0]}")
    return record


def stored_definition(directory: Path) -> CampaignDefinition:
    """Read the definition of a stored campaign. Raises StoreError if the record is missing or damaged."""
    try:
        return CampaignDefinition.model_validate(read(directory)["definition"])
    except (ValueError, KeyError) as error:
        raise StoreError(f"{directory / RECORD_FILE} is damaged: {error}") from error
