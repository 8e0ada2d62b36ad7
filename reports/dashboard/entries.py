"""Stored campaigns as the dashboard lists them: read from their records and the twins of their reports."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marsyard.campaigns.errors import CampaignError
from marsyard.reports.campaign import SCHEMA, TWIN_FILE, write_report
from marsyard.reports.stored import RECORD_FILE, TABLE_FILE, table
from marsyard.reports.traceability import Algorithm, algorithms_of, judged_text
from marsyard.scenarios.systems import system_of

#: How deep below a folder campaigns are looked for.
_DEPTH = 3


@dataclass(frozen=True)
class Shown:
    """One requirement as a campaign shows it."""

    requirement: str
    statement: str
    status: str
    estimate: float
    lower: float
    probability: float
    margin: float
    n: int
    failures: int
    confidence: float
    decide_by: str
    note: str


@dataclass(frozen=True)
class Entry:
    """A stored campaign.

    Attributes
    ----------
    slug
        Its folder's name in the site: letters, digits, dots and hyphens, told apart by a hash of where it was.
    directory
        Where it is stored.
    name, system, sites, algorithms, commit, started, state, cases, crashed, verdict, sentence
        As its record and its report have it; empty where they do not say.
    tested
        The algorithms under test with their versions, options and sources, the judged one first.
    shown
        What it shows of each requirement.
    kept, worst
        Cases whose products are kept, and those with the largest errors.
    """

    slug: str
    directory: Path
    name: str
    system: str
    sites: tuple[str, ...]
    algorithms: tuple[str, ...]
    tested: tuple[Algorithm, ...]
    commit: str
    started: str
    state: str
    cases: int
    crashed: int
    verdict: str
    sentence: str
    shown: tuple[Shown, ...]
    kept: tuple[int, ...]
    worst: tuple[str, ...]
    outcomes: Mapping[str, int]

    @property
    def judged(self) -> str:
        """Names and versions of the algorithms that are judged; as the rows name them where the record does not."""
        return judged_text(self.tested) or ", ".join(self.algorithms)

    @property
    def finished(self) -> bool:
        """Whether it came to its end: what is interrupted shows but a part."""
        return self.state == "finished"


def find_campaigns(directories: Sequence[Path]) -> list[Path]:
    """The campaigns in folders: those that are one, and those below them, each once, in order of their paths."""
    found: dict[Path, Path] = {}
    for directory in directories:
        for one in _below(directory, _DEPTH):
            found.setdefault(one.resolve(), one)
    return sorted(found.values())


def _below(directory: Path, depth: int) -> Iterator[Path]:
    if (directory / RECORD_FILE).is_file() and (directory / TABLE_FILE).is_file():
        yield directory
    elif depth and directory.is_dir():
        for inner in sorted(directory.iterdir()):
            if inner.is_dir() and not inner.is_symlink():
                yield from _below(inner, depth - 1)


def read_entries(paths: Iterable[Path]) -> tuple[list[Entry], list[str]]:
    """The campaigns, the latest first, and what is wrong with those that cannot be shown.

    A report that is missing, older than the rows, or of another layout is written anew.
    """
    entries, problems = [], []
    for path in paths:
        try:
            entries.append(_entry(path, _twin(path)))
        except (CampaignError, OSError, ValueError, KeyError, TypeError) as error:
            problems.append(f"{path}: {error}")
    return sorted(entries, key=lambda one: (one.started, one.name, one.slug), reverse=True), problems


def _twin(path: Path) -> Mapping[str, Any]:
    file = path / TWIN_FILE
    try:
        twin = table(json.loads(file.read_text(encoding="utf-8")))
        if twin.get("schema") == SCHEMA and file.stat().st_mtime >= (path / TABLE_FILE).stat().st_mtime:
            return twin
    except (OSError, ValueError):
        pass
    write_report(path)
    return table(json.loads(file.read_text(encoding="utf-8")))


def _entry(path: Path, twin: Mapping[str, Any]) -> Entry:
    record = table(json.loads((path / RECORD_FILE).read_text(encoding="utf-8")))
    parameters = table(table(record.get("configuration")).get("parameters"))
    system = system_of(str(table(record.get("configuration")).get("scenario")))
    name = str(twin.get("campaign") or path.name)
    return Entry(
        slug=slug_of(path, name),
        directory=path,
        name=name,
        system="other" if system is None else system.name,
        sites=_named(twin, "sites", parameters, "site"),
        algorithms=_named(twin, "algorithms", parameters, "algorithm"),
        tested=tuple(algorithms_of(record)),
        commit=str(twin.get("git_commit") or "")[:10],
        started=str(twin.get("started_utc") or ""),
        state=str(twin.get("state") or ""),
        cases=int(twin.get("cases") or 0),
        crashed=int(twin.get("crashed") or 0),
        verdict=str(twin.get("verdict") or ""),
        sentence=str(twin.get("sentence") or ""),
        shown=tuple(_shown(table(one)) for one in twin.get("verdicts") or ()),
        kept=tuple(int(case) for case in twin.get("showcases") or ()),
        worst=tuple(str(case) for case in twin.get("worst_cases") or ()),
        outcomes={str(key): int(value) for key, value in table(twin.get("outcomes")).items()},
    )


def _shown(verdict: Mapping[str, Any]) -> Shown:
    return Shown(
        requirement=str(verdict.get("requirement_id") or "?"),
        statement=str(verdict.get("statement") or ""),
        status=str(verdict.get("status") or ""),
        estimate=_number(verdict.get("estimate")),
        lower=_number(verdict.get("lower")),
        probability=_number(verdict.get("probability")),
        margin=_number(verdict.get("margin")),
        n=int(verdict.get("n") or 0),
        failures=int(verdict.get("failures") or 0),
        confidence=_number(verdict.get("confidence")),
        decide_by=str(verdict.get("decide_by") or ""),
        note=str(verdict.get("note") or ""),
    )


def slug_of(path: Path, name: str) -> str:
    """A folder's name that no other campaign has and that cannot lead out of the site."""
    plain = re.sub(r"[^A-Za-z0-9-]+", "-", name)[:60].strip("-") or "campaign"
    return f"{plain}-{hashlib.sha256(str(path.resolve()).encode('utf-8', 'replace')).hexdigest()[:10]}"


def _named(twin: Mapping[str, Any], key: str, parameters: Mapping[str, Any], stated: str) -> tuple[str, ...]:
    """What the rows name, or the parameters where the rows name none."""
    found = tuple(str(one) for one in twin.get(key) or () if str(one))
    one = _first(parameters, stated)
    return found or ((one,) if one else ())


def _first(parameters: Mapping[str, Any], key: str) -> str:
    """The first text found under a key at any depth of nested tables; empty where there is none."""
    for name, value in parameters.items():
        if name == key and isinstance(value, str):
            return value
        inner = _first(value, key) if isinstance(value, Mapping) else ""
        if inner:
            return inner
    return ""


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
