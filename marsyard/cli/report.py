"""Commands `marsyard report`, `confirmations` and `compare`: evaluate stored campaigns."""

import json
import shutil
import subprocess
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from marsyard.cli import options
from marsyard.cli.errors import handle_user_errors
from marsyard.cli.terminal import create_console

#: Browsers that can print pages, in order of preference, and the time limit of printing.
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
_PRINT_TIMEOUT_S = 600.0


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
    from marsyard.cli.outcome import evaluate_and_report

    if trust:
        adopt(directory)
    if gallery:
        _rerun_gallery_cases(directory)
    applicable_requirements = None
    if requirements is not None:
        name = str(record.read(directory)["name"])
        applicable_requirements = select_applicable(read_requirements(requirements), name)
        if not applicable_requirements:
            raise CampaignError(f"{requirements}: no requirement lists the campaign '{name}' in its campaigns")
    status = evaluate_and_report(directory, create_console(), applicable_requirements)
    if csv:
        typer.echo(f"rows: {_write_csv(directory)}")
    if pdf:
        typer.echo(f"pdf: {_print_page(directory)}")
    raise typer.Exit(status)


def _rerun_gallery_cases(directory: Path) -> None:
    """Rerun the candidates of the gallery without stored products and store their products; report rows that differ.

    Raises CampaignError if the campaign's scenario or an algorithm cannot be imported.
    """
    from marsyard.campaigns.execution.workers import LocalExecutor
    from marsyard.campaigns.running.replay import replay_in_executor
    from marsyard.campaigns.running.stored_campaign import load_stored_campaign
    from marsyard.campaigns.store.products import case_directory, save_packed
    from marsyard.campaigns.store.record import stored_definition
    from marsyard.campaigns.store.table import stored_row
    from marsyard.reports.gallery import gallery_candidates
    from marsyard.reports.stored import read_run

    run = read_run(directory)
    missing = [case for case in gallery_candidates(run) if case not in run.stored_cases]
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


def _write_csv(directory: Path) -> Path:
    """Write all rows as CSV in batches, atomically."""
    import pyarrow.csv as pa_csv
    import pyarrow.parquet as pq

    from marsyard.campaigns.errors import report_write_errors
    from marsyard.campaigns.store.table import TABLE_FILE
    from marsyard.campaigns.store.temporary_files import replace_file

    path = directory / "cases.csv"
    with report_write_errors(path), replace_file(path) as partial_path:
        table = pq.ParquetFile(directory / TABLE_FILE)
        with pa_csv.CSVWriter(partial_path, table.schema_arrow) as writer:
            for batch in table.iter_batches():
                writer.write_batch(batch)
    return path


def _print_page(directory: Path) -> Path:
    """Print the report page `report.html` to `report.pdf` with a headless browser; return the path of the PDF."""
    from marsyard.campaigns.errors import CampaignError

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
    from marsyard.campaigns.store.git_history import find_registration_problem
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
    from marsyard.cli.terminal import grid_table
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
