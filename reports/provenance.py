"""Where the results of a campaign come from: its algorithms, facts and versions, and the commands that repeat it."""

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from marsyard.campaigns.hidden_folders import hide_folders
from marsyard.reports.column_values import numbers
from marsyard.reports.sampling_design import read_sampling_design
from marsyard.reports.stored import StoredRun, table
from marsyard.reports.wording import format_value, number


@dataclass(frozen=True)
class Algorithm:
    """An algorithm of a campaign; text that is missing from the record is empty.

    - name: name in the campaign: a built-in algorithm, `module:Class`, or a program
    - tested: whether the algorithm is under test; False if it is only compared
    - path: class of the algorithm as `module:name`, or its file
    - version: version of the installed distribution, or attribute `version` of the algorithm
    """

    name: str
    tested: bool = True
    path: str = ""
    version: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    source_hash: str = ""

    @property
    def title(self) -> str:
        """Name and version."""
        return f"{self.name} {self.version}".strip()

    @property
    def options_text(self) -> str:
        """The options as JSON; empty for no options."""
        return json.dumps(self.options, ensure_ascii=False) if self.options else ""


def read_algorithms(record: Mapping[str, Any]) -> list[Algorithm]:
    """Read the algorithms from a campaign's record, the algorithm under test first."""
    stored_list = record.get("algorithms")
    entries = [table(entry) for entry in stored_list] if isinstance(stored_list, list) else []
    algorithms = [
        Algorithm(
            name=str(entry["spec"]),
            tested=entry.get("role") != "compared",
            path=str(entry.get("path") or ""),
            version=str(entry.get("version") or ""),
            options=table(entry.get("options")),
            source_hash=str(entry.get("source_hash") or ""),
        )
        for entry in entries
        if entry.get("spec")
    ]
    return sorted(algorithms, key=lambda algorithm: not algorithm.tested)


def format_tested_algorithms(algorithms: Sequence[Algorithm]) -> str:
    """Format names and versions of the algorithms under test."""
    return ", ".join(algorithm.title for algorithm in algorithms if algorithm.tested)


#: Machine properties whose names in the record are not words.
_FACT_NAMES = {
    "processor_features": "processor features (hash)",
    "implementation": "Python implementation",
    "machine": "architecture",
}


def list_provenance(run: StoredRun) -> list[tuple[str, str]]:
    """List name and value of properties of campaign, algorithms, program and machine."""
    environment, times = table(run.recorded("environment")), numbers(run.frame, "cpu_time_s")
    times = times[np.isfinite(times)]
    algorithms: list[tuple[str, Any]] = []
    for item in read_algorithms(run.record):
        title = "Algorithm under test" if item.tested else "Algorithm compared"
        algorithms += [(title, item.name), (f"{title}: class or file", item.path), (f"{title}: version", item.version)]
        algorithms += [(f"{title}: source hash", item.source_hash), (f"{title}: options", item.options_text)]
    facts = [
        ("Campaign", run.name),
        ("Scenario", run.recorded("scenario")),
        *algorithms,
        ("State", run.recorded("state")),
        ("Root seed", run.recorded("seed")),
        ("Sampling", read_sampling_design(run.definition).text),
        ("Cases requested", run.recorded("cases")),
        ("Cases stored", len(run.all_cases)),
        ("Started", run.recorded("started_utc")),
        ("Finished", run.recorded("finished_utc")),
        ("Worker processes", run.recorded("jobs")),
        ("CPU time per case", f"{number(float(times.mean()))} s on average" if times.size else None),
        ("Commit", run.recorded("git_commit")),
        ("Marsyard", table(run.recorded("versions")).get("marsyard")),
        *(
            (f"Machine: {_FACT_NAMES.get(name, name)}", value)
            for name, value in environment.items()
            if name in _FACT_NAMES or isinstance(value, str)
        ),
        ("GL backend", _distinct_values(run.frame, "gl_backend")),
        ("GL version", _distinct_values(run.frame, "gl_version")),
    ]
    return [(name, format_value(value)) for name, value in facts if value not in (None, "")]


def _distinct_values(frame: pd.DataFrame, column: str) -> str | None:
    return None if column not in frame else "; ".join(str(value) for value in frame[column].dropna().unique()[:3])


def replay_command(run: StoredRun, case: str) -> str:
    """Return the command that runs a stored case again."""
    return shlex.join(["marsyard", "replay", str(run.directory), case])


def rerun_commands(run: StoredRun) -> list[str]:
    """Return shell commands that run the campaign again in a new folder, with a command for each appended block.

    A campaign that Python code ran has no command; it is built from name, cases and seed.
    """
    if run.command is None:
        words = ["marsyard", "run", run.name]
        for option, key in (("-n", "cases"), ("--seed", "seed")):
            if run.recorded(key) is not None:
                words += [option, str(run.recorded(key))]
        return [shlex.join(words)]
    stored_folder, stored_words = run.command
    folder, words = hide_folders(stored_folder), list(stored_words)
    stored_blocks = run.definition.get("appended")
    # a sequential campaign appends blocks of cases without a command
    block_sizes = [] if run.recorded("max_cases") or not isinstance(stored_blocks, list | tuple) else stored_blocks
    target = f"runs/{run.name}-again"
    if block_sizes:
        words += ["--out", target]
    append_commands = [shlex.join(["marsyard", "append", target, str(cases)]) for cases in block_sizes]
    first, separator, rest = folder.partition("/")
    # the shell expands ~ only without quotes
    path = first + separator + (shlex.quote(rest) if rest else "") if first == "~" else shlex.quote(folder)
    return [*([f"cd {path}"] if folder else []), shlex.join(words), *append_commands]
