"""Contents of the dashboard: stored campaigns, read from their records and reports, and a row for each requirement."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marsyard.campaigns.definition.requirements import SharedRequirement
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.store.record import reject_links
from marsyard.reports.campaign import REPORT_JSON, SCHEMA, is_own_report, write_evaluation
from marsyard.reports.evaluation import evaluate_run
from marsyard.reports.stored import RECORD_FILE, TABLE_FILE, table
from marsyard.reports.traceability import Algorithm, format_tested_algorithms, read_algorithms
from marsyard.reports.verdicts import ESTIMATE, GIVEN_TRUTH, Status
from marsyard.reports.wording import NOTHING, percent
from marsyard.scenarios.systems import find_system

#: Maximum depth of the search for campaigns below a folder.
_MAX_DEPTH = 3


@dataclass(frozen=True)
class RequirementVerdict:
    """Verdict of a campaign on one requirement, from `report.json`; see `marsyard.reports.verdicts.Verdict`.

    - margin: value that decides (lower bound or rate) minus the required probability; NaN if unknown
    - n, failures: number of cases of the population, and of those that violate the requirement
    - all_cases: text with the failures over all cases; empty if the population is all cases
    """

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
    all_cases: str


@dataclass(frozen=True)
class Study:
    """Kind (`rare`, `search`, `budget`), requirement and main result of a study."""

    kind: str
    requirement: str
    sentence: str


@dataclass(frozen=True)
class Entry:
    """A stored campaign, from its record and its report; fields are empty if not recorded.

    - slug: name of the campaign's folder in the site: letters, digits and hyphens, with a hash of the campaign's path
    - report: folder of the report: the campaign's folder, or that of its pages
    - evidence: kind of evidence of the run (`marsyard.campaigns.definition.evidence`)
    - tested: algorithms with versions, options and source hashes: those under test first, then those only compared
    - study: main result of a study; None for an ordinary campaign
    - worst: numbers of the cases with the largest errors, the largest first
    """

    slug: str
    directory: Path
    report: Path
    name: str
    system: str
    sites: tuple[str, ...]
    algorithms: tuple[str, ...]
    tested: tuple[Algorithm, ...]
    commit: str
    evidence: str
    started: str
    state: str
    cases: int
    crashed: int
    verdict: str
    sentence: str
    requirements: tuple[RequirementVerdict, ...]
    worst: tuple[str, ...]
    outcomes: Mapping[str, int]
    study: Study | None = None

    @property
    def title(self) -> str:
        """Name of the campaign, and kind of the study."""
        return self.name if self.study is None else f"{self.name}, {self.study.kind}"

    @property
    def tested_names(self) -> str:
        """Names and versions of the algorithm under test; names from the rows if the record contains none."""
        return format_tested_algorithms(self.tested) or ", ".join(self.algorithms)

    @property
    def finished(self) -> bool:
        """Whether all cases have run."""
        return self.state == "finished"


def find_campaigns(directories: Sequence[Path]) -> list[Path]:
    """Find campaigns in or below folders, each once, ordered by path."""
    campaigns: dict[Path, Path] = {}
    for path in (path for directory in directories for path in _find_below(directory, _MAX_DEPTH)):
        campaigns.setdefault(path.resolve(), path)
    return sorted(campaigns.values())


def _find_below(directory: Path, depth: int) -> Iterator[Path]:
    """Find campaigns in a folder and up to `depth` levels below; folders inside a campaign are not searched."""
    if (directory / RECORD_FILE).is_file() and (directory / TABLE_FILE).is_file():
        yield directory
    elif depth and directory.is_dir():
        for inner in sorted(directory.iterdir()):
            if inner.is_dir() and not inner.is_symlink():
                yield from _find_below(inner, depth - 1)


def read_entries(paths: Iterable[Path], pages: Path) -> tuple[list[Entry], list[str]]:
    """Read the campaigns, the latest first; also return messages about campaigns that cannot be displayed.

    pages: folder of the site with a folder for each campaign; a report that this user's installation did not write from
    the present rows, or that has another schema, is written again into it: the page of another user could contain
    scripts, and its data other verdicts
    """
    entries, problems = [], []
    for path in paths:
        try:
            entries.append(_read_entry(path, pages))
        except (CampaignError, OSError, ValueError, KeyError, TypeError) as error:
            problems.append(f"{path}: {error}")
    return sorted(entries, key=lambda entry: (entry.started, entry.name, entry.slug), reverse=True), problems


def _read_entry(path: Path, pages: Path) -> Entry:
    """Read one campaign; its report is written into its folder of `pages` if there is no valid report."""
    reject_links(path)
    record = table(json.loads((path / RECORD_FILE).read_text(encoding="utf-8")))
    name = str(record.get("name") or table(record.get("configuration")).get("name") or path.resolve().name)
    slug = make_slug(path, name)
    folder = next((folder for folder in (path, pages / slug) if _is_valid(folder, path)), None)
    if folder is None:
        folder = pages / slug
        folder.mkdir(parents=True, exist_ok=True)
        write_evaluation(evaluate_run(path), folder)
    report = _read_report(folder)
    parameters = table(table(record.get("configuration")).get("parameters"))
    system = find_system(str(table(record.get("configuration")).get("scenario")))
    study = table(report.get("study"))
    return Entry(
        slug=slug,
        directory=path,
        report=folder,
        name=name,
        system="other" if system is None else system.name,
        sites=_read_names(report, "sites", parameters, "site"),
        algorithms=_read_names(report, "algorithms", parameters, "algorithm"),
        tested=tuple(read_algorithms(record)),
        commit=str(report.get("git_commit") or "")[:10],
        evidence=str(table(report.get("evidence")).get("title") or ""),
        started=str(report.get("started_utc") or ""),
        state=str(report.get("state") or ""),
        cases=int(report.get("cases") or 0),
        crashed=int(report.get("crashed") or 0),
        verdict=str(report.get("verdict") or ""),
        sentence=str(report.get("sentence") or ""),
        requirements=tuple(_read_verdict(table(verdict)) for verdict in report.get("verdicts") or ()),
        worst=tuple(str(case) for case in report.get("worst_cases") or ()),
        outcomes={str(key): int(value) for key, value in table(report.get("outcomes")).items()},
        study=Study(*(str(study.get(name)) for name in ("kind", "requirement", "sentence"))) if study else None,
    )


def _read_report(folder: Path) -> Mapping[str, Any]:
    return table(json.loads((folder / REPORT_JSON).read_text(encoding="utf-8")))


def _is_valid(folder: Path, path: Path) -> bool:
    """Whether a folder contains a report that this installation wrote from the rows and the confirmations of today."""
    if not is_own_report(folder, path):
        return False
    report = _read_report(folder)
    evidence, written_s = table(report.get("evidence")), (folder / REPORT_JSON).stat().st_mtime
    confirmations = Path(str(evidence.get("record") or ""))
    if evidence.get("claim") and (not confirmations.is_file() or confirmations.stat().st_mtime > written_s):
        return False
    return report.get("schema") == SCHEMA


def _read_verdict(verdict: Mapping[str, Any]) -> RequirementVerdict:
    """Read a verdict of `report.json`."""
    values: dict[str, Any] = {
        name: str(verdict.get(name) or "") for name in ("statement", "status", "decide_by", "note")
    }
    for name in ("estimate", "lower", "probability", "margin", "confidence"):
        values[name] = _to_float(verdict.get(name))
    all_cases = table(verdict.get("all_cases"))
    values["all_cases"] = f"over all cases {all_cases['failures']:,} of {all_cases['n']:,}" if all_cases else ""
    if all_cases and all_cases["n"] == verdict.get("n"):
        values["all_cases"] = ""
    for name in ("n", "failures"):
        values[name] = int(verdict.get(name) or 0)
    return RequirementVerdict(requirement=str(verdict.get("requirement_id") or "?"), **values)


def make_slug(path: Path, name: str) -> str:
    """Create a unique folder name without path separators from a campaign's path and name."""
    safe_name = re.sub(r"[^A-Za-z0-9-]+", "-", name)[:60].strip("-") or "campaign"
    return f"{safe_name}-{hashlib.sha256(str(path.resolve()).encode('utf-8', 'replace')).hexdigest()[:10]}"


def _read_names(report: Mapping[str, Any], key: str, parameters: Mapping[str, Any], parameter: str) -> tuple[str, ...]:
    """Read names from the report; if there are none, read the name from the parameters."""
    names = tuple(str(name) for name in report.get(key) or () if str(name))
    name = _find_text(parameters, parameter)
    return names or ((name,) if name else ())


def _find_text(parameters: Mapping[str, Any], key: str) -> str:
    """Find the first text under a key at any depth of nested tables; empty if there is none."""
    for name, value in parameters.items():
        if name == key and isinstance(value, str):
            return value
        nested_value = _find_text(value, key) if isinstance(value, Mapping) else ""
        if nested_value:
            return nested_value
    return ""


def _to_float(value: Any) -> float:
    """Convert a number to float; NaN for other values."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan


#: Maximum number of other campaigns next to a requirement's verdict.
MAX_OTHER_VERDICTS = 7
#: Maximum number of campaigns in a sparkline, and its width and height, pixels.
_MAX_POINTS, _WIDTH_PX, _HEIGHT_PX = 24, 120.0, 26.0


@dataclass(frozen=True)
class Sparkline:
    """Line of the observed rates over time, oldest first, in pixels of an SVG image.

    - points: points of the line as SVG text ("x,y x,y"); last: the last point
    - required_y: y of the line of the required rate; text: description of the line
    """

    points: str
    last: tuple[float, float]
    required_y: float
    text: str


@dataclass(frozen=True)
class Cell:
    """Verdict of a campaign on a requirement."""

    entry: Entry
    verdict: RequirementVerdict


@dataclass(frozen=True)
class RequirementRow:
    """A requirement, its latest verdict for each campaign name, and the trend of the latest campaign.

    - cells: latest verdict for each campaign name
    - all_cells: verdicts of all campaigns, the latest first, unfinished campaigns last
    - studies: latest study of each kind and campaign name
    """

    requirement: str
    statement: str
    kind: str
    source: str
    cells: Sequence[Cell]
    all_cells: Sequence[Cell]
    trend: Sparkline | None
    studies: Sequence[Entry]

    @property
    def latest(self) -> Cell | None:
        """Verdict of the latest campaign, preferably a finished campaign; None without a campaign."""
        return self.cells[0] if self.cells else None


def requirement_rows(entries: Sequence[Entry], shared: Mapping[str, SharedRequirement]) -> list[RequirementRow]:
    """Create a row for each requirement of `shared` and of the campaigns, the most severe verdict first."""
    cells: dict[str, list[Cell]] = {name: [] for name in shared}
    for entry in entries:
        for verdict in entry.requirements:
            cells.setdefault(verdict.requirement, []).append(Cell(entry, verdict))
        if entry.study is not None:
            cells.setdefault(entry.study.requirement, [])
    rows = []
    for name, unsorted_cells in cells.items():
        sorted_cells = sorted(unsorted_cells, key=lambda cell: not cell.entry.finished)
        latest_by_campaign: dict[str, Cell] = {}
        for cell in sorted_cells:
            latest_by_campaign.setdefault(cell.entry.name, cell)
        latest = list(latest_by_campaign.values())
        history = [
            cell.verdict for cell in sorted_cells if cell.entry.name == latest[0].entry.name and cell.entry.finished
        ]
        requirement, kind, source = shared.get(name), "", ""
        statement = latest[0].verdict.statement if latest else ""
        if requirement:
            statement = statement if statement.startswith(GIVEN_TRUTH) else requirement.statement
            kind, source = requirement.kind or "", requirement.source
        studies: dict[str, Entry] = {}
        for entry in entries:
            if entry.study is not None and entry.study.requirement == name:
                studies.setdefault(entry.title, entry)
        line = sparkline(history[::-1])
        rows.append(RequirementRow(name, statement, kind, source, latest, sorted_cells, line, [*studies.values()]))
    return sorted(rows, key=_severity)


#: Order of the requirements by their latest verdict.
_SEVERITY = tuple(
    map(
        str,
        (Status.FAIL, Status.INSUFFICIENT, Status.MET_BY_RATE, Status.UNREGISTERED, Status.OTHER_CLAIMS, Status.PASS),
    )
)


def _severity(row: RequirementRow) -> int:
    """Return the rank of a row by its latest verdict: failed requirements first, those without a campaign last."""
    status = "" if row.latest is None else row.latest.verdict.status
    return _SEVERITY.index(status) if status in _SEVERITY else len(_SEVERITY)


def sparkline(verdicts: Sequence[RequirementVerdict]) -> Sparkline | None:
    """Create the line of observed rates over time and of the required rate; None for fewer than two campaigns."""
    finite = [verdict for verdict in verdicts if all(map(math.isfinite, (verdict.estimate, verdict.probability)))]
    finite = finite[-_MAX_POINTS:]
    if len(finite) < 2:
        return None
    rates = [verdict.estimate for verdict in finite]
    low = min(*rates, *(verdict.probability for verdict in finite))
    # margin below the lowest rate: 15 % of its distance from 100 %; positive also if all rates are 100 %
    low -= 0.15 * (1.0 - low) + 1e-9
    # margins of 4 pixels on the left and right, of 3 pixels at the top and bottom
    step_px = (_WIDTH_PX - 8.0) / (len(finite) - 1)

    def compute_y(rate: float) -> float:
        return round(3.0 + (_HEIGHT_PX - 6.0) * (1.0 - rate) / (1.0 - low), 2)

    points = [(round(4.0 + step_px * index, 2), compute_y(rate)) for index, rate in enumerate(rates)]
    text = f"{len(finite)} campaigns, rates {percent(rates[0])} to {percent(rates[-1])}"
    return Sparkline(" ".join(f"{x},{y}" for x, y in points), points[-1], compute_y(finite[-1].probability), text)


def count_verdicts(rows: Sequence[RequirementRow]) -> list[tuple[str, int]]:
    """Count the requirements per latest verdict; requirements without a campaign come last."""
    statuses = [row.latest.verdict.status for row in rows if row.latest is not None]
    ordered = dict.fromkeys((*_SEVERITY, *statuses))
    present_statuses = [status for status in ordered if status in statuses]
    counts = [(status, statuses.count(status)) for status in present_statuses]
    n_missing = sum(row.latest is None for row in rows)
    return [*counts, ("NO CAMPAIGN", n_missing)] if n_missing else counts


def evidence_text(verdict: RequirementVerdict) -> str:
    """Describe the number of cases of a verdict."""
    if not verdict.n:
        return "no case yet"
    text = f"{verdict.failures:,} of {verdict.n:,} failed"
    return f"{text}; {verdict.all_cases}" if verdict.all_cases else text


def basis_text(verdict: RequirementVerdict) -> str:
    """Describe that a verdict is based on the observed rate; empty for a verdict at a confidence."""
    return "evaluated by observed rate" if verdict.decide_by == ESTIMATE else ""


def margin_text(verdict: RequirementVerdict) -> str:
    """Format the margin of the deciding value relative to the required rate, in percentage points."""
    return NOTHING if math.isnan(verdict.margin) else f"{100.0 * verdict.margin:+.2f} pp".replace("-", "−")
