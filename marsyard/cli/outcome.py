"""A campaign's verdict, exit status, report, table and pictures from its stored rows."""

from __future__ import annotations

import math
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
import typer
from rich.console import Console
from rich.table import Table

from marsyard.campaigns.definition.former_names import stored_columns_now
from marsyard.campaigns.errors import CampaignError, StoreError, writing
from marsyard.campaigns.execution.workers import LocalExecutor
from marsyard.campaigns.running.replay import load_stored_campaign, replay_with
from marsyard.campaigns.store import record
from marsyard.campaigns.store.products import case_directory, save_packed
from marsyard.campaigns.store.record import is_locked, stored_configuration
from marsyard.campaigns.store.table import TABLE_FILE, refresh_table, stored_row
from marsyard.cli.options import Exit
from marsyard.cli.showing import grid_table
from marsyard.reports.campaign import write_evaluation
from marsyard.reports.cases import notable_cases
from marsyard.reports.columns import primary_metric
from marsyard.reports.comparison import comparison, comparison_grids
from marsyard.reports.evaluation import Judged, judged
from marsyard.reports.stored import read_run
from marsyard.reports.tables import verdict_table
from marsyard.reports.verdicts import Verdict
from marsyard.reports.wording import count

#: Browsers that can print pages, in order of preference.
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
_PRINTING_S = 600.0


def conclude(directory: Path, console: Console, requirements: Sequence[Mapping[str, Any]] | None = None) -> int:
    """Judge a campaign, write its report, print both, and return the exit status.

    An unfinished campaign is judged by its rows so far, with a status that is never 0; its record is not changed.
    `requirements` replace the campaign's own; the record then keeps its status too.

    Raises StoreError where the folder holds no campaign with rows, or the report cannot be written.
    """
    stored = record.read(directory)
    finished = stored["state"] == "finished"
    if not finished:
        refresh_table(directory)
    found, page = settle(directory, requirements)
    console.print(verdict_table(found.verdicts))
    for table in _comparison_tables(found.how.drawn(found.run.frame), found.run.requirements, found.verdicts):
        console.print(table)
    lines = [f"verdict: {found.whole.word}", found.whole.sentence, f"report: {page}"]
    if not finished:
        state = "killed" if stored["state"] == "running" else stored["state"]
        reason = f"it was {state}; to continue: marsyard resume {directory}"
        reason = "it is running" if is_locked(directory) else reason
        lines.insert(0, f"INCOMPLETE: {len(found.run.whole)} of {count(stored['cases'], 'case')}; {reason}")
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    # what has been met so far is not met yet
    return found.exit_code if finished else found.exit_code or Exit.INSUFFICIENT


def settle(directory: Path, requirements: Sequence[Mapping[str, Any]] | None = None) -> tuple[Judged, Path]:
    """Judge a campaign's rows and write its report; return the verdicts and the page.

    The record stores the exit status of a finished campaign that is judged by its own requirements.

    Raises StoreError where the folder holds no campaign with rows, or the report cannot be written.
    """
    found = judged(directory, requirements)
    if requirements is None and found.run.said("state") == "finished":
        record.update(directory, {"exit_code": found.exit_code})
    with writing("the report"):
        return found, write_evaluation(found)


def _comparison_tables(
    frame: pd.DataFrame, requirements: Sequence[Mapping[str, Any]], verdicts: Sequence[Verdict]
) -> list[Table]:
    """Comparison of algorithms on the same cases; empty for a single one."""
    metric = primary_metric(frame, requirements)
    bound = next((v.bound for v in verdicts if v.metric == metric and math.isfinite(v.bound)), None)
    contenders, differences = comparison(frame, metric, bound)
    if not contenders:
        return []
    titles = ("Algorithms on the same cases", f"Against {contenders[0].name}")
    grids = zip(titles, comparison_grids(contenders, differences, metric), strict=True)
    return [grid_table(title, grid) for title, grid in grids if grid.rows]


def read_frame(directory: Path) -> pd.DataFrame:
    """The stored rows of a campaign. Raises StoreError where there are none."""
    path = directory / TABLE_FILE
    if not path.is_file():
        raise StoreError(f"{directory} has no {TABLE_FILE}: the campaign did not end")
    try:
        frame = pd.read_parquet(path)
        return frame.rename(columns=stored_columns_now(frame.columns, stored_configuration(directory).scenario))
    except (OSError, ValueError) as error:
        raise StoreError(f"{path}: not a table of cases: {error}") from error


def write_csv(directory: Path) -> Path:
    """Write all rows as CSV in batches, atomically."""
    path = directory / "cases.csv"
    partial = path.with_name(f"{path.name}.partial")
    with writing(path):
        table = pq.ParquetFile(directory / TABLE_FILE)
        with pa_csv.CSVWriter(partial, table.schema_arrow) as writer:
            for batch in table.iter_batches():
                writer.write_batch(batch)
        partial.replace(path)
    return path


def print_page(directory: Path) -> Path:
    """Print the page to PDF with a headless browser."""
    browser = next((found for name in _BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        raise CampaignError(f"--pdf takes a browser, and none is found; install chromium ({', '.join(_BROWSERS)})")
    target, page = ((directory / name).resolve() for name in ("report.pdf", "report.html"))
    with tempfile.TemporaryDirectory() as profile:
        command = [browser, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={profile}"]
        command += ["--no-pdf-header-footer", f"--print-to-pdf={target}", page.as_uri()]
        try:
            subprocess.run(command, check=True, capture_output=True, timeout=_PRINTING_S)  # noqa: S603
        except (subprocess.SubprocessError, OSError) as error:
            raise CampaignError(f"{browser} did not print {target}: {error}") from error
    return target


def rerun_notable_cases(directory: Path) -> None:
    """Rerun a campaign's notable cases without stored products, and store them; a differing row is reported.

    Raises CampaignError where the campaign's scenario or an algorithm cannot be imported.
    """
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
