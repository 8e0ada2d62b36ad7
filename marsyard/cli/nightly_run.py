"""One night of `marsyard nightly`: run the campaigns and checks of the plan, and write the page and the dashboard."""

import os
import signal
import subprocess
import traceback
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import typer

from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.running.engine import run_campaign
from marsyard.campaigns.running.progress import ProgressObserver
from marsyard.campaigns.store.temporary_files import write_atomic
from marsyard.cli.errors import Exit
from marsyard.cli.nightly_plan import Plan, PlannedCampaign, PlannedCheck, hash_definition
from marsyard.cli.outcome import evaluate_and_store
from marsyard.reports.campaign_diff import list_metrics
from marsyard.reports.dashboard.site import write_site
from marsyard.reports.nightly import History, MetricChange, NightCampaign, format_night_page, list_comparisons

#: Files and folders in the output folder of `marsyard nightly`.
HISTORY_FILE, PAGE_FILE, RUNS, SITE = "history.sqlite", "nightly.md", "runs", "site"
#: Verdict of a campaign that could not be run.
NOT_RUN = "NOT RUN"


@dataclass(frozen=True)
class NightlyRun:
    """A nightly run in progress: history, number of the night, output folder, executor and plan."""

    history: History
    number: int
    out: Path
    executor: ExecutorConfig
    plan: Plan


def run_scheduled_campaign(run: NightlyRun, entry: PlannedCampaign, folder: Path, observer: ProgressObserver) -> None:
    """Run a campaign, evaluate it, and store its metrics; its errors do not affect the other campaigns."""
    try:
        campaign = entry.load(run.plan.seed, run.number, folder)
        name = campaign.definition.name
        directory = run.out / RUNS / f"night-{run.number:05d}-{name}"
        run_campaign(campaign, directory, run.executor, observer)
        evaluation, _ = evaluate_and_store(directory)
        _, night_metrics = list_metrics(evaluation.run)
        verdict, definition = evaluation.overall_verdict, hash_definition(campaign)
        result = NightCampaign(name, definition, directory.name, verdict.word, evaluation.exit_code, verdict.sentence)
    except Exception as error:  # a defect in one campaign must not stop the others
        night_metrics = []
        if not isinstance(error, CampaignError):
            traceback.print_exc()
        result = NightCampaign(entry.campaign, "", "", NOT_RUN, Exit.FAILED, f"{type(error).__name__}: {error}")
    run.history.add(run.number, result, night_metrics)


def run_check(run: NightlyRun, check: PlannedCheck, folder: Path) -> None:
    """Run a check, store its output next to the campaigns, and store its verdict: PASS for the exit code 0."""
    log, name = run.out / RUNS / f"night-{run.number:05d}-{check.name}.log", f"check: {check.name}"
    try:
        with log.open("wb") as output:
            # the plan's author chooses the command, as in a crontab; its session contains all its processes
            process = subprocess.Popen(  # noqa: S603
                check.command,
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            try:
                code = process.wait(check.time_limit_s)
            finally:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()
    except (OSError, subprocess.TimeoutExpired) as error:
        result = NightCampaign(name, "", "", NOT_RUN, Exit.FAILED, str(error))
    else:
        lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        sentence = f"exit code {code}: {lines[-1] if lines else 'no output'}; log: {RUNS}/{log.name}"
        verdict, status = ("PASS", Exit.MET) if code == 0 else ("FAIL", Exit.FAILED)
        result = NightCampaign(name, "", "", verdict, status, sentence)
    run.history.add(run.number, result, [])


def publish_page(history: History, night: int, out: Path, changes: Sequence[MetricChange]) -> None:
    """Write the page and the dashboard, and print the page."""
    text = write_page(history, night, out, changes)
    write_site(out / SITE, [out / RUNS])
    typer.echo(text)


def write_page(history: History, night: int, out: Path, changes: Sequence[MetricChange]) -> str:
    """Write the page with the results of the night so far, and the significant changes; return its text."""
    nights = {record.night: record for record in history.nights()}
    earlier_nights = [record for number, record in nights.items() if number < night]
    n_comparisons = sum(bool(comparison.before) for comparison in list_comparisons(history, night))
    text = format_night_page(nights[night], earlier_nights, history.campaigns(night), changes, n_comparisons)
    write_atomic(out / PAGE_FILE, text)
    return text
