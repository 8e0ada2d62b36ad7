"""`marsyard nightly`: run a plan's campaigns and compare their figures with those of earlier nights."""

from __future__ import annotations

import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from marsyard.cli.campaign import make_executor, stopped_by_signals
from marsyard.cli.options import Exit, JobsOption, console, handle_user_errors

if TYPE_CHECKING:
    from marsyard.campaigns.execution.workers import ExecutorConfig
    from marsyard.campaigns.running.engine import Watch
    from marsyard.cli.nightly_plan import Plan, PlannedCampaign
    from marsyard.reports.history import Change, History, NightCampaign

#: What a nightly's folder holds.
HISTORY_FILE, PAGE_FILE, RUNS, SITE = "history.sqlite", "nightly.md", "runs", "site"
#: Verdict of a campaign that could not be run at all.
NOT_RUN = "NOT RUN"


@handle_user_errors
def nightly(
    plan: Annotated[Path | None, Argument(metavar="[PLAN.toml]", help="The plan; by default the built-in one.")] = None,
    out: Annotated[Path, Option("--out", metavar="DIR", help="Folder of history, runs, page and dashboard.")] = Path(
        "nightly"
    ),
    jobs: JobsOption = None,
) -> None:
    """Run the plan's campaigns, compare each figure with the nights before, write nightly.md and the dashboard.

    Exit status: as of the campaigns, the worst; 1 also for a regression, or a campaign that could not be run.
    """
    from marsyard.campaigns.errors import writing
    from marsyard.campaigns.store.record import folder_lock, git_commit
    from marsyard.cli.nightly_plan import PLAN_FILE, read_plan
    from marsyard.cli.progress import campaign_progress
    from marsyard.reports.history import FINISHED, INTERRUPTED, History

    path = plan or PLAN_FILE
    stated, executor = read_plan(path), make_executor(jobs, None)
    with writing(out):
        (out / RUNS).mkdir(parents=True, exist_ok=True)
    with folder_lock(out), History(out / HISTORY_FILE) as history:
        night = history.begin(git_commit())
        # the page of a night that is killed
        _write_page(history, night, out, ())
        try:
            with stopped_by_signals(), campaign_progress(console(stderr=True)) as watch:
                for one in stated.campaigns:
                    _run_one(_Night(history, night, out, executor, stated), one, path.parent, watch)
        except KeyboardInterrupt:
            history.finish(night, INTERRUPTED)
            _publish(history, night, out, ())
            raise typer.Exit(Exit.INTERRUPTED) from None
        found = _changes(history, night)
        history.finish(night, FINISHED, [(one.campaign, one.figure, one.p_value, one.worse) for one in found])
        _publish(history, night, out, found)
        status = _status(history.campaigns(night), found)
    raise typer.Exit(status)


class _Night:
    """A night in progress."""

    def __init__(self, history: History, night: int, out: Path, executor: ExecutorConfig, plan: Plan) -> None:
        self.history, self.night, self.out, self.executor, self.plan = history, night, out, executor, plan


def _run_one(now: _Night, planned: PlannedCampaign, folder: Path, watch: Watch) -> None:
    """Run a campaign, judge it, and store its figures; its errors do not affect the others."""
    from marsyard.campaigns.errors import CampaignError
    from marsyard.campaigns.running.engine import run_campaign
    from marsyard.cli.nightly_plan import definition_of
    from marsyard.cli.outcome import settle
    from marsyard.reports.comparison import figures_of, sample_of
    from marsyard.reports.history import NightCampaign, NightFigure

    try:
        campaign = planned.load(now.plan.seed, now.night, folder)
        name = campaign.configuration.name
        directory = now.out / RUNS / f"night-{now.night:05d}-{name}"
        run_campaign(campaign, directory, now.executor, watch)
        found, _ = settle(directory)
        frame, figures = figures_of(found.run)
        kept = [NightFigure(one.name, one.larger_is_better, one.level, sample_of(frame, one)) for one in figures]
        whole = found.whole
        result = NightCampaign(
            name, definition_of(campaign), directory.name, whole.word, found.exit_code, whole.sentence
        )
    except Exception as error:  # a defect in one campaign must not cost the night its others
        kept = []
        if not isinstance(error, CampaignError):
            traceback.print_exc()
        result = NightCampaign(planned.campaign, "", "", NOT_RUN, Exit.FAILED, f"{type(error).__name__}: {error}")
    now.history.add(now.night, result, kept)


def _changes(history: History, night: int) -> list[Change]:
    from marsyard.reports.history import changes, compare_night

    return changes(compare_night(history, night))


def _publish(history: History, night: int, out: Path, found: Sequence[Change]) -> None:
    """Write the page and the dashboard, and print the page."""
    from marsyard.reports.dashboard.site import write_site

    text = _write_page(history, night, out, found)
    write_site(out / SITE, [out / RUNS])
    typer.echo(text)


def _write_page(history: History, night: int, out: Path, found: Sequence[Change]) -> str:
    """Write the page of the night so far, and return it."""
    from marsyard.reports.campaign import write_whole
    from marsyard.reports.history import compare_night, night_text

    nights = history.nights()
    now = next(one for one in nights if one.night == night)
    earlier = [one for one in nights if one.night < night]
    compared = sum(bool(one.before) for one in compare_night(history, night))
    text = night_text(now, earlier, history.campaigns(night), found, compared)
    write_whole(out / PAGE_FILE, text)
    return text


def _status(campaigns: Sequence[NightCampaign], found: Sequence[Change]) -> int:
    statuses = {one.exit_code for one in campaigns} | {int(Exit.FAILED) for one in found if one.worse}
    return next((status for status in (Exit.FAILED, Exit.INSUFFICIENT) if status in statuses), Exit.MET)
