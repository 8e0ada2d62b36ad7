"""A campaign's verdict, exit status, report, table and pictures from its stored rows; server of a site."""

from __future__ import annotations

import ipaddress
import math
import os
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Collection, Mapping, Sequence
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
import typer
from rich.console import Console
from rich.table import Table

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.configuration import stored_columns_now
from marsyard.campaigns.errors import CampaignError, StoreError, report_write_errors
from marsyard.campaigns.execution.workers import ExecutorConfig, LocalExecutor
from marsyard.campaigns.running.engine import Watch, append_cases, run_campaign
from marsyard.campaigns.running.preparation import estimate
from marsyard.campaigns.running.replay import load_stored_campaign, replay_with
from marsyard.campaigns.store import record
from marsyard.campaigns.store.products import case_directory, save_packed
from marsyard.campaigns.store.record import is_locked, stored_configuration
from marsyard.campaigns.store.table import TABLE_FILE, refresh_table, stored_row
from marsyard.cli.options import Exit, size_text
from marsyard.cli.showing import grid_table
from marsyard.reports.campaign import write_evaluation
from marsyard.reports.comparison import comparison, comparison_grids
from marsyard.reports.evaluation import Evaluation, evaluate_run, next_look
from marsyard.reports.presentation import notable_cases
from marsyard.reports.sampling_design import read_sampling_design
from marsyard.reports.statistics.proportions import minimum_sample_size, planned_looks
from marsyard.reports.stored import read_run
from marsyard.reports.tables import verdict_table
from marsyard.reports.verdicts import ESTIMATE, Verdict, evaluate_requirements
from marsyard.reports.wording import count, format_fraction, primary_metric

#: Browsers that can print pages, in order of preference.
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
_PRINTING_S = 600.0


def conclude(directory: Path, console: Console, requirements: Sequence[Mapping[str, Any]] | None = None) -> int:
    """Evaluate a campaign, write its report, print both, and return the exit status.

    An unfinished campaign is evaluated by its rows so far, with a status that is never 0; its record is not changed.
    `requirements` replace the campaign's own; the record then keeps its status too.

    Raises StoreError where the folder holds no campaign with rows, or the report cannot be written.
    """
    stored = record.read(directory)
    finished = stored["state"] == "finished"
    if not finished:
        refresh_table(directory)
    found, page = settle(directory, requirements)
    console.print(verdict_table(found.verdicts))
    for table in _comparison_tables(found.how.draw(found.run.frame), found.run.requirements, found.verdicts):
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


def settle(directory: Path, requirements: Sequence[Mapping[str, Any]] | None = None) -> tuple[Evaluation, Path]:
    """Evaluate a campaign's rows and write its report; return the verdicts and the page.

    The record stores the exit status of a finished campaign that is evaluated by its own requirements.

    Raises StoreError where the folder holds no campaign with rows, or the report cannot be written.
    """
    evaluation = evaluate_run(directory, requirements)
    if requirements is None and evaluation.run.recorded("state") == "finished":
        record.update(directory, {"exit_code": evaluation.exit_code})
    with report_write_errors("the report"):
        return evaluation, write_evaluation(evaluation)


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
    with report_write_errors(path):
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


#: Terrains are counted of at most this many cases; a draw takes milliseconds.
_MAX_DRAWS = 5000


def evidence_limits(campaign: Campaign) -> list[str]:
    """Why requirements cannot be PASS even without a failure, with the remedy; empty where they can.

    Covers requirements that are decided at a confidence, each as of all cases: a smaller population needs more.
    """
    configuration = campaign.configuration
    asked = [one for one in configuration.requirements if one.decide_by != ESTIMATE]
    how = read_sampling_design(configuration.model_dump(mode="json"))
    if not asked:
        return []
    if not how.independent:
        return [how.no_probability]
    hardest = max(asked, key=lambda one: minimum_sample_size(one.probability, one.confidence))
    fewest = minimum_sample_size(hardest.probability, hardest.confidence)
    cases = configuration.total_cases
    what = f"{hardest.id}: {format_fraction(hardest.probability)} at {format_fraction(hardest.confidence)} confidence"
    limits = []
    if cases < fewest:
        limits.append(f"{what} takes at least {count(fewest, 'case')} without a failure, and {cases} are asked for.")
    supply = how.terrains
    if supply is None:
        return limits
    # the distinct terrains of the cases: in turn, or as drawn
    terrains = min(cases, supply.terrains) if supply.in_turn else cases
    path = next((path for path in ("location.terrain", "world.terrain") if path in configuration.dispersions), None)
    if not supply.in_turn and path is not None and cases <= _MAX_DRAWS:
        terrains = len({campaign.draws(case)[path] for case in range(int(configuration.design.nominal), cases)})
    # cases with a terrain each are limited by their number alone; others are counted by terrains
    if terrains < min(cases, fewest):
        limits.append(supply.advice(fewest, hardest.probability, hardest.confidence))
    return limits


def print_estimate(campaign: Campaign, executor: ExecutorConfig) -> None:
    """Print the estimated time and disk space of a campaign."""
    workers = executor.jobs if executor.cluster is None else os.cpu_count() or 1
    estimated = estimate(campaign, workers)
    total = campaign.configuration.total_cases
    low, high = estimated.case_range_s
    time_s = estimated.time_s
    duration = f"{time_s / 60.0:.0f} min" if time_s < 7200.0 else f"{time_s / 3600.0:.1f} h"
    duration = f"{time_s:.0f} s" if time_s < 120.0 else duration
    typer.echo(f"{count(total, 'case')} on {count(workers, 'worker')}: about {duration}")
    if estimated.inputs:
        typer.echo(f"  {count(estimated.inputs, 'terrain')} (shared inputs) to build, {estimated.input_s:.3g} s each")
    trials = count(estimated.trials, "trial case")
    typer.echo(f"  {estimated.case_s:.3g} s a case ({low:.3g} to {high:.3g} s in {trials})")
    if estimated.unfinished:
        typer.echo(f"  {estimated.unfinished} of the trial cases did not come to their end")
    rows, products = size_text(estimated.rows_bytes), size_text(estimated.products_bytes)
    typer.echo(f"disk: {rows} of rows, up to {products} of products")
    if estimated.inputs_bytes:
        limit = size_text(estimated.cache_limit_bytes)
        typer.echo(f"  {size_text(estimated.inputs_bytes)} of terrains in the cache, which keeps at most {limit}")


def print_limits(campaign: Campaign) -> None:
    """Print why the campaign's requirements cannot be PASS, and the remedy."""
    for limit in evidence_limits(campaign):
        typer.echo(f"note: {limit}")


def run_until_decided(campaign: Campaign, directory: Path, executor: ExecutorConfig, watch: Watch) -> None:
    """Run a campaign of at most its number of cases; see `marsyard.reports.statistics.proportions`.

    Raises CampaignError for dependent draws, or without a requirement to decide; and as `run_campaign`.
    """
    configuration = campaign.configuration
    how = read_sampling_design(configuration.model_dump(mode="json"))
    if not how.independent:
        raise CampaignError(f"--until-decided: {how.no_probability}")
    if all(asked.decide_by == ESTIMATE for asked in configuration.requirements):
        raise CampaignError("--until-decided: the campaign has no requirement that is decided at a confidence")
    limit = configuration.total_cases
    first = configuration.model_copy(
        update={"cases": planned_looks(limit)[0].cases, "appended": (), "max_cases": limit}
    )
    command = (*campaign.command, "--until-decided")
    run_campaign(Campaign(first, campaign.scenario, command), directory, executor, watch)
    continue_until_decided(directory, executor, watch)


def continue_until_decided(directory: Path, executor: ExecutorConfig, watch: Watch) -> None:
    """Add cases to a finished campaign with looks until it is decided."""
    from marsyard.cli.outcome import read_frame  # the reports, which `new` does not need

    while True:
        configuration = record.stored_configuration(directory)
        if configuration.max_cases is None:
            return
        plain = configuration.model_dump(mode="json")
        how, cases = read_sampling_design(plain), configuration.total_cases
        look = next_look(evaluate_requirements(read_frame(directory), plain["requirements"], how), how, cases)
        if look is None:
            watch.note(f"stopped after {cases} of at most {count(configuration.max_cases, 'case')}")
            return
        append_cases(directory, look - cases, executor, watch)


class _Handler(SimpleHTTPRequestHandler):
    """Serves the site's files; lists no folders, follows nothing out of it, and keeps quiet.

    `names` are the host names by which the server may be addressed.
    """

    def __init__(self, *args: Any, names: Collection[str], **kwargs: Any) -> None:
        self._names = names
        super().__init__(*args, **kwargs)

    def parse_request(self) -> bool:
        """Refuse a request for another host: a foreign page whose name was bound to this address may not read."""
        if not super().parse_request():
            return False
        if not is_own_host(self.headers.get("Host", ""), self._names):
            self.send_error(403, "this server is not known by that host name")
            return False
        return True

    def translate_path(self, path: str) -> str:
        """The file that a path of the address means; one that is not there where it leads out of the site."""
        root = Path(self.directory).resolve()
        try:
            target = Path(super().translate_path(path)).resolve()
        except (OSError, ValueError):  # such as a name with a zero byte
            return str(root / "no such file")
        return str(target if target.is_relative_to(root) else root / "no such file")

    def list_directory(self, path: object) -> None:
        """Refuses."""
        self.send_error(404, "no such file")

    def log_message(self, *_: object) -> None:
        """Keeps quiet."""


def is_own_host(header: str, names: Collection[str]) -> bool:
    """Whether a Host header names this server: by an address, which no name server can redirect, or by a known name.

    >>> [is_own_host(text, ["localhost"]) for text in ("127.0.0.1:80", "[::1]", "LOCALHOST:8", "evil.example", "")]
    [True, True, True, False, False]
    """
    host = header.strip().lower()
    host = host[1:].partition("]")[0] if host.startswith("[") else host.partition(":")[0]
    if host in names:
        return True
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def server(directory: Path, host: str, port: int) -> ThreadingHTTPServer:
    """A server of a site's folder; port 0 takes one that is free."""
    names = {"localhost", host.lower(), socket.gethostname().lower()}
    return ThreadingHTTPServer((host, port), partial(_Handler, directory=str(directory), names=names))
