"""Static site of the dashboard: an index of requirements and campaigns, and a page for each campaign and stored case.

All pages are in the site's folder and need no other files. The reports of campaigns are copied into it, if this user's
installation wrote them, or are written again. The other pages of a campaign repeat excerpts of its report, so that no
case is evaluated or drawn twice. Pages of unchanged campaigns are not written again.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marsyard.campaigns.definition.requirements import SharedRequirement, shipped_requirements
from marsyard.campaigns.store.temporary_files import write_atomic
from marsyard.reports.campaign_report import VERIFICATION_FILE
from marsyard.reports.dashboard import entries as campaign_entries
from marsyard.reports.dashboard.entries import Entry
from marsyard.reports.dashboard.excerpts import case_file, read_excerpts
from marsyard.reports.dashboard.requirement_rows import (
    MAX_OTHER_VERDICTS,
    Cell,
    RequirementRow,
    count_verdicts,
    evidence_text,
    margin_text,
    requirement_rows,
)
from marsyard.reports.overall import multiplicity_text
from marsyard.reports.page_environment import embed_json, page_environment, script_hash
from marsyard.reports.report_file import PAGE_FILE, REPORT_JSON
from marsyard.reports.stored import read_cases
from marsyard.reports.verdict_files import requirement_evidence, verification_csv
from marsyard.reports.wording import NOTHING, percent

INDEX = "index.html"
_TEMPLATES = Path(__file__).parents[1] / "templates"
#: Functions that the templates call to format numbers and verdicts.
_FORMATTERS = {"margin": margin_text, "evidence": evidence_text, "percent": percent}


@dataclass(frozen=True)
class DashboardSite:
    """A written site: its index page, the number of campaigns, and messages about omitted campaigns."""

    index: Path
    campaigns: int
    problems: Sequence[str]


def write_site(
    directory: Path, sources: Sequence[Path], shared: Mapping[str, SharedRequirement] | None = None
) -> DashboardSite:
    """Write the dashboard of all campaigns in or below the folders `sources`.

    `shared` contains the requirements that campaigns reference by id; None for those installed with Marsyard.
    """
    # the pages of a campaign are in the folder c/SLUG
    pages = directory / "c"
    pages.mkdir(parents=True, exist_ok=True)
    entries, problems = campaign_entries.read_entries(campaign_entries.find_campaigns(sources), pages)
    rows = requirement_rows(entries, shipped_requirements() if shared is None else shared)
    for entry in entries:
        _write_campaign(pages / entry.slug, entry)
    script = read_script()
    filter_values = {
        "System": {entry.system for entry in entries},
        "Site": {site for entry in entries for site in entry.sites},
        "Algorithm": {algorithm for entry in entries for algorithm in entry.algorithms},
        "Commit": {entry.commit for entry in entries},
        "Evidence": {entry.report.evidence.title for entry in entries},
    }
    index = _render(
        "dashboard.html.j2",
        rows=rows,
        entries=entries,
        problems=problems,
        filters=[(name.lower(), name, sorted(choices - {""})) for name, choices in filter_values.items()],
        max_other=MAX_OTHER_VERDICTS,
        coverage=count_verdicts(rows),
        multiplicity=multiplicity_text([row.latest.verdict for row in rows if row.latest is not None]),
        data=embed_json(_create_filter_data(rows)),
        script=script,
        hash=script_hash(script),
        **_FORMATTERS,
    )
    write_atomic(directory / INDEX, index)
    write_atomic(directory / VERIFICATION_FILE, _create_traceability_csv(rows))
    return DashboardSite(directory / INDEX, len(entries), problems)


def read_script() -> str:
    """Read the script of the index page."""
    return (_TEMPLATES / "dashboard.js").read_text(encoding="utf-8")


def _write_campaign(folder: Path, entry: Entry) -> None:
    """Write the pages of a campaign into its folder, unless they are newer than its report."""
    page = folder / INDEX
    if page.is_file() and page.stat().st_mtime > (entry.folder / REPORT_JSON).stat().st_mtime:
        return
    folder.mkdir(parents=True, exist_ok=True)
    report = (entry.folder / PAGE_FILE).read_text(encoding="utf-8")
    if entry.folder != folder:
        write_atomic(folder / PAGE_FILE, report)
    excerpts = read_excerpts(report)
    rows = read_cases(entry.directory, list(excerpts.cases))
    for case, content in excerpts.cases.items():
        row = rows.get(case, {})
        outcome = row.get("outcome", NOTHING)
        text = _render("dashboard_case.html.j2", entry=entry, case=case, outcome=outcome, content=content, row=row)
        write_atomic(folder / case_file(case), text)
    cases = [
        {"case": case, "file": case_file(case), "outcome": rows.get(case, {}).get("outcome", NOTHING)}
        | {"rank": _describe_rank(entry, case)}
        for case in excerpts.cases
    ]
    multiplicity = multiplicity_text(entry.report.verdicts)
    cells = [Cell(entry, verdict) for verdict in entry.report.verdicts]
    context = {"entry": entry, "cells": cells, "cases": cases, "lists": excerpts.lists, "multiplicity": multiplicity}
    write_atomic(page, _render("dashboard_campaign.html.j2", **context, **_FORMATTERS))


def _describe_rank(entry: Entry, case: int) -> str:
    """Describe the rank of a case by its error; empty if the case is not among the largest errors."""
    if str(case) not in entry.report.worst_cases:
        return ""
    return "the largest error" if entry.report.worst_cases[0] == str(case) else "among the largest errors"


def _create_filter_data(rows: Sequence[RequirementRow]) -> dict[str, Any]:
    """Create the data with which the page's script selects the latest verdict among the filtered campaigns."""
    return {
        row.requirement: [
            {
                "slug": cell.entry.slug,
                "name": cell.entry.name,
                "algorithm": cell.entry.tested_names,
                "kind": cell.entry.report.evidence.title,
                "status": cell.word,
                "confirmation": cell.is_confirmation,
                "margin": margin_text(cell.verdict),
                "date": cell.entry.started[:10],
                "evidence": evidence_text(cell.verdict),
                "finished": cell.entry.is_finished,
                "rate": cell.verdict.estimate if math.isfinite(cell.verdict.estimate) else None,
                "required": cell.verdict.probability if math.isfinite(cell.verdict.probability) else None,
                "rate_text": percent(cell.verdict.estimate),
                "basis": cell.basis,
            }
            for cell in row.all_cells
        ]
        for row in rows
    }


def _create_traceability_csv(rows: Sequence[RequirementRow]) -> str:
    """Create the traceability matrix as CSV: the latest verdicts, and requirements without a campaign."""
    csv_rows: list[dict[str, Any]] = []
    for row in rows:
        head = {"requirement": row.requirement, "statement": row.statement, "kind": row.kind, "source": row.source}
        if not row.cells:
            csv_rows.append({**head, "verdict": "NO CAMPAIGN"})
        for cell in row.cells:
            report = cell.entry.report
            algorithms, evidence = report.algorithm_details, report.evidence.title
            (evidence_row,) = requirement_evidence(cell.entry.name, [cell.verdict], algorithms, evidence)
            csv_rows.append(evidence_row | head)
    return verification_csv(csv_rows)


def _render(template: str, **context: Any) -> str:
    return page_environment().get_template(template).render(context)
