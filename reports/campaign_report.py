"""Write the report of a campaign: `report.html`, its data `report.json`, the traceability matrix and JUnit results.

The files are signed with the user's key, if there is one (`marsyard.reports.signature`).
"""

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from marsyard.campaigns.errors import StoreError
from marsyard.campaigns.hidden_folders import hide_folders
from marsyard.campaigns.store.temporary_files import write_atomic
from marsyard.reports import common_sections, tables
from marsyard.reports.budget import budget_section, budget_sentences
from marsyard.reports.column_selection import primary_metric
from marsyard.reports.comparison import comparison_section
from marsyard.reports.conditions import conditions_section
from marsyard.reports.consistency import consistency_section
from marsyard.reports.convergence import convergence_section
from marsyard.reports.effects import drivers_section
from marsyard.reports.evaluation import Evaluation, evaluate_run
from marsyard.reports.failure_boundary import boundary_section
from marsyard.reports.page import page_context
from marsyard.reports.page_environment import page_environment
from marsyard.reports.populations import outcome_counts
from marsyard.reports.presentation import presentations
from marsyard.reports.provenance import read_algorithms
from marsyard.reports.rare import rare_bound_sentence, rare_section, rare_sentences
from marsyard.reports.report_file import PAGE_FILE, REPORT_JSON, SCHEMA, CampaignReport, StudySummary
from marsyard.reports.robustness_section import robustness_section
from marsyard.reports.robustness_wording import robust_sentences, robustness_text
from marsyard.reports.search import search_section, search_sentences
from marsyard.reports.section import Section, SectionMaker, Subject
from marsyard.reports.signature import sign_report
from marsyard.reports.stored import table
from marsyard.reports.tables import error_summaries
from marsyard.reports.validity import validity_section
from marsyard.reports.verdict_files import junit_xml, requirement_evidence, verification_csv
from marsyard.reports.verdicts import find_bound

#: Sections of every campaign, in the page's order; `conditions_section` ends the page.
COMMON_SECTIONS: tuple[SectionMaker, ...] = (
    common_sections.answers_section, comparison_section, common_sections.scatter_section,
    drivers_section, boundary_section, convergence_section,
    consistency_section, common_sections.faults_section, validity_section,
)  # fmt: skip

#: Sections of a study (`marsyard rare`, `marsyard search`, `marsyard budget`).
STUDY_SECTIONS: tuple[SectionMaker, ...] = (rare_section, search_section, budget_section, validity_section)

#: Maximum number of names of sites, and of algorithms, in `report.json`.
_MAX_NAMES = 24

VERIFICATION_FILE = "verification.csv"
JUNIT_FILE = "junit.xml"


def write_report(directory: Path, requirements: Sequence[Mapping[str, Any]] | None = None) -> Path:
    """Write the report of the campaign in a folder into that folder; returns the path of the self-contained page.

    requirements: requirements to evaluate instead of the campaign's own; None for the campaign's own
    Raises StoreError if the folder contains no rows, OSError if the report cannot be written.
    """
    return write_evaluation(evaluate_run(directory, requirements))


def write_evaluation(evaluation: Evaluation, out: Path | None = None) -> Path:
    """Write the report of an evaluated campaign into the folder `out`, and sign it; None for the campaign's folder.

    Returns the path of the page. The signature is omitted without a key, and for other requirements than those of the
    campaign; the dashboard then writes the report again.
    """
    run, verdicts, overall_verdict = evaluation.run, evaluation.verdicts, evaluation.overall_verdict
    directory, subject = run.directory if out is None else out, create_subject(evaluation)
    makers = STUDY_SECTIONS if run.recorded("study") else section_makers()
    robustness = robustness_section(evaluation.robustness, evaluation.variants)
    made_sections = [robustness, *(maker(subject) for maker in makers)]
    extra_sections = [section for section in made_sections if section is not None]
    report = build_report(evaluation, subject, extra_sections)
    write_atomic(
        directory / REPORT_JSON,
        hide_folders(json.dumps(report.to_json(), indent=2, allow_nan=False, ensure_ascii=False)) + "\n",
    )
    for name, text in format_verdict_files(evaluation).items():
        write_atomic(directory / name, text)
    page_file = directory / PAGE_FILE
    context = page_context(run, subject, verdicts, overall_verdict, extra_sections)
    context |= {"evidence": evaluation.evidence, "study_sentences": study_sentences(run.record)}
    context["cautions"] += evaluation.validity.sentences
    if run.unverified:
        context["cautions"].append(f"The rows are not verified, since {run.unverified}.")
    for row in context["verdicts"]:
        row["robustness"] = robustness_text(row["verdict"], evaluation.robustness)
    write_atomic(page_file, hide_folders(page_environment().get_template("report.html.j2").render(context)))
    # the dashboard shows verdicts on the requirements of the campaign only
    if run.requirements == run.definition.get("requirements", run.requirements):
        with suppress(StoreError, RuntimeError):  # without a key or a home folder
            sign_report(directory, run.directory)
    return page_file


def format_verdict_files(evaluation: Evaluation) -> dict[str, str]:
    """Format the verdicts for other programs: the traceability matrix and the JUnit results, by the names of files."""
    run, algorithms = evaluation.run, read_algorithms(evaluation.run.record)
    rows = requirement_evidence(run.name, evaluation.verdicts, algorithms, evaluation.evidence.title)
    is_finished = run.recorded("state") in (None, "finished")
    junit = junit_xml(run.name, evaluation.verdicts, evaluation.overall_verdict, algorithms, is_finished=is_finished)
    return {VERIFICATION_FILE: hide_folders(verification_csv(rows)), JUNIT_FILE: hide_folders(junit)}


def create_subject(evaluation: Evaluation) -> Subject:
    """Create the subject of a report: the random cases of a campaign, and the page's metric with its bound."""
    run, exclude_nominal = evaluation.run, evaluation.sampling.exclude_nominal_case
    random_run = replace(run, frame=exclude_nominal(run.frame), all_cases=exclude_nominal(run.all_cases))
    # the cases of a study are not a random sample; statistics of their errors would be meaningless
    metric = None if run.recorded("study") else primary_metric(random_run.frame, run.requirements)
    return Subject(random_run, metric, find_bound(evaluation.verdicts, metric))


def section_makers() -> list[SectionMaker]:
    """List the functions that create the sections of all campaigns and of all systems, in the order of the page."""
    systems = presentations().values()
    first_makers = [maker for system in systems for maker in system.first]
    system_makers = [maker for system in systems for maker in system.sections]
    return [*first_makers, *COMMON_SECTIONS, *system_makers, conditions_section]


def build_report(evaluation: Evaluation, subject: Subject, extra_sections: Sequence[Section]) -> CampaignReport:
    """Create the record of `report.json`."""
    run, overall_verdict, metric = evaluation.run, evaluation.overall_verdict, subject.metric
    summaries = error_summaries(subject.all_cases, metric) if metric is not None else []
    worst_rows = [] if metric is None else tables.worst_cases(subject.run, metric).rows
    return CampaignReport(
        schema=SCHEMA,
        campaign=run.name,
        **{key: run.recorded(key) for key in ("state", "seed", "git_commit", "started_utc", "finished_utc")},
        cases=len(run.all_cases),
        crashed=overall_verdict.crashed,
        sites=_unique_values(run.frame, "site"),
        algorithms=_unique_values(run.frame, "algorithm"),
        algorithm_details=tuple(read_algorithms(run.record)),
        sampling=evaluation.sampling,
        evidence=evaluation.evidence,
        verdict=overall_verdict.word,
        sentence=overall_verdict.sentence,
        study=_describe_study(run.record),
        exit_code=evaluation.exit_code,
        verdicts=tuple(evaluation.verdicts),
        outcomes=dict(outcome_counts(run.all_cases)),
        metric=metric,
        statistics=dict(summaries),
        worst_cases=tuple(row.case for row in worst_rows),
        validity=evaluation.validity,
        sections={section.key: section.data for section in extra_sections},
        showcases=run.stored_cases,
        robustness=evaluation.robustness,
        repeated=overall_verdict.repeated,
    )


def study_sentences(record: Mapping[str, Any]) -> list[str]:
    """Describe the result of a study, the most important sentence first; empty for an ordinary campaign."""
    sentences = (rare_sentences, search_sentences, budget_sentences, robust_sentences)
    return [text for describe in sentences for text in describe(record)]


def _describe_study(record: Mapping[str, Any]) -> StudySummary | None:
    """Return kind, requirement and main result of a study for `report.json`; None for an ordinary campaign."""
    study = table(record.get("study"))
    if not study:
        return None
    # the first sentence of other studies is their main result
    main_sentence = rare_bound_sentence(record) or next(iter(study_sentences(record)), "")
    sentence = main_sentence or "The study is not finished."
    return StudySummary(str(study.get("kind")), str(study.get("requirement") or ""), sentence)


def _unique_values(frame: pd.DataFrame, column: str) -> tuple[str, ...]:
    values = frame[column].dropna().unique()[:_MAX_NAMES] if column in frame else ()
    return tuple(str(value) for value in values)
