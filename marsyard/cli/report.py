"""`marsyard report` and `compare`: verdicts and differences from stored rows."""

from __future__ import annotations

import json
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from marsyard.cli.options import DirectoryArgument, JsonOption, console, handle_user_errors

if TYPE_CHECKING:
    from collections.abc import Sequence

#: Browsers that can print pages, in order of preference.
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
_PRINTING_S = 600.0

RequirementsOption = Annotated[
    Path | None,
    Option(
        "--requirements",
        metavar="FILE",
        help="Judge by this file's requirements for the campaign, not by its own.",
    ),
]


@handle_user_errors
def report(
    directory: DirectoryArgument,
    requirements: RequirementsOption = None,
    pdf: Annotated[bool, Option("--pdf", help="Also print the page to report.pdf (needs Chromium).")] = False,
    csv: Annotated[bool, Option("--csv", help="Also write all rows to cases.csv.")] = False,
    gallery: Annotated[
        bool,
        Option("--gallery", help="First rerun the worst, some unanswered and some random cases for their pictures."),
    ] = False,
) -> None:
    """Judge a campaign from its stored rows, complete or not, and write its report.

    Cases are rerun for --gallery only.
    """
    from marsyard.cli.outcome import conclude

    if gallery:
        _rerun_notable_cases(directory)
    asked = None if requirements is None else _file_requirements(directory, requirements)
    status = conclude(directory, console(), asked)
    if csv:
        typer.echo(f"rows: {_write_csv(directory)}")
    if pdf:
        typer.echo(f"pdf: {_print_page(directory)}")
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
    from marsyard.reports.comparison import (
        campaign_diff_data,
        campaign_diff_grid,
        compare_campaigns,
        have_same_terrains,
    )
    from marsyard.reports.stored import read_run

    runs = [read_run(directory) for directory in (first, second)]
    paired, found = compare_campaigns(*runs)
    names = [str(run.directory) for run in runs]
    if as_json:
        runs_data = {
            "first": names[0],
            "second": names[1],
            "paired": paired,
            "same_terrains": have_same_terrains(*runs),
        }
        typer.echo(json.dumps({**runs_data, "figures": campaign_diff_data(found)}, indent=2))
        return
    out = console()
    out.print(grid_table("Side by side", campaign_diff_grid(["first", "second"], found)))
    for place, name in zip(("first", "second"), names, strict=True):
        out.print(f"{place}: {name}", markup=False, highlight=False, soft_wrap=True)
    grounds = "terrain by terrain" if have_same_terrains(*runs) else "terrains of their own against one another"
    how = "the same draws, compared in pairs" if paired else f"draws of their own, compared {grounds}"
    out.print(f"Cases: {how}. p: two-sided, corrected for the number of figures (Holm).", soft_wrap=True)


def _file_requirements(directory: Path, path: Path) -> Sequence[dict[str, Any]]:
    """The requirements of a file that name the campaign."""
    from marsyard.campaigns.definition.requirements import read_requirements, select_applicable
    from marsyard.campaigns.errors import CampaignError
    from marsyard.campaigns.store import record

    name = str(record.read(directory)["name"])
    found = select_applicable(read_requirements(path), name)
    if not found:
        raise CampaignError(f"{path}: no requirement names the campaign '{name}' in its campaigns")
    return found


def _write_csv(directory: Path) -> Path:
    """Write all rows as CSV in batches, atomically."""
    import pyarrow.csv as pa_csv
    import pyarrow.parquet as pq

    from marsyard.campaigns.errors import writing
    from marsyard.campaigns.store.table import TABLE_FILE

    path = directory / "cases.csv"
    partial = path.with_name(f"{path.name}.partial")
    with writing(path):
        table = pq.ParquetFile(directory / TABLE_FILE)
        with pa_csv.CSVWriter(partial, table.schema_arrow) as writer:
            for batch in table.iter_batches():
                writer.write_batch(batch)
        partial.replace(path)
    return path


def _print_page(directory: Path) -> Path:
    """Print the page to PDF with a headless browser."""
    from marsyard.campaigns.errors import CampaignError

    browser = next((found for name in _BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        raise CampaignError(f"--pdf takes a browser, and none is found; install chromium ({', '.join(_BROWSERS)})")
    target = (directory / "report.pdf").resolve()
    with tempfile.TemporaryDirectory() as profile:
        command = [browser, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={profile}"]
        page = (directory / "report.html").resolve().as_uri()
        command += ["--no-pdf-header-footer", f"--print-to-pdf={target}", page]
        try:
            subprocess.run(command, check=True, capture_output=True, timeout=_PRINTING_S)  # noqa: S603
        except (subprocess.SubprocessError, OSError) as error:
            raise CampaignError(f"{browser} did not print {target}: {error}") from error
    return target


def _rerun_notable_cases(directory: Path) -> None:
    """Rerun a campaign's notable cases without stored products, and store them; a differing row is reported.

    Raises CampaignError where the campaign's scenario or an algorithm cannot be imported.
    """
    from marsyard.campaigns.execution.workers import LocalExecutor
    from marsyard.campaigns.running.replay import load_stored_campaign, replay_with
    from marsyard.campaigns.store.products import case_directory, save_packed
    from marsyard.campaigns.store.record import stored_configuration
    from marsyard.campaigns.store.table import stored_row
    from marsyard.reports.cases import notable_cases
    from marsyard.reports.stored import read_run

    run = read_run(directory)
    lacking = [case for case in notable_cases(run) if case not in run.showcases]
    if not lacking:
        return
    configuration = stored_configuration(directory)
    load_stored_campaign(directory, configuration)
    with LocalExecutor(1) as workers:
        for case in lacking:
            replayed = replay_with(workers, configuration, case, stored_row(directory, case))
            if replayed.products is None or replayed.failed:
                typer.echo(f"case {case}: ran again and left no pictures")
                continue
            save_packed(case_directory(directory, case), replayed.products, replayed.row)
            differs = f", and differs from its row in: {', '.join(replayed.differing)}" if replayed.differing else ""
            typer.echo(f"case {case}: ran again for its pictures{differs}")
