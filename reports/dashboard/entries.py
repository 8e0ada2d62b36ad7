"""Contents of the dashboard: stored campaigns, read from their records and reports, and a row for each requirement."""

import hashlib
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marsyard.campaigns.definition.requirements import SharedRequirement
from marsyard.campaigns.errors import CampaignError, StoreError
from marsyard.campaigns.store.record import reject_links
from marsyard.reports.campaign import write_evaluation
from marsyard.reports.evaluation import evaluate_run
from marsyard.reports.report_file import REPORT_JSON, CampaignReport, read_report
from marsyard.reports.robustness import Robustness, reach_text
from marsyard.reports.signature import is_own_report
from marsyard.reports.stored import RECORD_FILE, TABLE_FILE, table
from marsyard.reports.traceability import format_tested_algorithms
from marsyard.reports.verdicts import ESTIMATE, GIVEN_TRUTH, Status, Verdict
from marsyard.reports.wording import NOTHING, percent
from marsyard.scenarios.systems import find_system

#: Maximum depth of the search for campaigns below a folder.
_MAX_DEPTH = 3


@dataclass(frozen=True)
class Entry:
    """A stored campaign.

    - slug: name of the campaign's folder in the site: letters, digits and hyphens, with a hash of the campaign's path
    - folder: folder of the report: the campaign's folder, or that of its pages
    - sites, algorithms: names from the rows, else from the parameters
    - report: the content of `report.json`
    """

    slug: str
    directory: Path
    folder: Path
    name: str
    system: str
    sites: tuple[str, ...]
    algorithms: tuple[str, ...]
    report: CampaignReport

    @property
    def title(self) -> str:
        """Name of the campaign, and kind of the study."""
        return self.name if self.report.study is None else f"{self.name}, {self.report.study.kind}"

    @property
    def tested_names(self) -> str:
        """Names and versions of the algorithm under test; names from the rows if the record contains none."""
        return format_tested_algorithms(self.report.algorithm_details) or ", ".join(self.algorithms)

    @property
    def started(self) -> str:
        """Start of the campaign (UTC); empty if not recorded."""
        return str(self.report.started_utc or "")

    @property
    def commit(self) -> str:
        """First digits of the commit of the program; empty if not recorded."""
        return str(self.report.git_commit or "")[:10]

    @property
    def is_finished(self) -> bool:
        """Whether all cases have run."""
        return bool(self.report.state == "finished")


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
    name = str(record.get("name") or table(record.get("definition")).get("name") or path.resolve().name)
    slug = make_slug(path, name)
    report, folder = _read_valid(path, path), path
    if report is None:
        folder = pages / slug
        report = _read_valid(folder, path)
    if report is None:
        folder.mkdir(parents=True, exist_ok=True)
        write_evaluation(evaluate_run(path), folder)
        report = read_report((folder / REPORT_JSON).read_bytes())
    if report is None:
        raise StoreError(f"{folder / REPORT_JSON} has another layout than this version of Marsyard writes")
    parameters = table(table(record.get("definition")).get("parameters"))
    system = find_system(str(table(record.get("definition")).get("scenario")))
    return Entry(
        slug=slug,
        directory=path,
        folder=folder,
        name=name,
        system="other" if system is None else system.name,
        sites=report.sites or _find_names(parameters, "site"),
        algorithms=report.algorithms or _find_names(parameters, "algorithm"),
        report=report,
    )


def _read_valid(folder: Path, path: Path) -> CampaignReport | None:
    """Read a report that this installation wrote from the rows and the confirmations of today; None for another."""
    if not is_own_report(folder, path):
        return None
    file = folder / REPORT_JSON
    report = read_report(file.read_bytes())
    if report is not None and report.evidence.claim:
        confirmations = Path(report.evidence.record)
        if not confirmations.is_file() or confirmations.stat().st_mtime > file.stat().st_mtime:
            return None
    return report


def make_slug(path: Path, name: str) -> str:
    """Create a unique folder name without path separators from a campaign's path and name."""
    safe_name = re.sub(r"[^A-Za-z0-9-]+", "-", name)[:60].strip("-") or "campaign"
    return f"{safe_name}-{hashlib.sha256(str(path.resolve()).encode('utf-8', 'replace')).hexdigest()[:10]}"


def _find_names(parameters: Mapping[str, Any], key: str) -> tuple[str, ...]:
    name = _find_text(parameters, key)
    return (name,) if name else ()


def _find_text(parameters: Mapping[str, Any], key: str) -> str:
    """Find the first text under a key at any depth of nested tables; empty if there is none."""
    for name, value in parameters.items():
        if name == key and isinstance(value, str):
            return value
        nested_value = _find_text(value, key) if isinstance(value, Mapping) else ""
        if nested_value:
            return nested_value
    return ""


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
    verdict: Verdict


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
        for verdict in entry.report.verdicts:
            cells.setdefault(verdict.requirement_id, []).append(Cell(entry, verdict))
        if entry.report.study is not None:
            cells.setdefault(entry.report.study.requirement, [])
    rows = []
    for name, unsorted_cells in cells.items():
        sorted_cells = sorted(unsorted_cells, key=lambda cell: not cell.entry.is_finished)
        latest_by_campaign: dict[str, Cell] = {}
        for cell in sorted_cells:
            latest_by_campaign.setdefault(cell.entry.name, cell)
        latest = list(latest_by_campaign.values())
        history = [
            cell.verdict for cell in sorted_cells if cell.entry.name == latest[0].entry.name and cell.entry.is_finished
        ]
        requirement, kind, source = shared.get(name), "", ""
        statement = latest[0].verdict.statement if latest else ""
        if requirement:
            statement = statement if statement.startswith(GIVEN_TRUTH) else requirement.statement
            kind, source = requirement.kind or "", requirement.source
        studies: dict[str, Entry] = {}
        for entry in entries:
            if entry.report.study is not None and entry.report.study.requirement == name:
                studies.setdefault(entry.title, entry)
        line = sparkline(history[::-1])
        rows.append(RequirementRow(name, statement, kind, source, latest, sorted_cells, line, [*studies.values()]))
    return sorted(rows, key=_severity)


def _severity(row: RequirementRow) -> int:
    """Return the rank of a row by its latest verdict: failed requirements first, those without a campaign last."""
    return len(Status) if row.latest is None else [*Status].index(row.latest.verdict.status)


def sparkline(verdicts: Sequence[Verdict]) -> Sparkline | None:
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
    counts = [(str(status), statuses.count(status)) for status in Status if status in statuses]
    n_missing = sum(row.latest is None for row in rows)
    return [*counts, ("NO CAMPAIGN", n_missing)] if n_missing else counts


def evidence_text(verdict: Verdict) -> str:
    """Describe the number of cases of a verdict."""
    if not verdict.n:
        return "no case yet"
    text = f"{verdict.failures:,} of {verdict.n:,} failed"
    all_cases = verdict.all_cases
    if all_cases is None or all_cases.n == verdict.n:
        return text
    return f"{text}; over all cases {all_cases.failures:,} of {all_cases.n:,}"


def basis_text(verdict: Verdict, robustness: Sequence[Robustness]) -> str:
    """Describe that a verdict is based on the observed rate, and how far it reaches; may be empty."""
    by_rate = "evaluated by observed rate" if verdict.decide_by == ESTIMATE else ""
    return "; ".join(filter(None, (by_rate, reach_text(verdict, robustness))))


def margin_text(verdict: Verdict) -> str:
    """Format the margin of the deciding value relative to the required rate, in percentage points."""
    return NOTHING if math.isnan(verdict.margin) else f"{100.0 * verdict.margin:+.2f} pp".replace("-", "−")
