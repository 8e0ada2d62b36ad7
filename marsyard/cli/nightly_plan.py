"""A nightly's plan, and the run of its campaigns in one night."""

from __future__ import annotations

import hashlib
import json
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from pydantic import Field, model_validator

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.configuration import MAX_CASES, read_table
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.workers import ExecutorConfig
from marsyard.campaigns.running.engine import Watch, run_campaign
from marsyard.cli.options import Exit
from marsyard.cli.outcome import settle
from marsyard.reports.campaign import write_whole
from marsyard.reports.comparison import build_sample, list_figures
from marsyard.reports.dashboard.site import write_site
from marsyard.reports.history import Change, History, NightCampaign, NightFigure, compare_night, night_text
from marsyard.sim.parameters import Parameters

#: Files and folders of a nightly's folder.
HISTORY_FILE, PAGE_FILE, RUNS, SITE = "history.sqlite", "nightly.md", "runs", "site"
#: Verdict of a campaign that could not be run at all.
NOT_RUN = "NOT RUN"

#: The plan that ships with Marsyard.
PLAN_FILE = Path(__file__).resolve().parents[1] / "scenarios" / "nightly.toml"

Texts = Annotated[tuple[str, ...], Field(strict=False)]


class PlannedCampaign(Parameters):
    """A campaign of the plan, with values that replace those of its file."""

    campaign: Annotated[str, Field(min_length=1)]
    cases: Annotated[int, Field(strict=True, ge=1, le=MAX_CASES)] | None = None
    override: Texts = Field(default=(), alias="set")
    algorithms: Texts = ()

    def load(self, seed: int, night: int, folder: Path) -> Campaign:
        """The campaign as it runs in a night: paths are from the plan's folder, the root seed is the night's own."""
        path = folder / self.campaign
        name = str(path) if path.is_file() else self.campaign
        return load_campaign(name, self.override, self.cases, night_seed(seed, night), self.algorithms)


class Plan(Parameters):
    """Campaigns of every night."""

    seed: Annotated[int, Field(strict=True, ge=0, le=2**63 - 1)] = Field(
        default=0, description="of which each night's root seed is made, so that nights draw cases of their own"
    )
    campaigns: Annotated[tuple[PlannedCampaign, ...], Field(strict=False, min_length=1)]

    @model_validator(mode="after")
    def _check_names(self) -> Plan:
        names = [one.campaign for one in self.campaigns]
        if len(set(names)) < len(names):
            raise ValueError("a campaign is named twice; give it a file and a name of its own")
        return self


def read_plan(path: Path) -> Plan:
    """Read the plan in a file. Raises ConfigurationError where it cannot be read or is not valid."""
    return read_table(path, Plan)


def night_seed(seed: int, night: int) -> int:
    """The root seed of a night."""
    digest = hashlib.sha256(f"{seed}:{night}".encode()).digest()
    return int.from_bytes(digest[:7], "little")


def campaign_definition(campaign: Campaign) -> str:
    """Hash a campaign's definition without seed and texts: nights are compared where it is the same."""
    excluded = {"seed", "description", "retain", "limits", "cases"}
    stated = campaign.configuration.model_dump(mode="json", exclude=excluded)
    return hashlib.sha256(json.dumps(stated, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class Night:
    """A night in progress."""

    history: History
    number: int
    out: Path
    executor: ExecutorConfig
    plan: Plan


def run_planned(now: Night, planned: PlannedCampaign, folder: Path, watch: Watch) -> None:
    """Run a campaign, evaluate it, and store its figures; its errors do not affect the others."""
    figures = []
    try:
        campaign = planned.load(now.plan.seed, now.number, folder)
        name = campaign.configuration.name
        directory = now.out / RUNS / f"night-{now.number:05d}-{name}"
        run_campaign(campaign, directory, now.executor, watch)
        found, _ = settle(directory)
        frame, compared = list_figures(found.run)
        figures = [NightFigure(one.name, one.larger_is_better, one.level, build_sample(frame, one)) for one in compared]
        verdict, definition = found.whole, campaign_definition(campaign)
        result = NightCampaign(name, definition, directory.name, verdict.word, found.exit_code, verdict.sentence)
    except Exception as error:  # a defect in one campaign must not stop the others
        figures = []
        if not isinstance(error, CampaignError):
            traceback.print_exc()
        result = NightCampaign(planned.campaign, "", "", NOT_RUN, Exit.FAILED, f"{type(error).__name__}: {error}")
    now.history.add(now.number, result, figures)


def publish(history: History, night: int, out: Path, found: Sequence[Change]) -> None:
    """Write the page and the dashboard, and print the page."""
    text = write_page(history, night, out, found)
    write_site(out / SITE, [out / RUNS])
    typer.echo(text)


def write_page(history: History, night: int, out: Path, found: Sequence[Change]) -> str:
    """Write the page of the night so far, and return it."""
    nights = {one.night: one for one in history.nights()}
    earlier = [one for number, one in nights.items() if number < night]
    compared = sum(bool(one.before) for one in compare_night(history, night))
    text = night_text(nights[night], earlier, history.campaigns(night), found, compared)
    write_whole(out / PAGE_FILE, text)
    return text
