"""Writes the dashboard: an index of requirements and campaigns, a page for each campaign and for each kept case.

Every page stands in the site's folder and needs nothing outside of it; a campaign's report is linked or copied in.
Pages of campaigns and cases that have not changed are left as they are, so that renewing the site over a thousand
campaigns takes no longer than what is new.
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
from marsyard.reports.dashboard.entries import Entry, find_campaigns, read_entries
from marsyard.reports.dashboard.rows import (
    MOST_BESIDE,
    RequirementRow,
    basis_text,
    coverage,
    evidence_text,
    margin_text,
    requirement_rows,
)
from marsyard.reports.sections import embedded, replay_command, script_hash
from marsyard.reports.stored import read_run
from marsyard.reports.wording import percent

INDEX = "index.html"
#: Kept cases of a campaign that get a page.
_MOST_CASES = 24
_TEMPLATES = Path(__file__).parents[1] / "templates"


@dataclass(frozen=True)
class Site:
    """What was written: the index, how many campaigns it lists, and what is wrong with those that it does not."""

    index: Path
    campaigns: int
    problems: Sequence[str]


def write_site(directory: Path, sources: Sequence[Path], stated: Mapping[str, StatedRequirement] | None = None) -> Site:
    """Writes the dashboard over all campaigns found in some folders.

    Parameters
    ----------
    directory
        The site's folder.
    sources
        Folders of campaigns, or folders that hold such.
    stated
        Requirements that are to be shown, by id; those that ship by default.
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
        most=MOST_BESIDE,
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
    """A campaign's page, its report beside it, and pages of its kept cases."""
    page, report = folder / INDEX, entry.directory / PAGE_FILE
    source = entry.directory / "report.json"
    if page.is_file() and page.stat().st_mtime > source.stat().st_mtime:
        return
    folder.mkdir(parents=True, exist_ok=True)
    if report.is_file():
        _place(report, folder / PAGE_FILE)
    cases = _write_cases(folder, entry)
    shown = {"margin": margin_text, "basis": basis_text, "evidence": evidence_text, "percent": percent}
    text = _rendered("dashboard_campaign.html.j2", entry=entry, cases=cases, **shown)
    write_whole(page, text)


def _write_cases(folder: Path, entry: Entry) -> list[dict[str, str]]:
    """Pages of the kept cases that can be drawn; what the campaign's page says of each."""
    if not entry.kept:
        return []
    run, told = read_run(entry.directory), []
    # the worst first: two clicks from a requirement lead to its pictures
    kept = sorted(entry.kept, key=lambda case: _place_among_worst(entry, case))
    for case in kept[:_MOST_CASES]:
        shown = shown_case(run, case)
        if shown is None:
            continue
        row = run.whole[run.whole["case"] == case] if "case" in run.whole else run.whole[:0]
        values = {str(name): str(value) for name, value in row.iloc[0].items()} if len(row) else {}
        command = replay_command(run, str(case))
        text = _rendered("dashboard_case.html.j2", entry=entry, shown=shown, values=values, command=command)
        write_whole(folder / f"case-{case}.html", text)
        place = _place_among_worst(entry, case)
        rank = "" if place == len(entry.worst) else ("the largest error" if place == 0 else "among the largest errors")
        told.append({"case": str(case), "outcome": shown.outcome, "file": f"case-{case}.html", "rank": rank})
    return told


def _place_among_worst(entry: Entry, case: int) -> int:
    """Where a case stands among those of the largest errors; behind all of them where it is none."""
    return entry.worst.index(str(case)) if str(case) in entry.worst else len(entry.worst)


def _place(source: Path, target: Path) -> None:
    """Has a file in the site: the same one where the disk allows that, or a copy."""
    partial = target.with_name(f"{target.name}.partial")
    partial.unlink(missing_ok=True)
    try:
        os.link(source, partial)
    except OSError:
        shutil.copyfile(source, partial)
    partial.replace(target)


def _filters(entries: Sequence[Entry]) -> list[tuple[str, str, list[str]]]:
    """What can be filtered by: attribute, name, and the values there are."""
    found: dict[str, set[str]] = {
        "System": {entry.system for entry in entries},
        "Site": {site for entry in entries for site in entry.sites},
        "Algorithm": {algorithm for entry in entries for algorithm in entry.algorithms},
        "Commit": {entry.commit for entry in entries},
    }
    return [(name.lower(), name, sorted(values - {""})) for name, values in found.items()]


def _data(rows: Sequence[RequirementRow]) -> dict[str, Any]:
    """What the page's script needs to find the latest verdict among the campaigns that a filter leaves."""
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
    """The traceability matrix of all: the latest of each campaign, and a row for what none shows."""
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
