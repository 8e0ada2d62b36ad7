"""Stored campaigns of the dashboard, read from their records and reports."""

import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marsyard.campaigns.errors import CampaignError, StoreError
from marsyard.campaigns.store.record import reject_links
from marsyard.reports.campaign_report import write_evaluation
from marsyard.reports.evaluation import evaluate_run
from marsyard.reports.provenance import format_tested_algorithms
from marsyard.reports.report_file import REPORT_JSON, CampaignReport, read_report
from marsyard.reports.signature import is_own_report
from marsyard.reports.stored import RECORD_FILE, TABLE_FILE, table
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
