"""Static site of the dashboard: an index of requirements and campaigns, and a page for each campaign and kept case.

All pages lie in the site's folder and need nothing outside of it; reports of campaigns are linked or copied into it.
Pages of unchanged campaigns are not rewritten, so the cost of an update depends on the new campaigns only.
"""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from marsyard.campaigns.definition.requirements import StatedRequirement, shipped_requirements
from marsyard.reports.campaign import PAGE_FILE, VERIFICATION_FILE, page_environment, write_whole
from marsyard.reports.cases import shown_case
from marsyard.reports.dashboard.entries import (
    MAX_FURTHER_VERDICTS,
    Entry,
    RequirementRow,
    basis_text,
    coverage,
    evidence_text,
    find_campaigns,
    margin_text,
    read_entries,
    requirement_rows,
)
from marsyard.reports.sections import embedded, replay_command, script_hash
from marsyard.reports.stored import read_run
from marsyard.reports.wording import percent

INDEX = "index.html"
#: Maximum number of kept cases of a campaign with a page.
_MAX_CASES = 24
_TEMPLATES = Path(__file__).parents[1] / "templates"


@dataclass(frozen=True)
class Site:
    """Result of writing: the index, the number of campaigns, and the problems of those left out."""

    index: Path
    campaigns: int
    problems: Sequence[str]


def write_site(directory: Path, sources: Sequence[Path], stated: Mapping[str, StatedRequirement] | None = None) -> Site:
    """Write the dashboard of all campaigns in or below the folders `sources`.

    `stated` are the requirements to be shown, by id; the shipped ones by default.
    """
    entries, problems = read_entries(find_campaigns(sources))
    rows = requirement_rows(entries, shipped_requirements() if stated is None else stated)
    (directory / "c").mkdir(parents=True, exist_ok=True)
    for entry in entries:
        _write_campaign(directory / "c" / entry.slug, entry)
    script = (_TEMPLATES / "dashboard.js").read_text(encoding="utf-8")
    index = _rendered(
        "dashboard.html.j2",
        rows=rows,
        entries=entries,
        problems=problems,
        filters=_filters(entries),
        margin=margin_text,
        basis=basis_text,
        evidence=evidence_text,
        most=MAX_FURTHER_VERDICTS,
        coverage=coverage(rows),
        percent=percent,
        data=embedded(_data(rows)),
        script=script,
        hash=script_hash(script),
    )
    write_whole(directory / INDEX, index)
    write_whole(directory / VERIFICATION_FILE, _matrix(rows))
    return Site(directory / INDEX, len(entries), problems)


def _write_campaign(folder: Path, entry: Entry) -> None:
    """Write a campaign's page, its report, and pages of its kept cases."""
    page, report = folder / INDEX, entry.directory / PAGE_FILE
    source = entry.directory / "report.json"
    if page.is_file() and page.stat().st_mtime > source.stat().st_mtime:
        return
    folder.mkdir(parents=True, exist_ok=True)
    if report.is_file():
        _link_or_copy(report, folder / PAGE_FILE)
    cases = _write_cases(folder, entry)
    shown = {"margin": margin_text, "basis": basis_text, "evidence": evidence_text, "percent": percent}
    text = _rendered("dashboard_campaign.html.j2", entry=entry, cases=cases, **shown)
    write_whole(page, text)


def _write_cases(folder: Path, entry: Entry) -> list[dict[str, str]]:
    """Write pages of the kept cases; return their entries for the campaign's page."""
    if not entry.kept:
        return []
    run, listed = read_run(entry.directory), []
    # the worst first
    kept = sorted(entry.kept, key=lambda case: _rank_among_worst(entry, case))
    for case in kept[:_MAX_CASES]:
        shown = shown_case(run, case)
        if shown is None:
            continue
        row = run.whole[run.whole["case"] == case] if "case" in run.whole else run.whole[:0]
        values = {str(name): str(value) for name, value in row.iloc[0].items()} if len(row) else {}
        command = replay_command(run, str(case))
        text = _rendered("dashboard_case.html.j2", entry=entry, shown=shown, values=values, command=command)
        write_whole(folder / f"case-{case}.html", text)
        place = _rank_among_worst(entry, case)
        rank = "" if place == len(entry.worst) else ("the largest error" if place == 0 else "among the largest errors")
        listed.append({"case": str(case), "outcome": shown.outcome, "file": f"case-{case}.html", "rank": rank})
    return listed


def _rank_among_worst(entry: Entry, case: int) -> int:
    """Index of a case among those of the largest errors; their number where it is none of them."""
    return entry.worst.index(str(case)) if str(case) in entry.worst else len(entry.worst)


def _link_or_copy(source: Path, target: Path) -> None:
    """Hard-link a file into the site, or copy it where the disk does not allow links."""
    partial = target.with_name(f"{target.name}.partial")
    partial.unlink(missing_ok=True)
    try:
        os.link(source, partial)
    except OSError:
        shutil.copyfile(source, partial)
    partial.replace(target)


def _filters(entries: Sequence[Entry]) -> list[tuple[str, str, list[str]]]:
    """Attribute, name and values of each filter."""
    found: dict[str, set[str]] = {
        "System": {entry.system for entry in entries},
        "Site": {site for entry in entries for site in entry.sites},
        "Algorithm": {algorithm for entry in entries for algorithm in entry.algorithms},
        "Commit": {entry.commit for entry in entries},
    }
    return [(name.lower(), name, sorted(values - {""})) for name, values in found.items()]


def _data(rows: Sequence[RequirementRow]) -> dict[str, Any]:
    """Data with which the page's script finds the latest verdict among the filtered campaigns."""
    return {
        row.requirement: [
            {
                "slug": cell.entry.slug,
                "name": cell.entry.name,
                "algorithm": cell.entry.judged,
                "status": cell.shown.status,
                "margin": margin_text(cell.shown),
                "date": cell.entry.started[:10],
                "evidence": evidence_text(cell.shown),
                "finished": cell.entry.finished,
                "rate": cell.shown.estimate if math.isfinite(cell.shown.estimate) else None,
                "asked": cell.shown.probability if math.isfinite(cell.shown.probability) else None,
                "rate_text": percent(cell.shown.estimate),
                "basis": basis_text(cell.shown),
            }
            for cell in row.all_cells
        ]
        for row in rows
    }


def _matrix(rows: Sequence[RequirementRow]) -> str:
    """Traceability matrix as CSV: the latest verdict of each campaign, also requirements without a campaign."""
    from marsyard.reports.traceability import algorithm_cells, verification_csv

    found: list[dict[str, Any]] = []
    for row in rows:
        about = {"requirement": row.requirement, "statement": row.statement, "kind": row.kind, "source": row.source}
        if not row.cells:
            found.append({**about, "verdict": "NO CAMPAIGN"})
        for cell in row.cells:
            shown = asdict(cell.shown)
            found.append(
                {
                    **about,
                    "campaign": cell.entry.name,
                    **algorithm_cells(cell.entry.tested),
                    "verdict": cell.shown.status,
                    "probability": shown["probability"],
                    "confidence": shown["confidence"],
                    "decided_by": shown["decide_by"],
                    "cases": shown["n"],
                    "failures": shown["failures"],
                    "rate": shown["estimate"],
                    "lower_bound": shown["lower"],
                    "note": shown["note"],
                }
            )
    return verification_csv(found)


def _rendered(template: str, **context: Any) -> str:
    return page_environment().get_template(template).render(context)
