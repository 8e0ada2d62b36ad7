"""The algorithms that a stored campaign ran, as its record names them: what every report says of who was judged."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from marsyard.reports.stored import table


@dataclass(frozen=True)
class Algorithm:
    """An algorithm under test.

    Attributes
    ----------
    name
        As the campaign names it: a name that ships, `module:Class`, or a program.
    judged
        Whether requirements judge it, or it is only compared.
    path
        Its class as `module:name`, or its file; empty where the record does not say, as are the others.
    version
        Of its installed distribution, or its own `version` attribute.
    options
        Its options by name.
    source_hash
        A hash of its sources.
    """

    name: str
    judged: bool = True
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
        """The options as JSON; empty where there are none."""
        return json.dumps(self.options, ensure_ascii=False) if self.options else ""


def algorithms_of(record: Mapping[str, Any]) -> list[Algorithm]:
    """Read the algorithms from a campaign's record, the judged one first.

    Records of earlier versions have no table of algorithms: their parameters give the names alone.
    """
    stored = record.get("algorithms")
    entries = [table(one) for one in stored] if isinstance(stored, list) else []
    found = [_algorithm(entry) for entry in entries if entry.get("spec")]
    if not found:
        found = _named(table(table(record.get("configuration")).get("parameters")))
    return sorted(found, key=lambda one: not one.judged)


def judged_text(algorithms: Sequence[Algorithm]) -> str:
    """Names and versions of those that are judged."""
    return ", ".join(one.title for one in algorithms if one.judged)


def _algorithm(entry: Mapping[str, Any]) -> Algorithm:
    return Algorithm(
        name=str(entry["spec"]),
        judged=entry.get("role") != "compared",
        path=str(entry.get("path") or ""),
        version=str(entry.get("version") or ""),
        options=table(entry.get("options")),
        source_hash=str(entry.get("source_hash") or ""),
    )


def _named(parameters: Mapping[str, Any]) -> list[Algorithm]:
    """The algorithms that parameters choose: in the first table, at any depth, that has the key `algorithm`."""
    chosen = parameters.get("algorithm")
    if isinstance(chosen, str) and chosen:
        compared = parameters.get("compared")
        names = compared if isinstance(compared, list) else []
        return [Algorithm(chosen), *(Algorithm(str(name), judged=False) for name in names)]
    inner = (_named(value) for value in parameters.values() if isinstance(value, Mapping))
    return next((found for found in inner if found), [])
