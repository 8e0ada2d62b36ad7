"""Context of the template of a campaign's page."""

import json
import shlex
from collections.abc import Sequence
from typing import Any

import numpy as np

from marsyard.reports import case_tables, dispersion_table, explorer, page, page_figures, page_scripts, provenance
from marsyard.reports.column_values import numbers
from marsyard.reports.gallery import CASES_PER_GROUP, gallery_views
from marsyard.reports.multiplicity import multiplicity_text
from marsyard.reports.overall import OverallVerdict
from marsyard.reports.requirement_cases import CaseFinder
from marsyard.reports.sampling_design import read_sampling_design
from marsyard.reports.section import Grid, Section, Subject
from marsyard.reports.stored import StoredRun
from marsyard.reports.study_sentences import study_sentences
from marsyard.reports.tables import statistics_grid
from marsyard.reports.tested_algorithms import read_algorithms
from marsyard.reports.verdicts import Verdict
from marsyard.reports.wording import count, label, number


def page_context(
    run: StoredRun, subject: Subject, verdicts: Sequence[Verdict], overall: OverallVerdict, extra: Sequence[Section]
) -> dict[str, Any]:
    """Create the context of the page's template; statistics use the cases of `subject`, other values all cases."""
    metric, bound = subject.metric, subject.bound
    crash_text = f"{count(overall.crashed, 'case')} crashed. Fix the cause before you use the verdict."
    cautions = [crash_text] if overall.crashed else []
    finder = CaseFinder(subject.run, verdicts)
    gallery = gallery_views(run, finder.worst_violations(CASES_PER_GROUP))
    context: dict[str, Any] = {
        "run": run,
        "description": str(run.recorded("description") or ""),
        "study_sentences": study_sentences(run.record),
        "overall_verdict": overall,
        "cautions": [*cautions, *sampling_cautions(run, metric)],
        "interrupted": run.recorded("state") not in (None, "finished"),
        "verdicts": [page.verdict_row(verdict) for verdict in verdicts],
        "multiplicity": multiplicity_text(verdicts),
        "metric": metric,
        "metric_label": "" if metric is None else label(metric),
        "metric_title": "" if metric is None else label(metric)[:1].upper() + label(metric)[1:],
        "bound": bound,
        "extra_sections": extra,
        "outcomes": page.outcome_grid(run.all_cases, str(run.definition.get("scenario") or "")),
        "outcome_figures": page_figures.outcome_figures(run.all_cases),
        "crashed": case_tables.crashed_rows(run),
        "dispersions": dispersion_table.dispersion_grid(subject.run),
        "requirement_cases": finder.requirement_cases(),
        "gallery": gallery,
        "links": {case.case: f"#case-{case.case}" for case in gallery},
        "summaries": {case.case: finder.summary(case.case) for case in gallery},
        "provenance": provenance.list_provenance(run),
        "versions": provenance.list_versions(run),
        "definition": json.dumps(run.definition, indent=2, ensure_ascii=False, default=str),
        "algorithms": read_algorithms(run.record),
        "rerun": provenance.rerun_commands(run),
        "rerun_is_stored": run.command is not None,
        "replay": provenance.replay_command(run, "CASE"),
        "gallery_command": shlex.join(["marsyard", "report", str(run.directory), "--gallery"]),
    }
    cases_with_images = [str(case.case) for case in gallery]
    if metric is None:
        empty_table = case_tables.CaseTable((), ())
        context |= {"error_figures": [], "driver_figures": [], "statistics": Grid((), ())}
        return context | {"explorer": None, "worst": empty_table, "unanswered": empty_table}
    context["explorer"], random_run = None, subject.run
    if np.isfinite(numbers(random_run.frame, metric)).any():
        data, script = (
            explorer.explorer_data(random_run, metric, finder.explored_requirements(), cases_with_images),
            explorer.read_script(),
        )
        content_hash = page_scripts.script_hash(script)
        context["explorer"] = {
            "data": data,
            "json": page_scripts.embed_json(data),
            "script": script,
            "hash": content_hash,
        }
    return context | {
        "error_figures": page_figures.error_figures(random_run.frame, random_run.all_cases, metric, bound),
        "driver_figures": page_figures.driver_figures(
            random_run.frame, metric, bound, random_run.driver_columns(metric)
        ),
        "statistics": statistics_grid(random_run.all_cases, metric),
        "worst": case_tables.worst_cases(random_run, metric, cases_with_images),
        "unanswered": case_tables.unanswered_cases(random_run, metric, cases_with_images),
    }


def sampling_cautions(run: StoredRun, metric: str | None) -> list[str]:
    """List warnings about the sampling: a design that is not random, plots of a part of the cases, a nominal case."""
    sampling = read_sampling_design(run.definition)
    cautions = []
    if not sampling.independent and not run.recorded("study"):
        cautions.append(
            f"The cases are not independent random samples: {sampling.text}. Statistics describe these cases; "
            "intervals, bounds and probabilities on this page assume independent samples and do not apply to them."
        )
    if run.is_truncated:
        cautions.append(
            f"Verdicts, outcomes, answers, statistics and convergence use all {len(run.all_cases):,} cases. Scatter "
            f"plots, conditions and drivers use the first {len(run.frame):,} cases"
            f"{', which are also a random sample' if sampling.independent else ''}."
        )
    nominal_rows = run.frame[run.frame["case"] == 0] if sampling.nominal and "case" in run.frame else run.frame[:0]
    if len(nominal_rows):
        nominal_text = str(nominal_rows["outcome"].iloc[0]) if "outcome" in nominal_rows else "stored"
        if metric is not None:
            nominal_text += f", {label(metric)} {number(float(numbers(nominal_rows, metric)[0]))}"
        cautions.append(f"Case 0 is the nominal case ({nominal_text}). It is excluded from verdicts and statistics.")
    return cautions
