"""Command `marsyard nightly`: run the planned campaigns and compare them with earlier nights."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from marsyard.cli import options
from marsyard.cli.errors import Exit, handle_user_errors
from marsyard.cli.execution import make_executor, stop_on_signals
from marsyard.cli.terminal import create_console


@handle_user_errors
def nightly(
    plan: Annotated[
        Path | None, Argument(metavar="PLAN.toml", help="Plan of campaigns; by default the built-in plan.")
    ] = None,
    out: Annotated[Path, Option(metavar="DIR", help="Folder of history, runs, nightly.md and dashboard.")] = Path(
        "nightly"
    ),
    jobs: options.JobsOption = None,
) -> None:
    """Run the planned campaigns, compare each metric with previous nightly runs, write nightly.md and the dashboard.

    Exit status: 1 if a requirement or a check failed, a case crashed, a metric regressed or a campaign could not be
    run; otherwise 3 if a requirement is undecided; otherwise 0.
    """
    from marsyard.campaigns.errors import report_write_errors
    from marsyard.campaigns.store.git_history import git_commit
    from marsyard.campaigns.store.lock import folder_lock
    from marsyard.cli import nightly_run
    from marsyard.cli.progress import campaign_progress
    from marsyard.reports.night_history import FINISHED, INTERRUPTED, History
    from marsyard.reports.nightly import find_changes, list_comparisons

    path = plan or nightly_run.PLAN_FILE
    plan_definition, executor = nightly_run.read_plan(path), make_executor(jobs, None)
    with report_write_errors(out):
        (out / nightly_run.RUNS).mkdir(parents=True, exist_ok=True)
    with folder_lock(out), History(out / nightly_run.HISTORY_FILE) as history:
        night = history.begin(git_commit())
        # write a first page in case this run is killed
        nightly_run.write_page(history, night, out, ())
        try:
            with stop_on_signals(), campaign_progress(create_console(stderr=True)) as observer:
                run = nightly_run.NightlyRun(history, night, out, executor, plan_definition)
                for entry in plan_definition.campaigns:
                    nightly_run.run_scheduled_campaign(run, entry, path.parent, observer)
                for check in plan_definition.checks:
                    nightly_run.run_check(run, check, path.parent)
        except KeyboardInterrupt:
            history.finish(night, INTERRUPTED)
            nightly_run.publish_page(history, night, out, ())
            raise typer.Exit(Exit.INTERRUPTED) from None
        changes = find_changes(list_comparisons(history, night))
        history.finish(night, FINISHED, changes)
        nightly_run.publish_page(history, night, out, changes)
        statuses = {campaign.exit_code for campaign in history.campaigns(night)}
    statuses |= {int(Exit.FAILED) for change in changes if change.is_regression}
    raise typer.Exit(next((status for status in (Exit.FAILED, Exit.INSUFFICIENT) if status in statuses), Exit.MET))
