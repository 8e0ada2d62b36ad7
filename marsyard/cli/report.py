"""Commands `marsyard report`, `confirmations`, `compare`, `dashboard`, `nightly`: evaluate, publish, schedule runs."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from marsyard.cli import options
from marsyard.cli.console import create_console
from marsyard.cli.errors import Exit, handle_user_errors
from marsyard.cli.execution import make_executor, stop_on_signals

LOOPBACK_ADDRESS = "127.0.0.1"


@handle_user_errors
def report(
    directory: options.DirectoryArgument,
    requirements: Annotated[
        Path | None, Option(metavar="FILE", help="Requirements file to use instead of those of the campaign.")
    ] = None,
    pdf: Annotated[bool, Option("--pdf", help="Also print the report to report.pdf (requires Chromium).")] = False,
    csv: Annotated[bool, Option("--csv", help="Also write all rows to cases.csv.")] = False,
    gallery: Annotated[
        bool,
        Option(
            "--gallery", help="First run some cases again to store their images: largest errors, no answer, and random."
        ),
    ] = False,
    trust: options.TrustOption = False,
) -> None:
    """Evaluate the stored results of a campaign, and write its report; an interrupted campaign is also accepted.

    No case is run, except for --gallery.
    """
    from marsyard.campaigns.definition.requirements import read_requirements, select_applicable
    from marsyard.campaigns.errors import CampaignError
    from marsyard.campaigns.store import record
    from marsyard.campaigns.store.origin import adopt
    from marsyard.cli import outcome

    if trust:
        adopt(directory)
    if gallery:
        outcome.rerun_gallery_cases(directory)
    applicable_requirements = None
    if requirements is not None:
        name = str(record.read(directory)["name"])
        applicable_requirements = select_applicable(read_requirements(requirements), name)
        if not applicable_requirements:
            raise CampaignError(f"{requirements}: no requirement lists the campaign '{name}' in its campaigns")
    status = outcome.evaluate_and_report(directory, create_console(), applicable_requirements)
    if csv:
        typer.echo(f"rows: {outcome.write_csv(directory)}")
    if pdf:
        typer.echo(f"pdf: {outcome.print_page(directory)}")
    raise typer.Exit(status)


@handle_user_errors
def confirmations(
    file: Annotated[Path, Argument(metavar="FILE", help="Record of the confirmations.")] = options.CONFIRMATIONS,
    create: Annotated[bool, Option("--create", help="Create an empty record, to be committed to git.")] = False,
    as_json: options.JsonOption = False,
) -> None:
    """List confirmations: evaluations of frozen algorithms on unseen seeds (`run --confirm`), with their results."""
    from marsyard.campaigns.errors import CampaignError
    from marsyard.campaigns.store.confirmation_record import read_record
    from marsyard.campaigns.store.confirmations import create_record
    from marsyard.campaigns.store.git_registration import find_registration_problem
    from marsyard.reports.terminal_tables import confirmations_table

    if create:
        create_record(file)
        typer.echo(f"record: {file}; to register it: git add {file} && git commit")
        return
    if not file.is_file():
        raise CampaignError(f"{file}: no such file; `marsyard confirmations --create` creates it")
    entries = read_record(file).confirmations
    if as_json:
        typer.echo(json.dumps([asdict(entry) for entry in entries], indent=2))
    else:
        create_console().print(confirmations_table(entries))
        typer.echo(f"record: {find_registration_problem(file) or 'registered'}")


@handle_user_errors
def compare(
    first: Annotated[Path, Argument(metavar="DIR", help="Folder of the first campaign.")],
    second: Annotated[Path, Argument(metavar="DIR", help="Folder of the second campaign.")],
    as_json: options.JsonOption = False,
) -> None:
    """Compare two stored campaigns: success rate, availability and errors, with significance tests of the differences.

    The exit status is 0 even if the campaigns differ.
    """
    from marsyard.campaigns.errors import CampaignError
    from marsyard.cli.showing import grid_table
    from marsyard.reports import campaign_diff
    from marsyard.reports.stored import read_run

    runs = [read_run(directory) for directory in (first, second)]
    for run in runs:
        if run.recorded("study"):
            raise CampaignError(f"{run.directory} contains a study: its cases are chosen, so rates cannot be compared")
    is_paired, differences = campaign_diff.compare_campaigns(*runs)
    names, have_same_terrains = [str(run.directory) for run in runs], campaign_diff.have_same_terrains(*runs)
    if as_json:
        data = {"first": names[0], "second": names[1], "paired": is_paired, "same_terrains": have_same_terrains}
        typer.echo(json.dumps({**data, "figures": campaign_diff.campaign_diff_data(differences)}, indent=2))
        return
    out = create_console()
    out.print(grid_table("Side by side", campaign_diff.campaign_diff_grid(["first", "second"], differences)))
    out.print(f"first: {names[0]}\nsecond: {names[1]}", markup=False, highlight=False, soft_wrap=True)
    terrains = "the same terrains: comparison by terrain" if have_same_terrains else "different terrains: unpaired"
    method = "same draws: paired comparison" if is_paired else f"different draws on {terrains}"
    out.print(f"Cases: {method}. p: two-sided, corrected for the number of metrics (Holm).", soft_wrap=True)


@handle_user_errors
def dashboard(
    directories: Annotated[
        list[Path], Argument(metavar="DIR...", help="Folders of campaigns, or their parent folders.")
    ],
    out: Annotated[Path, Option(metavar="DIR", help="Folder of the dashboard.")] = Path("site"),
    requirements: Annotated[
        Path | None, Option(metavar="FILE", help="Requirements file to use instead of the built-in requirements.")
    ] = None,
    serve: Annotated[
        int | None, Option(metavar="PORT", help="Also serve the dashboard over HTTP on this port.", min=0)
    ] = None,
    host: Annotated[str, Option(metavar="ADDRESS", help="With --serve: address to listen on.")] = LOOPBACK_ADDRESS,
) -> None:
    """Write a dashboard of stored campaigns: requirements, latest verdicts, trends, pages of campaigns and cases."""
    from marsyard.campaigns.definition.requirements import read_requirements
    from marsyard.campaigns.errors import CampaignError, report_write_errors
    from marsyard.reports.dashboard.site import write_site

    missing = [str(directory) for directory in directories if not directory.is_dir()]
    if missing:
        raise CampaignError(f"no such folder: {', '.join(missing)}")
    requirements_by_id = None if requirements is None else {item.id: item for item in read_requirements(requirements)}
    with report_write_errors(out):
        site = write_site(out, directories, requirements_by_id)
    for problem in site.problems:
        typer.echo(f"not shown: {problem}", err=True)
    typer.echo(f"campaigns: {site.campaigns}")
    typer.echo(f"dashboard: {site.index}")
    if serve is None:
        return
    from marsyard.reports.dashboard.server import create_server

    try:
        server = create_server(out, host, serve)
    except (OSError, OverflowError) as error:
        raise CampaignError(f"--serve {serve}: {error}") from error
    with server:
        typer.echo(f"serving: http://{host}:{server.server_port}/ (stop with Ctrl-C)")
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            typer.echo("stopped")


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
    from marsyard.campaigns.store.lock import folder_lock
    from marsyard.campaigns.store.machine import git_commit
    from marsyard.cli import nightly_run
    from marsyard.cli.nightly_plan import PLAN_FILE, read_plan
    from marsyard.cli.progress import campaign_progress
    from marsyard.reports.history import FINISHED, INTERRUPTED, History, list_comparisons
    from marsyard.reports.history_changes import find_changes

    path = plan or PLAN_FILE
    plan_definition, executor = read_plan(path), make_executor(jobs, None)
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
