"""Continuation and end of a study: run it on, write its files and report, print its result."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import typer

from marsyard.cli.execution import make_executor, show_progress
from marsyard.cli.terminal import create_console

if TYPE_CHECKING:
    from marsyard.campaigns.studies.results import SearchResult


def finish_robust(run: Path) -> NoReturn:
    """Write the report of a run, print its robustness, and exit."""
    from marsyard.cli.outcome import evaluate_and_store
    from marsyard.cli.terminal import grid_table
    from marsyard.reports.robustness_section import change_grid, variant_grid
    from marsyard.reports.robustness_sentences import robustness_text

    evaluation, page = evaluate_and_store(run)
    console = create_console()
    lines = []
    for verdict in evaluation.verdicts:
        records = [item for item in evaluation.robustness if item.requirement == verdict.requirement_id]
        if records:
            console.print(grid_table(f"Change to FAIL: {verdict.requirement_id}", change_grid(records)))
            lines.append(f"{verdict.requirement_id}: {robustness_text(verdict, records)}")
        else:
            lines.append(f"{verdict.requirement_id}: {verdict.status}, which no change is computed for")
    if evaluation.variants:
        grid, bands = variant_grid(evaluation.variants)
        console.print(grid_table("Other models", grid))
        lines.append(f"verdicts under other models: {bands}")
    for line in (*lines, f"report: {page}"):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    raise typer.Exit


def contains_study(directory: Path) -> bool:
    """Whether the folder contains a study, not an ordinary campaign."""
    from marsyard.campaigns.studies.study_record import read_study

    return read_study(directory) is not None


def continue_study_and_exit(
    directory: Path, jobs: int | None, cluster: str | None, additional: int = 0, *, is_random: bool = False
) -> NoReturn:
    """Continue the study in a folder, and exit with the status of its verdict.

    additional: number of replicates to add, or of random cases if `is_random`
    """
    from marsyard.campaigns.errors import CampaignError
    from marsyard.campaigns.studies.budget import BudgetStudy
    from marsyard.campaigns.studies.rare import continue_rare
    from marsyard.campaigns.studies.results import BUDGET, ROBUST, SEARCH
    from marsyard.campaigns.studies.robust import RobustCasesStudy
    from marsyard.campaigns.studies.runner import StudySession, continue_study
    from marsyard.campaigns.studies.search import SearchStudy
    from marsyard.campaigns.studies.study_record import StudyKind, read_study

    executor, name = make_executor(jobs, cluster), (read_study(directory) or {}).get("kind")
    kinds: list[tuple[StudyKind[Any, Any], Any]]
    kinds = [(SEARCH, SearchStudy), (BUDGET, BudgetStudy), (ROBUST, RobustCasesStudy)]
    others = {kind.name: (kind, study) for kind, study in kinds}
    with show_progress(directory) as progress:
        if name not in others:
            replicates, random_cases = (0, additional) if is_random else (additional, 0)
            result: Any = continue_rare(directory, executor, progress, replicates, random_cases)
        else:
            kind, study = others[name]
            if additional:
                raise CampaignError(f"{directory} contains {kind.title}, which cannot be extended; start a new one")
            session = StudySession(kind, kind.read_parameters(directory), study, executor, progress)
            result = continue_study(directory, session)
    if name == SEARCH.name:
        finish_search(directory, result)
    if name == ROBUST.name:
        finish_robust(directory.resolve().parent.parent)
    finish_study(directory, result.exit_code)


def finish_search(directory: Path, result: SearchResult) -> NoReturn:
    """Store files and images of the reduced violations, write the report, print the result, and exit."""
    from marsyard.campaigns.running.replay import replay
    from marsyard.campaigns.running.stored_campaign import load_stored_campaign
    from marsyard.campaigns.store.products import case_directory, save_packed
    from marsyard.campaigns.store.record import stored_definition
    from marsyard.campaigns.studies.search import write_regression_campaigns

    campaign = load_stored_campaign(directory, stored_definition(directory))
    files = write_regression_campaigns(campaign, result, directory)
    for failure in result.failures:
        rerun = replay(directory, failure.case)
        if rerun.products is not None:
            save_packed(case_directory(directory, failure.case), rerun.products, rerun.row)
    finish_study(directory, result.exit_code, [f"campaign: {path}" for path in files])


def finish_study(directory: Path, exit_code: int, files: Sequence[str] = ()) -> NoReturn:
    """Write the report of a study, print its sentences, `files`, and the path of the report, and exit."""
    from marsyard.campaigns.errors import report_write_errors
    from marsyard.campaigns.store.record import read
    from marsyard.reports.campaign import write_report
    from marsyard.reports.study_sentences import study_sentences

    with report_write_errors("the report"):
        page = write_report(directory)
    console = create_console()
    for line in (*study_sentences(read(directory)), *files, f"report: {page}"):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    raise typer.Exit(exit_code)
