"""`marsyard report`, `compare`, `dashboard` and `nightly`: verdicts, differences, a static site, and planned runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from marsyard.cli.campaign import make_executor, stop_on_signals
from marsyard.cli.options import DirectoryArgument, Exit, JobsOption, JsonOption, console, handle_user_errors

LOOPBACK = "127.0.0.1"


@handle_user_errors
def report(
    directory: DirectoryArgument,
    requirements: Annotated[
        Path | None, Option(metavar="FILE", help="Use this file's requirements for the campaign, not its own.")
    ] = None,
    pdf: Annotated[bool, Option("--pdf", help="Also print the page to report.pdf (needs Chromium).")] = False,
    csv: Annotated[bool, Option("--csv", help="Also write all rows to cases.csv.")] = False,
    gallery: Annotated[
        bool,
        Option("--gallery", help="First rerun the worst, some unanswered and some random cases for their pictures."),
    ] = False,
) -> None:
    """Evaluate a campaign from its stored rows, complete or not, and write its report.

    Cases are rerun for --gallery only.
    """
    from marsyard.campaigns.definition.requirements import read_requirements, select_applicable
    from marsyard.campaigns.errors import CampaignError
    from marsyard.campaigns.store import record
    from marsyard.cli import outcome

    if gallery:
        outcome.rerun_notable_cases(directory)
    asked = None
    if requirements is not None:
        name = str(record.read(directory)["name"])
        asked = select_applicable(read_requirements(requirements), name)
        if not asked:
            raise CampaignError(f"{requirements}: no requirement names the campaign '{name}' in its campaigns")
    status = outcome.conclude(directory, console(), asked)
    if csv:
        typer.echo(f"rows: {outcome.write_csv(directory)}")
    if pdf:
        typer.echo(f"pdf: {outcome.print_page(directory)}")
    raise typer.Exit(status)


@handle_user_errors
def compare(
    first: Annotated[Path, Argument(metavar="DIR", help="Folder of a campaign that was run.")],
    second: Annotated[Path, Argument(metavar="DIR", help="Folder of another.")],
    as_json: JsonOption = False,
) -> None:
    """Compare two stored campaigns: success, answers and errors, with tests of their differences.

    Exit status 0 in any case: a difference is not a verdict.
    """
    from marsyard.cli.showing import grid_table
    from marsyard.reports import comparison
    from marsyard.reports.stored import read_run

    runs = [read_run(directory) for directory in (first, second)]
    paired, differences = comparison.compare_campaigns(*runs)
    names, same_terrains = [str(run.directory) for run in runs], comparison.have_same_terrains(*runs)
    if as_json:
        data = {"first": names[0], "second": names[1], "paired": paired, "same_terrains": same_terrains}
        typer.echo(json.dumps({**data, "figures": comparison.campaign_diff_data(differences)}, indent=2))
        return
    out = console()
    out.print(grid_table("Side by side", comparison.campaign_diff_grid(["first", "second"], differences)))
    out.print(f"first: {names[0]}\nsecond: {names[1]}", markup=False, highlight=False, soft_wrap=True)
    grounds = "terrain by terrain" if same_terrains else "terrains of their own against one another"
    how = "the same draws, compared in pairs" if paired else f"draws of their own, compared {grounds}"
    out.print(f"Cases: {how}. p: two-sided, corrected for the number of figures (Holm).", soft_wrap=True)


@handle_user_errors
def dashboard(
    directories: Annotated[
        list[Path], Argument(metavar="DIR...", help="Folders of campaigns, or their parent folders.")
    ],
    out: Annotated[Path, Option(metavar="DIR", help="The site's folder.")] = Path("site"),
    requirements: Annotated[Path | None, Option(metavar="FILE", help="Requirements to show in place of ours.")] = None,
    serve: Annotated[int | None, Option(metavar="PORT", help="Serve the site on this machine only.", min=0)] = None,
    host: Annotated[str, Option(metavar="ADDRESS", help="With --serve: address to listen on.")] = LOOPBACK,
) -> None:
    """Write a dashboard over stored campaigns: requirements, latest verdicts, trends, pages of campaigns and cases."""
    from marsyard.campaigns.definition.requirements import read_requirements
    from marsyard.campaigns.errors import CampaignError, report_write_errors
    from marsyard.reports.dashboard.site import write_site

    missing = [str(one) for one in directories if not one.is_dir()]
    if missing:
        raise CampaignError(f"no such folder: {', '.join(missing)}")
    stated = None if requirements is None else {one.id: one for one in read_requirements(requirements)}
    with report_write_errors(out):
        site = write_site(out, directories, stated)
    for problem in site.problems:
        typer.echo(f"not shown: {problem}", err=True)
    typer.echo(f"campaigns: {site.campaigns}")
    typer.echo(f"dashboard: {site.index}")
    if serve is None:
        return
    from marsyard.cli.outcome import server

    try:
        serving = server(out, host, serve)
    except (OSError, OverflowError) as error:
        raise CampaignError(f"--serve {serve}: {error}") from error
    with serving:
        typer.echo(f"serving: http://{host}:{serving.server_port}/ (Ctrl-C ends it)")
        try:
            serving.serve_forever()
        except KeyboardInterrupt:
            typer.echo("ended")


@handle_user_errors
def nightly(
    plan: Annotated[Path | None, Argument(metavar="[PLAN.toml]", help="The plan; by default the built-in one.")] = None,
    out: Annotated[Path, Option(metavar="DIR", help="Folder of history, runs, page and dashboard.")] = Path("nightly"),
    jobs: JobsOption = None,
) -> None:
    """Run the plan's campaigns, compare each figure with the nights before, write nightly.md and the dashboard.

    Exit status: as of the campaigns, the worst; 1 also for a regression, or a campaign that could not be run.
    """
    from marsyard.campaigns.errors import report_write_errors
    from marsyard.campaigns.store.record import folder_lock, git_commit
    from marsyard.cli import nightly_plan as plans
    from marsyard.cli.progress import campaign_progress
    from marsyard.reports.history import FINISHED, INTERRUPTED, History, changes, compare_night

    path = plan or plans.PLAN_FILE
    stated, executor = plans.read_plan(path), make_executor(jobs, None)
    with report_write_errors(out):
        (out / plans.RUNS).mkdir(parents=True, exist_ok=True)
    with folder_lock(out), History(out / plans.HISTORY_FILE) as history:
        night = history.begin(git_commit())
        # the page of a night that is killed
        plans.write_page(history, night, out, ())
        try:
            with stop_on_signals(), campaign_progress(console(stderr=True)) as watch:
                for one in stated.campaigns:
                    plans.run_planned(plans.Night(history, night, out, executor, stated), one, path.parent, watch)
        except KeyboardInterrupt:
            history.finish(night, INTERRUPTED)
            plans.publish(history, night, out, ())
            raise typer.Exit(Exit.INTERRUPTED) from None
        flagged = changes(compare_night(history, night))
        history.finish(night, FINISHED, [(one.campaign, one.figure, one.p_value, one.worse) for one in flagged])
        plans.publish(history, night, out, flagged)
        statuses = {one.exit_code for one in history.campaigns(night)}
    statuses |= {int(Exit.FAILED) for one in flagged if one.worse}
    raise typer.Exit(next((one for one in (Exit.FAILED, Exit.INSUFFICIENT) if one in statuses), Exit.MET))
