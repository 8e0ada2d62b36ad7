"""Functions of the commands that run or report campaigns: time estimate, evaluation, report, dashboard server.

The module also runs campaigns until their verdicts are decided (`--until-decided`), and reruns cases for their images.
"""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import pandas as pd
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
import typer
from rich.console import Console
from rich.table import Table

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.errors import CampaignError, StoreError, report_write_errors
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.execution.workers import LocalExecutor
from marsyard.campaigns.running.engine import append_cases, run_campaign
from marsyard.campaigns.running.estimate import estimate_campaign
from marsyard.campaigns.running.progress import ProgressObserver
from marsyard.campaigns.running.replay import load_stored_campaign, replay_in_executor
from marsyard.campaigns.running.shards import SHARD_KEY, SHARD_STATE
from marsyard.campaigns.store import record
from marsyard.campaigns.store.lock import is_locked, replace_file
from marsyard.campaigns.store.products import case_directory, save_packed
from marsyard.campaigns.store.record import stored_definition
from marsyard.campaigns.store.table import TABLE_FILE, refresh_table, stored_row
from marsyard.cli.options import Exit, size_text
from marsyard.cli.showing import grid_table
from marsyard.reports.campaign import write_evaluation
from marsyard.reports.comparison import compare_algorithms, comparison_grids
from marsyard.reports.evaluation import Evaluation, evaluate_run, next_look, record_look
from marsyard.reports.overall import multiplicity_text
from marsyard.reports.presentation import notable_cases
from marsyard.reports.sampling_design import read_sampling_design
from marsyard.reports.statistics.proportions import minimum_sample_size, planned_looks
from marsyard.reports.stored import read_run
from marsyard.reports.tables import verdict_table
from marsyard.reports.verdicts import ESTIMATE, Verdict
from marsyard.reports.wording import count, format_fraction, primary_metric
from marsyard.sim.files import report_damage

#: Browsers that can print pages, in order of preference, and the time limit of printing.
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
_PRINT_TIMEOUT_S = 600.0
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
        console.print(verdict_table(verdicts))
    for table in _comparison_tables(evaluation.sampling.exclude_nominal_case(run.frame), run.requirements, verdicts):
        console.print(table)
    lines = [f"verdict: {evaluation.overall_verdict.word}", evaluation.overall_verdict.sentence]
    if is_finished and evaluation.overall_verdict.additional_cases:
        lines.append(f"to decide: marsyard append {directory} {evaluation.overall_verdict.additional_cases}")
    if multiplicity := multiplicity_text(verdicts):
        lines.append(multiplicity)
    if not any(verdict.withheld_status for verdict in verdicts):
        lines.append(f"evidence: {evaluation.evidence.text}")
    if run.unverified:
        lines.append(f"rows: not verified, since {run.unverified}")
    lines.append(f"report: {page}")
    if not is_finished:
        state = "killed" if stored["state"] == "running" else stored["state"]
        reason = f"the campaign was {state}; to continue: marsyard resume {directory}"
        if stored["state"] == SHARD_STATE:
            reason = f"shard {stored[SHARD_KEY]}; to combine all shards: marsyard merge DIR... --out DIR"
        reason = "the campaign is running" if is_locked(directory) else reason
        lines.insert(0, f"INCOMPLETE: {len(run.all_cases)} of {count(stored['cases'], 'case')}; {reason}")
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    # an unfinished campaign cannot meet its requirements: replace status 0
    return evaluation.exit_code if is_finished else evaluation.exit_code or Exit.INSUFFICIENT


def evaluate_and_store(directory: Path, requirements: Requirements | None = None) -> tuple[Evaluation, Path]:
    """Evaluate a campaign's rows and write its report; return the evaluation and the path of the report.

    The exit status of a finished campaign is stored in its record, unless `requirements` replace its requirements.
    Raises StoreError if the folder contains no campaign with rows, or the report cannot be written.
    """
    evaluation = evaluate_run(directory, requirements)
    if requirements is None and evaluation.run.recorded("state") == "finished":
        record.update(directory, {"exit_code": evaluation.exit_code})
        record_look(evaluation)
    with report_write_errors("the report"):
        return evaluation, write_evaluation(evaluation)


def _comparison_tables(frame: pd.DataFrame, requirements: Requirements, verdicts: Sequence[Verdict]) -> list[Table]:
    """Compare algorithms on the same cases; return no table for a single algorithm."""
    metric = primary_metric(frame, requirements)
    bound = next((item.bound for item in verdicts if item.metric == metric and math.isfinite(item.bound)), None)
    algorithms, differences = compare_algorithms(frame, metric, bound)
    if not algorithms:
        return []
    titles = ("Algorithms on the same cases", f"Compared with {algorithms[0].name}")
    grids = zip(titles, comparison_grids(algorithms, differences, metric), strict=True)
    return [grid_table(title, grid) for title, grid in grids if grid.rows]


def read_frame(directory: Path) -> pd.DataFrame:
    """Read the stored rows of a campaign. Raises StoreError if there is no table."""
    path = directory / TABLE_FILE
    if not path.is_file():
        raise StoreError(f"{directory} has no {TABLE_FILE}: the campaign is not finished")
    with report_damage(path, StoreError, "is not a valid table of cases"):
        return pd.read_parquet(path)


def write_csv(directory: Path) -> Path:
    """Write all rows as CSV in batches, atomically."""
    path = directory / "cases.csv"
    with report_write_errors(path), replace_file(path) as partial_path:
        table = pq.ParquetFile(directory / TABLE_FILE)
        with pa_csv.CSVWriter(partial_path, table.schema_arrow) as writer:
            for batch in table.iter_batches():
                writer.write_batch(batch)
    return path


def print_page(directory: Path) -> Path:
    """Print the report page `report.html` to `report.pdf` with a headless browser; return the path of the PDF."""
    browser = next((path for name in _BROWSERS if (path := shutil.which(name))), None)
    if browser is None:
        raise CampaignError(f"--pdf requires a browser; install chromium ({', '.join(_BROWSERS)})")
    target, page = ((directory / name).resolve() for name in ("report.pdf", "report.html"))
    with tempfile.TemporaryDirectory() as profile:
        command = [browser, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={profile}"]
        command += ["--no-pdf-header-footer", f"--print-to-pdf={target}", page.as_uri()]
        try:
            subprocess.run(command, check=True, capture_output=True, timeout=_PRINT_TIMEOUT_S)  # noqa: S603
        except (subprocess.SubprocessError, OSError) as error:
            raise CampaignError(f"{browser} failed to print {target}: {error}") from error
    return target


def rerun_notable_cases(directory: Path) -> None:
    """Rerun notable cases without stored products and store their products; report rows that differ.

    Raises CampaignError if the campaign's scenario or an algorithm cannot be imported.
    """
    run = read_run(directory)
    missing = [case for case in notable_cases(run) if case not in run.showcases]
    if not missing:
        return
    definition = stored_definition(directory)
    load_stored_campaign(directory, definition)
    with LocalExecutor(1) as workers:
        for case in missing:
            rerun = replay_in_executor(workers, definition, case, stored_row(directory, case))
            if rerun.products is None or rerun.failed:
                typer.echo(f"case {case}: rerun, but no images were produced")
                continue
            save_packed(case_directory(directory, case), rerun.products, rerun.row)
            differences = f"; the new row differs in: {', '.join(rerun.differing)}" if rerun.differing else ""
            typer.echo(f"case {case}: rerun for its images{differences}")


#: Maximum number of cases that are drawn to count their distinct terrains; the draws of a case take milliseconds.
_MAX_DRAWS = 5000


def evidence_limits(campaign: Campaign) -> list[str]:
    """Return the reasons why the strictest requirement cannot be PASS even without a failure; empty if it can.

    Each reason contains a remedy. Only requirements that are decided at a confidence are considered. The population is
    assumed to be all cases; a smaller population requires more cases.
    """
    definition = campaign.definition
    requirements = [item for item in definition.requirements if item.decide_by != ESTIMATE]
    design = read_sampling_design(definition.model_dump(mode="json"))
    if not requirements:
        return []
    if not design.independent:
        return [design.no_probability]
    strictest = max(requirements, key=lambda item: minimum_sample_size(item.probability, item.confidence))
    min_cases, cases = minimum_sample_size(strictest.probability, strictest.confidence), definition.total_cases
    requirement_text = f"{format_fraction(strictest.probability)} at {format_fraction(strictest.confidence)} confidence"
    limits = []
    if cases < min_cases:
        condition = f"{requirement_text} takes at least {count(min_cases, 'case')} without a failure"
        limits.append(f"{strictest.id}: {condition}; the campaign has {cases}.")
    terrain_supply = design.terrains
    if terrain_supply is None:
        return limits
    # number of distinct terrains: assigned in turn, or drawn at random
    terrains = min(cases, terrain_supply.terrains)
    path = next((path for path in ("location.terrain", "world.terrain") if path in definition.dispersions), None)
    if not terrain_supply.in_turn and path is not None and cases <= _MAX_DRAWS:
        terrains = len({campaign.draws(case)[path] for case in range(int(definition.design.nominal), cases)})
    # if several cases share a terrain, the evidence is limited by the number of terrains
    if terrains < min(cases, min_cases):
        limits.append(terrain_supply.advice(min_cases, strictest.probability, strictest.confidence))
    return limits


def print_estimate(campaign: Campaign, executor: ExecutorConfig) -> None:
    """Print the estimated time and disk space of a campaign."""
    workers = executor.jobs if executor.cluster is None else os.cpu_count() or 1
    estimate = estimate_campaign(campaign, workers)
    total = campaign.definition.total_cases
    low, high = estimate.case_range_s
    time_s = estimate.time_s
    duration = f"{time_s / 60.0:.0f} min" if time_s < 7200.0 else f"{time_s / 3600.0:.1f} h"
    duration = f"{time_s:.0f} s" if time_s < 120.0 else duration
    typer.echo(f"{count(total, 'case')} on {count(workers, 'worker')}: about {duration}")
    if estimate.inputs:
        typer.echo(f"  {count(estimate.inputs, 'terrain')} (shared inputs) to build, {estimate.input_s:.3g} s each")
    trials = count(estimate.trials, "trial case")
    typer.echo(f"  {estimate.case_s:.3g} s per case ({low:.3g} to {high:.3g} s in {trials})")
    if estimate.unfinished:
        typer.echo(f"  {estimate.unfinished} of the trial cases did not finish")
    rows, products = size_text(estimate.rows_bytes), size_text(estimate.products_bytes)
    typer.echo(f"disk: {rows} of rows, up to {products} of products")
    if estimate.inputs_bytes:
        limit = size_text(estimate.cache_limit_bytes)
        typer.echo(f"  {size_text(estimate.inputs_bytes)} of terrains in the cache (maximum {limit})")


def print_limits(campaign: Campaign) -> None:
    """Print which requirements of the campaign cannot be PASS, and the remedy (see `evidence_limits`)."""
    for limit in evidence_limits(campaign):
        typer.echo(f"note: {limit}")


def run_until_decided(
    campaign: Campaign, directory: Path, executor: ExecutorConfig, observer: ProgressObserver
) -> None:
    """Run a campaign until its verdicts are decided, with at most the configured number of cases.

    See `marsyard.reports.statistics.proportions`. Raises CampaignError for dependent draws, or if no requirement has a
    confidence level.
    """
    definition = campaign.definition
    design = read_sampling_design(definition.model_dump(mode="json"))
    if not design.independent:
        raise CampaignError(f"--until-decided: {design.no_probability}")
    if all(requirement.decide_by == ESTIMATE for requirement in definition.requirements):
        raise CampaignError("--until-decided: the campaign has no requirement with a confidence level")
    max_cases = definition.total_cases
    first_block = definition.model_copy(
        update={"cases": planned_looks(max_cases)[0].cases, "appended": (), "max_cases": max_cases}
    )
    command = (*campaign.command, "--until-decided")
    run_campaign(replace(campaign, definition=first_block, command=command), directory, executor, observer)
    continue_until_decided(directory, executor, observer)


def continue_until_decided(directory: Path, executor: ExecutorConfig, observer: ProgressObserver) -> None:
    """Append cases at the planned interim evaluations until the campaign is decided."""
    while True:
        definition = record.stored_definition(directory)
        if definition.max_cases is None:
            return
        evaluation, cases = evaluate_run(directory), definition.total_cases
        # a decided verdict that is withheld for its kind of evidence needs no further cases
        verdicts = [replace(item, status=item.withheld_status or item.status) for item in evaluation.verdicts]
        next_cases = next_look(verdicts, evaluation.sampling, cases)
        if next_cases is None:
            observer.note(f"stopped after {cases} of at most {count(definition.max_cases, 'case')}")
            return
        append_cases(directory, next_cases - cases, executor, observer)
