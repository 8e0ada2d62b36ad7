"""`marsyard nightly`: run a plan's campaigns and compare their figures with those of earlier nights."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from marsyard.cli.campaign import make_executor, stopped_by_signals
from marsyard.cli.options import Exit, JobsOption, console, handle_user_errors


@handle_user_errors
def nightly(
    plan: Annotated[Path | None, Argument(metavar="[PLAN.toml]", help="The plan; by default the built-in one.")] = None,
    out: Annotated[Path, Option(metavar="DIR", help="Folder of history, runs, page and dashboard.")] = Path("nightly"),
    jobs: JobsOption = None,
) -> None:
    """Run the plan's campaigns, compare each figure with the nights before, write nightly.md and the dashboard.

    Exit status: as of the campaigns, the worst; 1 also for a regression, or a campaign that could not be run.
    """
    from marsyard.campaigns.errors import writing
    from marsyard.campaigns.store.record import folder_lock, git_commit
    from marsyard.cli import nightly_plan as plans
    from marsyard.cli.progress import campaign_progress
    from marsyard.reports.history import FINISHED, INTERRUPTED, History, changes, compare_night

    path = plan or plans.PLAN_FILE
    stated, executor = plans.read_plan(path), make_executor(jobs, None)
    with writing(out):
        (out / plans.RUNS).mkdir(parents=True, exist_ok=True)
    with folder_lock(out), History(out / plans.HISTORY_FILE) as history:
        night = history.begin(git_commit())
        # the page of a night that is killed
        plans.write_page(history, night, out, ())
        try:
            with stopped_by_signals(), campaign_progress(console(stderr=True)) as watch:
                for one in stated.campaigns:
                    plans.run_planned(plans.Night(history, night, out, executor, stated), one, path.parent, watch)
        except KeyboardInterrupt:
            history.finish(night, INTERRUPTED)
            plans.publish(history, night, out, ())
            raise typer.Exit(Exit.INTERRUPTED) from None
        found = changes(compare_night(history, night))
        history.finish(night, FINISHED, [(one.campaign, one.figure, one.p_value, one.worse) for one in found])
        plans.publish(history, night, out, found)
        statuses = {one.exit_code for one in history.campaigns(night)}
    statuses |= {int(Exit.FAILED) for one in found if one.worse}
    raise typer.Exit(next((one for one in (Exit.FAILED, Exit.INSUFFICIENT) if one in statuses), Exit.MET))
