"""Static site of the dashboard: an index of requirements and campaigns, and a page for each campaign and stored case.

All pages are in the site's folder and need no other files. The reports of campaigns are copied into it, if this user's
installation wrote them, or are written again.
Pages of unchanged campaigns are not written again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marsyard.campaigns.definition.requirements import SharedRequirement, shipped_requirements
from marsyard.reports.campaign import PAGE_FILE, REPORT_JSON, VERIFICATION_FILE, page_environment, write_atomic
from marsyard.reports.dashboard import entries as stored
from marsyard.reports.dashboard.entries import Entry, RequirementRow, basis_text, evidence_text, margin_text
from marsyard.reports.evaluation import evaluate_run
from marsyard.reports.multiplicity import multiplicity_text
from marsyard.reports.presentation import ShowcaseView, showcase_view
from marsyard.reports.requirement_cases import CaseFinder
from marsyard.reports.sections import embed_json, replay_command, script_hash
from marsyard.reports.stored import StoredRun
from marsyard.reports.traceability import algorithm_cells, verification_csv
from marsyard.reports.wording import percent

INDEX = "index.html"
#: Maximum number of cases with a page for each campaign.
_MAX_CASES = 24
_TEMPLATES = Path(__file__).parents[1] / "templates"
#: Functions that the templates call to format numbers and verdicts.
_FORMATTERS = {"margin": margin_text, "basis": basis_text, "evidence": evidence_text, "percent": percent}


@dataclass(frozen=True)
class Site:
    """A written site: its index page, the number of campaigns, and messages about omitted campaigns."""

    index: Path
    campaigns: int
    problems: Sequence[str]


def write_site(directory: Path, sources: Sequence[Path], shared: Mapping[str, SharedRequirement] | None = None) -> Site:
    """Write the dashboard of all campaigns in or below the folders `sources`.

    `shared` contains the requirements that campaigns reference by id; None for those installed with Marsyard.
    """
    # the pages of a campaign are in the folder c/SLUG
    pages = directory / "c"
    pages.mkdir(parents=True, exist_ok=True)
    entries, problems = stored.read_entries(stored.find_campaigns(sources), pages)
    rows = stored.requirement_rows(entries, shipped_requirements() if shared is None else shared)
    for entry in entries:
        _write_campaign(pages / entry.slug, entry)
    script = read_script()
    filter_values = {
        "System": {entry.system for entry in entries},
        "Site": {site for entry in entries for site in entry.sites},
        "Algorithm": {algorithm for entry in entries for algorithm in entry.algorithms},
        "Commit": {entry.commit for entry in entries},
        "Evidence": {entry.evidence for entry in entries},
    }
    index = _render(
        "dashboard.html.j2",
        rows=rows,
        entries=entries,
        problems=problems,
        filters=[(name.lower(), name, sorted(choices - {""})) for name, choices in filter_values.items()],
        max_other=stored.MAX_OTHER_VERDICTS,
        coverage=stored.count_verdicts(rows),
        multiplicity=multiplicity_text([row.latest.verdict for row in rows if row.latest is not None]),
        data=embed_json(_create_filter_data(rows)),
        script=script,
        hash=script_hash(script),
        **_FORMATTERS,
    )
    write_atomic(directory / INDEX, index)
    write_atomic(directory / VERIFICATION_FILE, _create_traceability_csv(rows))
    return Site(directory / INDEX, len(entries), problems)


def read_script() -> str:
    """Read the script of the index page."""
    return (_TEMPLATES / "dashboard.js").read_text(encoding="utf-8")


def _write_campaign(folder: Path, entry: Entry) -> None:
    """Write the pages of a campaign into its folder, unless they are newer than its report."""
    page = folder / INDEX
    if page.is_file() and page.stat().st_mtime > (entry.report / REPORT_JSON).stat().st_mtime:
        return
    folder.mkdir(parents=True, exist_ok=True)
    if entry.report != folder:
        write_atomic(folder / PAGE_FILE, (entry.report / PAGE_FILE).read_text(encoding="utf-8"))
    evaluation = evaluate_run(entry.directory)
    finder = CaseFinder(evaluation.run, evaluation.verdicts)
    cases = _write_cases(folder, entry, evaluation.run, finder)
    links = {int(case["case"]): case["file"] for case in cases}
    lists = finder.requirement_cases()
    text = _render(
        "dashboard_campaign.html.j2",
        entry=entry,
        cases=cases,
        lists=lists,
        links=links,
        multiplicity=multiplicity_text(entry.requirements),
        **_FORMATTERS,
    )
    write_atomic(page, text)


def _write_cases(folder: Path, entry: Entry, run: StoredRun, finder: CaseFinder) -> list[dict[str, str]]:
    """Write a page for each stored case and return the links to these pages: violations, then the largest errors."""
    notable = finder.notable_cases(_MAX_CASES)
    order = {case: rank for rank, case in enumerate(notable)}
    cases = sorted(entry.showcases, key=lambda case: (order.get(case, len(order)), _rank_among_worst(entry, case)))[
        :_MAX_CASES
    ]
    views: dict[int, ShowcaseView] = {case: view for case in cases if (view := showcase_view(run, case)) is not None}
    files, links = {case: f"case-{case}.html" for case in views}, []
    for case, showcase in views.items():
        row = run.all_cases[run.all_cases["case"] == case] if "case" in run.all_cases else run.all_cases[:0]
        values = {str(name): str(value) for name, value in row.iloc[0].items()} if len(row) else {}
        command = replay_command(run, str(case))
        page = _render(
            "dashboard_case.html.j2",
            entry=entry,
            showcase=showcase,
            values=values,
            command=command,
            summary=finder.summary(case),
            links=files,
        )
        write_atomic(folder / files[case], page)
        index = _rank_among_worst(entry, case)
        rank = "" if index == len(entry.worst) else ("the largest error" if index == 0 else "among the largest errors")
        links.append({"case": str(case), "outcome": showcase.outcome, "file": files[case], "rank": rank})
    return links


def _rank_among_worst(entry: Entry, case: int) -> int:
    """Return the rank (from 0) of a case by its error; the number of ranked cases if the case has no rank."""
    return entry.worst.index(str(case)) if str(case) in entry.worst else len(entry.worst)


def _create_filter_data(rows: Sequence[RequirementRow]) -> dict[str, Any]:
    """Create the data with which the page's script selects the latest verdict among the filtered campaigns."""
    return {
        row.requirement: [
            {
                "slug": cell.entry.slug,
                "name": cell.entry.name,
                "algorithm": cell.entry.tested_names,
                "kind": cell.entry.evidence,
                "status": cell.verdict.status,
                "margin": margin_text(cell.verdict),
                "date": cell.entry.started[:10],
                "evidence": evidence_text(cell.verdict),
                "finished": cell.entry.finished,
                "rate": cell.verdict.estimate if math.isfinite(cell.verdict.estimate) else None,
                "required": cell.verdict.probability if math.isfinite(cell.verdict.probability) else None,
                "rate_text": percent(cell.verdict.estimate),
                "basis": basis_text(cell.verdict),
            }
            for cell in row.all_cells
        ]
        for row in rows
    }


def _create_traceability_csv(rows: Sequence[RequirementRow]) -> str:
    """Create the traceability matrix as CSV: the latest verdicts, and requirements without a campaign."""
    csv_rows: list[dict[str, Any]] = []
    fields = {"verdict": "status", "decided_by": "decide_by", "cases": "n", "rate": "estimate", "lower_bound": "lower"}
    fields |= {name: name for name in ("probability", "confidence", "failures", "note")}
    for row in rows:
        head = {"requirement": row.requirement, "statement": row.statement, "kind": row.kind, "source": row.source}
        if not row.cells:
            csv_rows.append({**head, "verdict": "NO CAMPAIGN"})
        for cell in row.cells:
            verdict = {column: getattr(cell.verdict, name) for column, name in fields.items()}
            cells = {"campaign": cell.entry.name, "evidence": cell.entry.evidence}
            csv_rows.append({**head, **cells, **algorithm_cells(cell.entry.tested), **verdict})
    return verification_csv(csv_rows)


def _render(template: str, **context: Any) -> str:
    return page_environment().get_template(template).render(context)
