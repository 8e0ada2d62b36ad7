"""`marsyard report` and `compare`: what stored rows show."""

from __future__ import annotations

import json
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marsyard.cli.campaign import DirectoryArgument, JsonOption, console, says_what_is_wrong

if TYPE_CHECKING:
    from collections.abc import Sequence

#: Names of a browser that prints pages, in the order in which they are looked for.
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
_PRINTING_S = 600.0

RequirementsOption = Annotated[
    Path | None,
    typer.Option(
        "--requirements",
        metavar="FILE",
        help="Judge by the requirements of this file that name the campaign, instead of by the campaign's own.",
    ),
]


@says_what_is_wrong
def report(
    directory: DirectoryArgument,
    requirements: RequirementsOption = None,
    pdf: Annotated[bool, typer.Option("--pdf", help="Print the page into report.pdf as well; takes Chromium.")] = False,
    csv: Annotated[bool, typer.Option("--csv", help="Write all rows into cases.csv as well.")] = False,
    gallery: Annotated[
        bool,
        typer.Option("--gallery", help="First run the worst cases, some without an answer and some at random again."),
    ] = False,
) -> None:
    """Judge a campaign, also one that was interrupted or killed, and write its report, from the stored rows.

    Nothing is run again but for --gallery.
    """
    from marsyard.cli.outcome import conclude
    from marsyard.cli.report_pictures import keep_notable_cases

    if gallery:
        keep_notable_cases(directory, typer.echo)
    asked = None if requirements is None else _asked(directory, requirements)
    status = conclude(directory, console(), asked)
    if csv:
        typer.echo(f"rows: {_write_csv(directory)}")
    if pdf:
        typer.echo(f"pdf: {_print_page(directory)}")
    raise typer.Exit(status)


@says_what_is_wrong
def compare(
    first: Annotated[Path, typer.Argument(metavar="DIR", help="The folder of a campaign that was run.")],
    second: Annotated[Path, typer.Argument(metavar="DIR", help="The folder of another.")],
    as_json: JsonOption = False,
) -> None:
    """Set two stored campaigns side by side: success, answers and errors, and whether they differ.

    Exit status 0 in any event: a difference is no verdict.
    """
    from marsyard.cli.showing import grid_table
    from marsyard.reports.comparison import contrast_data, contrast_grid, contrasts, same_grounds
    from marsyard.reports.stored import read_run

    runs = [read_run(directory) for directory in (first, second)]
    paired, found = contrasts(*runs)
    names = [str(run.directory) for run in runs]
    if as_json:
        told = {"first": names[0], "second": names[1], "paired": paired, "same_terrains": same_grounds(*runs)}
        typer.echo(json.dumps({**told, "figures": contrast_data(found)}, indent=2))
        return
    out = console()
    out.print(grid_table("Side by side", contrast_grid(["first", "second"], found)))
    for place, name in zip(("first", "second"), names, strict=True):
        out.print(f"{place}: {name}", markup=False, highlight=False, soft_wrap=True)
    grounds = "terrain by terrain" if same_grounds(*runs) else "terrains of their own against one another"
    how = "the same draws, compared in pairs" if paired else f"draws of their own, compared {grounds}"
    out.print(f"Cases: {how}. p: two-sided, corrected for the number of figures (Holm).", soft_wrap=True)


def _asked(directory: Path, path: Path) -> Sequence[dict[str, Any]]:
    """The requirements of a file that a campaign shows."""
    from marsyard.campaigns.definition.requirements import applicable, read_requirements
    from marsyard.campaigns.errors import CampaignError
    from marsyard.campaigns.store import record

    name = str(record.read(directory)["name"])
    found = applicable(read_requirements(path), name)
    if not found:
        raise CampaignError(f"{path}: no requirement names the campaign '{name}' in its campaigns")
    return found


def _write_csv(directory: Path) -> Path:
    """Writes all rows as CSV, a block of the table at a time, whole or not at all."""
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
    """Prints the page into a PDF by a browser without a window."""
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
