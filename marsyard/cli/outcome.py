"""Evaluation of a campaign for the commands: verdicts on the terminal, and report."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import pandas as pd
from rich.console import Console
from rich.table import Table

from marsyard.campaigns.errors import report_write_errors
from marsyard.campaigns.running.shards import SHARD_KEY, SHARD_STATE
from marsyard.campaigns.store import record
from marsyard.campaigns.store.lock import is_locked
from marsyard.campaigns.store.table import refresh_table
from marsyard.cli.errors import Exit
from marsyard.cli.terminal import grid_table
from marsyard.reports.campaign_report import write_evaluation
from marsyard.reports.column_selection import primary_metric
from marsyard.reports.comparison import compare_algorithms, comparison_grids
from marsyard.reports.evaluation import Evaluation, evaluate_run, record_look
from marsyard.reports.overall import multiplicity_text
from marsyard.reports.provenance import read_algorithms
from marsyard.reports.robustness_wording import robustness_text
from marsyard.reports.terminal_tables import verdict_table
from marsyard.reports.verdicts import Verdict, find_bound
from marsyard.reports.wording import count

Requirements: TypeAlias = Sequence[Mapping[str, Any]]


def evaluate_and_report(directory: Path, console: Console, requirements: Requirements | None = None) -> int:
    """Evaluate a campaign, write its report, print the verdicts, and return the exit status.

    An unfinished campaign has no verdict, and its status is never 0. `requirements` replace the requirements of the
    campaign; in this case the record of the campaign is not changed.
    Raises StoreError if the folder contains no campaign with rows, or the report cannot be written.
    """
    stored = record.read(directory)
    is_finished = stored["state"] == "finished"
    if not is_finished:
        refresh_table(directory)
    evaluation, page = evaluate_and_store(directory, requirements)
    run, verdicts = evaluation.run, evaluation.verdicts
    if not run.recorded("study"):
        algorithms = read_algorithms(run.record)
        console.print(verdict_table(verdicts, algorithms[0].name if algorithms else ""))
    for table in _comparison_tables(evaluation.sampling.exclude_nominal_case(run.frame), run.requirements, verdicts):
        console.print(table)
    lines = [f"verdict: {evaluation.overall_verdict.word}", evaluation.overall_verdict.sentence]
    if is_finished and evaluation.overall_verdict.additional_cases:
        lines.append(f"to decide: marsyard append {directory} {evaluation.overall_verdict.additional_cases}")
    if multiplicity := multiplicity_text(verdicts):
        lines.append(multiplicity)
    texts = {item.requirement_id: robustness_text(item, evaluation.robustness) for item in verdicts}
    lines += [f"robustness of {name}: {text}" for name, text in texts.items() if text]
    if not any(verdict.withheld_status for verdict in verdicts):
        lines.append(f"evidence: {evaluation.evidence.text}")
    lines += [f"validity: {sentence}" for sentence in evaluation.validity.sentences]
    if run.unverified:
        lines.append(f"rows: not verified, since {run.unverified}")
    lines.append(f"report: {page}")
    if not is_finished:
        cases = f"{len(run.all_cases)} of {count(stored['cases'], 'case')}"
        lines.insert(0, f"INCOMPLETE: {cases}; {_describe_unfinished(directory, stored)}")
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    # an unfinished campaign cannot meet its requirements: replace status 0
    return evaluation.exit_code if is_finished else evaluation.exit_code or Exit.INSUFFICIENT


def _describe_unfinished(directory: Path, stored: Mapping[str, Any]) -> str:
    """Return the state of an unfinished campaign from its record, and the command that continues it."""
    if is_locked(directory):
        return "the campaign is running"
    if stored["state"] == SHARD_STATE:
        return f"shard {stored[SHARD_KEY]}; to combine all shards: marsyard merge DIR... --out DIR"
    state = "killed" if stored["state"] == "running" else stored["state"]
    return f"the campaign was {state}; to continue: marsyard resume {directory}"


def evaluate_and_store(directory: Path, requirements: Requirements | None = None) -> tuple[Evaluation, Path]:
    """Evaluate a campaign's rows and write its report; return the evaluation and the path of the report.

    The exit status of a finished campaign and its number of repeated cases are stored in its record, unless
    `requirements` replace its requirements.
    Raises StoreError if the folder contains no campaign with rows, or the report cannot be written.
    """
    evaluation = evaluate_run(directory, requirements)
    if requirements is None and evaluation.run.recorded("state") == "finished":
        repeated = evaluation.overall_verdict.repeated
        record.update(directory, {"exit_code": evaluation.exit_code, "cases_repeated": repeated})
        record_look(evaluation)
    with report_write_errors("the report"):
        return evaluation, write_evaluation(evaluation)


def _comparison_tables(frame: pd.DataFrame, requirements: Requirements, verdicts: Sequence[Verdict]) -> list[Table]:
    """Compare algorithms on the same cases; return no table for a single algorithm."""
    metric = primary_metric(frame, requirements)
    algorithms, differences = compare_algorithms(frame, metric, find_bound(verdicts, metric))
    if not algorithms:
        return []
    titles = ("Algorithms on the same cases", f"Compared with {algorithms[0].name}")
    grids = zip(titles, comparison_grids(algorithms, differences, metric), strict=True)
    return [grid_table(title, grid) for title, grid in grids if grid.rows]
