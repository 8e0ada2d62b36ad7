"""Contents of the dashboard: stored campaigns, from their records and report data, and a table row per requirement."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marsyard.campaigns.definition.requirements import StatedRequirement
from marsyard.campaigns.errors import CampaignError
from marsyard.reports.campaign import SCHEMA, TWIN_FILE, write_report
from marsyard.reports.stored import RECORD_FILE, TABLE_FILE, table
from marsyard.reports.traceability import Algorithm, format_tested_algorithms, tested_algorithms
from marsyard.reports.verdicts import ESTIMATE
from marsyard.reports.wording import NOTHING, percent
from marsyard.scenarios.systems import find_system

#: Maximum depth of campaigns below a folder.
_DEPTH = 3


@dataclass(frozen=True)
class ShownRequirement:
    """Verdict of a campaign on one requirement."""

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
    """A stored campaign, from its record and its report; empty fields where these state nothing.

    slug: its folder's name in the site: letters, digits, dots and hyphens, with a hash of its path.
    tested: algorithms under test with versions, options and sources; those that are only compared follow.
    kept, worst: cases with kept products, and those with the largest errors.
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
    shown: tuple[ShownRequirement, ...]
    kept: tuple[int, ...]
    worst: tuple[str, ...]
    outcomes: Mapping[str, int]

    @property
    def tested_names(self) -> str:
        """Names and versions of the algorithm under test; names from the rows where the record states none."""
        return format_tested_algorithms(self.tested) or ", ".join(self.algorithms)

    @property
    def finished(self) -> bool:
        """Whether all cases have run."""
        return self.state == "finished"


def find_campaigns(directories: Sequence[Path]) -> list[Path]:
    """Campaigns in or below folders, each once, ordered by path."""
    reports: dict[Path, Path] = {}
    for one in (below for directory in directories for below in _below(directory, _DEPTH)):
        reports.setdefault(one.resolve(), one)
    return sorted(reports.values())


def _below(directory: Path, depth: int) -> Iterator[Path]:
    if (directory / RECORD_FILE).is_file() and (directory / TABLE_FILE).is_file():
        yield directory
    elif depth and directory.is_dir():
        for inner in sorted(directory.iterdir()):
            if inner.is_dir() and not inner.is_symlink():
                yield from _below(inner, depth - 1)


def read_entries(paths: Iterable[Path]) -> tuple[list[Entry], list[str]]:
    """Campaigns, the latest first, and the problems of those that cannot be shown.

    A report that is missing, older than the rows, or of another schema is written again.
    """
    entries, problems = [], []
    for path in paths:
        try:
            entries.append(_read_entry(path))
        except (CampaignError, OSError, ValueError, KeyError, TypeError) as error:
            problems.append(f"{path}: {error}")
    return sorted(entries, key=lambda one: (one.started, one.name, one.slug), reverse=True), problems


def _read_entry(path: Path) -> Entry:
    file, twin = path / TWIN_FILE, table(None)
    with suppress(OSError, ValueError):
        twin = table(json.loads(file.read_text(encoding="utf-8")))
    if twin.get("schema") != SCHEMA or file.stat().st_mtime < (path / TABLE_FILE).stat().st_mtime:
        write_report(path)
        twin = table(json.loads(file.read_text(encoding="utf-8")))
    record = table(json.loads((path / RECORD_FILE).read_text(encoding="utf-8")))
    parameters = table(table(record.get("configuration")).get("parameters"))
    system = find_system(str(table(record.get("configuration")).get("scenario")))
    name = str(twin.get("campaign") or path.name)
    return Entry(
        slug=make_slug(path, name),
        directory=path,
        name=name,
        system="other" if system is None else system.name,
        sites=_named(twin, "sites", parameters, "site"),
        algorithms=_named(twin, "algorithms", parameters, "algorithm"),
        tested=tuple(tested_algorithms(record)),
        commit=str(twin.get("git_commit") or "")[:10],
        started=str(twin.get("started_utc") or ""),
        state=str(twin.get("state") or ""),
        cases=int(twin.get("cases") or 0),
        crashed=int(twin.get("crashed") or 0),
        verdict=str(twin.get("verdict") or ""),
        sentence=str(twin.get("sentence") or ""),
        shown=tuple(_shown_requirement(table(one)) for one in twin.get("verdicts") or ()),
        kept=tuple(int(case) for case in twin.get("showcases") or ()),
        worst=tuple(str(case) for case in twin.get("worst_cases") or ()),
        outcomes={str(key): int(value) for key, value in table(twin.get("outcomes")).items()},
    )


def _shown_requirement(verdict: Mapping[str, Any]) -> ShownRequirement:
    values: dict[str, Any] = {
        name: str(verdict.get(name) or "") for name in ("statement", "status", "decide_by", "note")
    }
    for name in ("estimate", "lower", "probability", "margin", "confidence"):
        values[name] = _number(verdict.get(name))
    for name in ("n", "failures"):
        values[name] = int(verdict.get(name) or 0)
    return ShownRequirement(requirement=str(verdict.get("requirement_id") or "?"), **values)


def make_slug(path: Path, name: str) -> str:
    """Folder name that is unique and cannot lead out of the site."""
    plain = re.sub(r"[^A-Za-z0-9-]+", "-", name)[:60].strip("-") or "campaign"
    return f"{plain}-{hashlib.sha256(str(path.resolve()).encode('utf-8', 'replace')).hexdigest()[:10]}"


def _named(twin: Mapping[str, Any], key: str, parameters: Mapping[str, Any], stated: str) -> tuple[str, ...]:
    """Names in the rows, or that of the parameters where the rows have none."""
    names = tuple(str(one) for one in twin.get(key) or () if str(one))
    one = _first(parameters, stated)
    return names or ((one,) if one else ())


def _first(parameters: Mapping[str, Any], key: str) -> str:
    """First text under a key at any depth of nested tables; empty where there is none."""
    for name, value in parameters.items():
        if name == key and isinstance(value, str):
            return value
        inner = _first(value, key) if isinstance(value, Mapping) else ""
        if inner:
            return inner
    return ""


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan


#: Maximum number of further campaigns next to a requirement's verdict.
MAX_FURTHER_VERDICTS = 7
#: Maximum number of campaigns in a sparkline, and its size in pixels.
_TREND, _WIDTH, _HEIGHT = 24, 120.0, 26.0


@dataclass(frozen=True)
class Sparkline:
    """Observed rates over time, oldest first: points of the line, the last one, and the height of the required rate."""

    points: str
    last: tuple[float, float]
    asked: float
    text: str


@dataclass(frozen=True)
class Cell:
    """Verdict of a campaign on a requirement."""

    entry: Entry
    shown: ShownRequirement


@dataclass(frozen=True)
class RequirementRow:
    """A requirement, the latest verdict of each campaign, and the trend of the campaign that was evaluated last.

    `all_cells` are the verdicts of all campaigns, the latest first, unfinished campaigns last; `cells` the latest
    verdict of each campaign name.
    """

    requirement: str
    statement: str
    kind: str
    source: str
    cells: Sequence[Cell]
    all_cells: Sequence[Cell]
    trend: Sparkline | None

    @property
    def latest(self) -> Cell | None:
        """Verdict of the latest campaign, a finished one where there is any."""
        return self.cells[0] if self.cells else None


def requirement_rows(entries: Sequence[Entry], stated: Mapping[str, StatedRequirement]) -> list[RequirementRow]:
    """A row for every requirement that is stated or that a campaign verifies; the stated ones first."""
    cells: dict[str, list[Cell]] = {name: [] for name in stated}
    for entry in entries:
        for shown in entry.shown:
            cells.setdefault(shown.requirement, []).append(Cell(entry, shown))
    rows = []
    for name, listed in cells.items():
        found, requirement = sorted(listed, key=lambda cell: not cell.entry.finished), stated.get(name)
        latest: dict[str, Cell] = {}
        for cell in found:
            latest.setdefault(cell.entry.name, cell)
        ours = list(latest.values())
        same = [cell.shown for cell in found if cell.entry.name == ours[0].entry.name and cell.entry.finished]
        statement = requirement.statement if requirement else (ours[0].shown.statement if ours else "")
        kind, source = (requirement.kind or "", requirement.source) if requirement else ("", "")
        rows.append(RequirementRow(name, statement, kind, source, ours, found, sparkline(same[::-1])))
    return rows


def sparkline(shown: Sequence[ShownRequirement]) -> Sparkline | None:
    """Observed rates over time against the required rate; None for fewer than two campaigns."""
    finite = [one for one in shown if math.isfinite(one.estimate) and math.isfinite(one.probability)][-_TREND:]
    if len(finite) < 2:
        return None
    rates = [one.estimate for one in finite]
    low = min(*rates, *(one.probability for one in finite))
    low -= 0.15 * (1.0 - low) + 1e-9
    step = (_WIDTH - 8.0) / (len(finite) - 1)

    def height(rate: float) -> float:
        return round(3.0 + (_HEIGHT - 6.0) * (1.0 - rate) / (1.0 - low), 2)

    places = [(round(4.0 + step * k, 2), height(rate)) for k, rate in enumerate(rates)]
    text = f"{len(finite)} campaigns, rates {percent(rates[0])} to {percent(rates[-1])}"
    return Sparkline(" ".join(f"{x},{y}" for x, y in places), places[-1], height(finite[-1].probability), text)


def coverage(rows: Sequence[RequirementRow]) -> list[tuple[str, int]]:
    """Number of requirements of each latest verdict, those without a campaign last."""
    words = [row.latest.shown.status for row in rows if row.latest is not None]
    known = [word for word in dict.fromkeys(("FAIL", "INSUFFICIENT", "MET BY RATE", "PASS", *words)) if word in words]
    counts = [(word, words.count(word)) for word in known]
    missing = sum(row.latest is None for row in rows)
    return [*counts, ("NO CAMPAIGN", missing)] if missing else counts


def evidence_text(shown: ShownRequirement) -> str:
    """Cases behind a verdict."""
    return f"{shown.failures:,} of {shown.n:,} failed" if shown.n else "no case yet"


def basis_text(shown: ShownRequirement) -> str:
    """Basis of a verdict without a confidence; empty otherwise."""
    return "decided by rate" if shown.decide_by == ESTIMATE else ""


def margin_text(shown: ShownRequirement) -> str:
    """Margin of the deciding value above or below the required rate, in percentage points."""
    if math.isnan(shown.margin):
        return NOTHING
    return f"{100.0 * shown.margin:+.2f} pp".replace("-", "−")
