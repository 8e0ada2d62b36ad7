"""A campaign's report: `report.html`, its data `report.json`, the traceability matrix and JUnit results."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from marsyard.reports import common_sections, sections
from marsyard.reports.comparison import comparison_section
from marsyard.reports.conditions import conditions_section
from marsyard.reports.evaluation import Evaluation, OverallVerdict, evaluate_run
from marsyard.reports.presentation import presentations, shown_cases
from marsyard.reports.sampling_design import read_sampling_design
from marsyard.reports.section import Grid, Section, SectionMaker, Subject
from marsyard.reports.stored import StoredRun
from marsyard.reports.tables import error_summaries, outcome_counts, statistics_grid
from marsyard.reports.traceability import junit_xml, requirement_evidence, tested_algorithms, verification_csv
from marsyard.reports.verdicts import Verdict
from marsyard.reports.wording import count, label, number, numbers, primary_metric

#: Sections of every campaign, in the page's order; `conditions_section` ends the page.
COMMON_SECTIONS: tuple[SectionMaker, ...] = (
    common_sections.answers_section, comparison_section, common_sections.scatter_section,
    common_sections.drivers_section, common_sections.convergence_section, common_sections.consistency_section,
    common_sections.faults_section,
)  # fmt: skip

#: Maximum number of sites and algorithms in `report.json`.
_MAX_KINDS = 24

#: Version of the layout of `report.json`, raised by removals and changes of meaning, and its JSON Schema.
SCHEMA = 5
SCHEMA_FILE = Path(__file__).with_name("report.schema.json")
#: Properties of a verdict in `report.json`.
_DERIVED = ("note", "plain_status", "confident_status", "consumer_risk", "margin")
PAGE_FILE = "report.html"
TWIN_FILE = "report.json"
VERIFICATION_FILE = "verification.csv"
JUNIT_FILE = "junit.xml"


def write_report(directory: Path, requirements: Sequence[Mapping[str, Any]] | None = None) -> Path:
    """Write a campaign's report into its folder from the files there; returns the path of the self-contained page.

    requirements: in place of the campaign's own
    Raises StoreError if the folder holds no rows, OSError if the report cannot be written.
    """
    return write_evaluation(evaluate_run(directory, requirements))


def write_evaluation(evaluation: Evaluation) -> Path:
    """Write the report of an evaluated campaign into its folder."""
    run, how, verdicts, whole = evaluation.run, evaluation.how, evaluation.verdicts, evaluation.whole
    directory = run.directory
    drawn = replace(run, frame=how.draw(run.frame), whole=how.draw(run.whole))
    metric = primary_metric(drawn.frame, run.requirements)
    bound = next((v.bound for v in verdicts if v.metric == metric and math.isfinite(v.bound)), None)
    subject = Subject(drawn, metric, bound)
    further = [section for make in section_makers() if (section := make(subject)) is not None]
    twin = summary(evaluation, subject, further)
    algorithms = tested_algorithms(run.record)
    write_whole(directory / TWIN_FILE, json.dumps(twin, indent=2, allow_nan=False) + "\n")
    write_whole(directory / VERIFICATION_FILE, verification_csv(requirement_evidence(run.name, verdicts, algorithms)))
    write_whole(directory / JUNIT_FILE, junit_xml(run.name, verdicts, whole, algorithms))
    page = directory / PAGE_FILE
    context = page_context(run, subject, verdicts, whole, further)
    write_whole(page, page_environment().get_template("report.html.j2").render(context))
    return page


def section_makers() -> list[SectionMaker]:
    """Makers of the sections of every campaign and of every system, in the order of the page."""
    systems = presentations()
    first = [make for system in systems for make in system.first]
    return [*first, *COMMON_SECTIONS, *(make for system in systems for make in system.sections), conditions_section]


def page_context(
    run: StoredRun, subject: Subject, verdicts: Sequence[Verdict], whole: OverallVerdict, further: Sequence[Section]
) -> dict[str, Any]:
    """Context of the page's template: statistics of the subject's cases, all else of the whole run."""
    metric, bound = subject.metric, subject.bound
    text = f"{count(whole.crashed, 'case')} crashed: fix this before you use the verdict."
    crashed = [text] if whole.crashed else []
    context: dict[str, Any] = {
        "run": run,
        "description": str(run.recorded("description") or ""),
        "whole": whole,
        "cautions": [*crashed, *sampling_cautions(run, metric)],
        "interrupted": run.recorded("state") not in (None, "finished"),
        "verdicts": [sections.verdict_row(verdict) for verdict in verdicts],
        "metric": metric,
        "bound": bound,
        "further": further,
        "outcomes": sections.outcome_grid(run.whole),
        "outcome_plates": sections.outcome_plates(run.whole),
        "crashed": sections.crashed_rows(run),
        "dispersions": sections.dispersion_grid(subject.run),
        "shown": shown_cases(run),
        "provenance": sections.provenance(run),
        "versions": sections.versions(run),
        "configuration": json.dumps(run.configuration or run.record, indent=2, ensure_ascii=False, default=str),
        "algorithms": tested_algorithms(run.record),
        "rerun": sections.rerun_commands(run),
        "rerun_is_stored": run.command is not None,
        "replay": sections.replay_command(run, "CASE"),
        "gallery": shlex.join(["marsyard", "report", str(run.directory), "--gallery"]),
    }
    pictured = [str(case.case) for case in context["shown"]]
    if metric is None:
        none = sections.CaseTable((), ())
        context |= {"error_plates": [], "driver_plates": [], "statistics": Grid((), ())}
        return context | {"explorer": None, "worst": none, "silent": none}
    context["explorer"], drawn = None, subject.run
    if np.isfinite(numbers(drawn.frame, metric)).any():
        data, script = sections.explorer_data(drawn, metric, bound, pictured), sections.script()
        hashed = sections.script_hash(script)
        context["explorer"] = {"data": data, "json": sections.embed_json(data), "script": script, "hash": hashed}
    return context | {
        "error_plates": sections.error_plates(drawn.frame, drawn.whole, metric, bound),
        "driver_plates": sections.driver_plates(drawn.frame, metric, bound),
        "statistics": statistics_grid(drawn.whole, metric),
        "worst": sections.worst_cases(drawn, metric, pictured),
        "silent": sections.unanswered_cases(drawn, metric, pictured),
    }


def sampling_cautions(run: StoredRun, metric: str | None) -> list[str]:
    """Warnings about the sampling: designs without probabilities, very many cases, a nominal case."""
    how = read_sampling_design(run.configuration)
    texts = []
    if not how.independent:
        texts.append(
            f"The cases are no independent random draws: {how.text}. Statistics describe these cases; intervals, "
            "bounds and probabilities on this page assume independent draws and do not hold for them."
        )
    if run.sampled_from is not None:
        texts.append(
            f"Verdicts, outcomes, answers, statistics and convergence are of all {run.sampled_from:,} cases; points, "
            f"conditions and drivers of the first {len(run.frame):,}, which are as random as all."
        )
    nominal = run.frame[run.frame["case"] == 0] if how.nominal and "case" in run.frame else run.frame[:0]
    if len(nominal):
        result = str(nominal["outcome"].iloc[0]) if "outcome" in nominal else "stored"
        if metric is not None:
            result += f", {label(metric)} {number(float(numbers(nominal, metric)[0]))}"
        texts.append(f"Case 0 is the nominal one ({result}); it counts in no verdict and in no statistic.")
    return texts


def summary(found: Evaluation, subject: Subject, further: Sequence[Section]) -> dict[str, Any]:
    """The report as plain data; NaN and infinities are null."""
    run, how, whole, metric = found.run, found.how, found.whole, subject.metric
    summaries = error_summaries(subject.whole, metric) if metric is not None else []
    twin = {
        "schema": SCHEMA,
        "campaign": run.name,
        **{key: run.recorded(key) for key in ("state", "seed", "git_commit", "started_utc", "finished_utc")},
        "cases": len(run.whole),
        "crashed": whole.crashed,
        "sites": _kinds(run.frame, "site"),
        "algorithms": _kinds(run.frame, "algorithm"),
        "algorithm_details": [asdict(one) for one in tested_algorithms(run.record)],
        "sampling": {**asdict(how), "independent": how.independent, "text": how.text},
        "verdict": whole.word,
        "sentence": whole.sentence,
        "exit_code": found.exit_code,
        "verdicts": [asdict(one) | {name: getattr(one, name) for name in _DERIVED} for one in found.verdicts],
        "outcomes": dict(outcome_counts(run.whole)),
        "metric": metric,
        "statistics": {name: asdict(summarized) for name, summarized in summaries},
        "worst_cases": [] if metric is None else [row.case for row in sections.worst_cases(subject.run, metric).rows],
        "sections": {section.key: section.data for section in further},
        "showcases": run.showcases,
    }
    return dict(_plain(twin))


def _kinds(frame: pd.DataFrame, column: str) -> list[str]:
    if column not in frame:
        return []
    return [str(value) for value in frame[column].dropna().unique()[:_MAX_KINDS]]


def page_environment() -> Environment:
    """Jinja environment that escapes all values."""
    return Environment(
        autoescape=True,
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        lstrip_blocks=True,
        trim_blocks=True,
        undefined=StrictUndefined,
    )


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(name): _plain(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, str | int | bool) else str(value)


def write_whole(path: Path, text: str) -> None:
    """Write a file atomically."""
    partial = path.with_suffix(path.suffix + ".partial")
    # lone surrogates, which JSON can hold, cannot be encoded as UTF-8
    partial.write_text(text, encoding="utf-8", errors="replace")
    partial.replace(path)
