"""Commands `marsyard report`, `confirmations` and `compare`: evaluate stored campaigns."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from marsyard.cli import options
from marsyard.cli.console import create_console
from marsyard.cli.errors import handle_user_errors


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
    from marsyard.cli import outcome, report_files

    if trust:
        adopt(directory)
    if gallery:
        from marsyard.cli.gallery_cases import rerun_gallery_cases

        rerun_gallery_cases(directory)
    applicable_requirements = None
    if requirements is not None:
        name = str(record.read(directory)["name"])
        applicable_requirements = select_applicable(read_requirements(requirements), name)
        if not applicable_requirements:
            raise CampaignError(f"{requirements}: no requirement lists the campaign '{name}' in its campaigns")
    status = outcome.evaluate_and_report(directory, create_console(), applicable_requirements)
    if csv:
        typer.echo(f"rows: {report_files.write_csv(directory)}")
    if pdf:
        typer.echo(f"pdf: {report_files.print_page(directory)}")
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
    from marsyard.cli.tables import grid_table
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
