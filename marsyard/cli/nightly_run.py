"""One night of `marsyard nightly`: read the plan, run its campaigns and checks, and write page and dashboard."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import traceback
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from pydantic import Field, model_validator

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import MAX_CASES
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.definition.toml_models import read_model
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.running.engine import run_campaign
from marsyard.campaigns.running.progress import ProgressObserver
from marsyard.campaigns.store.temporary_files import write_atomic
from marsyard.cli.errors import Exit
from marsyard.cli.outcome import evaluate_and_store
from marsyard.reports.dashboard.site import write_site
from marsyard.reports.metrics import list_metrics
from marsyard.reports.night_history import History, MetricChange, NightCampaign
from marsyard.reports.nightly import format_night_page, list_comparisons
from marsyard.sim.parameters import Parameters

#: The plan that is installed with Marsyard.
PLAN_FILE = Path(__file__).resolve().parents[1] / "scenarios" / "nightly.toml"

#: Files and folders in the output folder of `marsyard nightly`.
HISTORY_FILE, PAGE_FILE, RUNS, SITE = "history.sqlite", "nightly.md", "runs", "site"
#: Verdict of a campaign that could not be run.
NOT_RUN = "NOT RUN"
Texts = Annotated[tuple[str, ...], Field(strict=False)]


class PlannedCampaign(Parameters):
    """One campaign of the plan, with values that override its campaign file."""

    campaign: Annotated[str, Field(min_length=1)]
    cases: Annotated[int, Field(strict=True, ge=1, le=MAX_CASES)] | None = None
    override: Texts = Field(default=(), alias="set")
    algorithms: Texts = ()

    def load(self, seed: int, night: int, folder: Path) -> Campaign:
        """Load the campaign with the root seed of a night; relative paths start in `folder`, the folder of the plan."""
        path = folder / self.campaign
        name = str(path) if path.is_file() else self.campaign
        return load_campaign(name, self.override, self.cases, night_seed(seed, night), self.algorithms)


class PlannedCheck(Parameters):
    """A program to run each night after the campaigns, in the folder of the plan: speed benchmarks, for example."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][\w.-]*$", description="name on the page, and of its log file")]
    command: Annotated[tuple[str, ...], Field(strict=False, min_length=1, description="program and its arguments")]
    time_limit_s: Annotated[float, Field(gt=0.0)] = 3600.0


class Plan(Parameters):
    """Plan of the campaigns and checks to run each night, read from a TOML file."""

    seed: Annotated[int, Field(strict=True, ge=0, le=2**63 - 1)] = Field(
        default=0, description="seed from which the root seed of each night is derived: each night draws new cases"
    )
    campaigns: Annotated[tuple[PlannedCampaign, ...], Field(strict=False, min_length=1)]
    checks: Annotated[tuple[PlannedCheck, ...], Field(strict=False)] = ()

    @model_validator(mode="after")
    def _check_names(self) -> Plan:
        names = [entry.campaign for entry in self.campaigns]
        if len(set(names)) < len(names):
            raise ValueError("the plan contains a campaign twice; copy it to a second file with another name")
        if len({check.name for check in self.checks}) < len(self.checks):
            raise ValueError("the name of a check is used twice")
        return self


def read_plan(path: Path) -> Plan:
    """Read the plan from a file. Raises DefinitionError if the file is not readable or not valid."""
    return read_model(path, Plan)


def night_seed(seed: int, night: int) -> int:
    """Derive the root seed of a night (56 bits) by hashing the plan's seed and the night's number."""
    digest = hashlib.sha256(f"{seed}:{night}".encode()).digest()
    return int.from_bytes(digest[:7], "little")


def hash_definition(campaign: Campaign) -> str:
    """Hash a campaign's definition; only nights with equal definitions are compared.

    Seed, description, retained products, limits and number of cases are excluded.
    """
    excluded_keys = {"seed", "description", "retain", "limits", "cases"}
    definition = campaign.definition.model_dump(mode="json", exclude=excluded_keys)
    return hashlib.sha256(json.dumps(definition, sort_keys=True).encode()).hexdigest()


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
