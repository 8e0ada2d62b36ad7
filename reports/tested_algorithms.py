"""Algorithms of a stored campaign."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from marsyard.reports.stored import table


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
