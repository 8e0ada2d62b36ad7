"""From a campaign's stored rows to its verdict, its report and the exit status."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from campaigns.errors import StoreError
from campaigns.store import record
from campaigns.store.lock import is_locked
from campaigns.store.table import TABLE_FILE, refresh_table
from marsyard.campaign_command import Exit

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import Console
    from rich.table import Table

    from reports.verdicts import Verdict


def conclude(directory: Path, console: Console, requirements: Sequence[Mapping[str, Any]] | None = None) -> int:
    """Judges a campaign, writes its report, prints both, and returns the exit status.

    Of a campaign that is not finished the rows are judged that it has so far, with a status that is never 0, and the
    record is left alone. `requirements` stand in for the campaign's own; the record then keeps its status as well.

    Raises
    ------
    StoreError
        Where the folder holds no campaign with rows, or the report cannot be written.
    """
    from reports.campaign import write_report
    from reports.sampled import sampled
    from reports.tables import verdict_table
    from reports.verdicts import exit_code, judge_campaign, overall

    stored = record.read(directory)
    finished = stored["state"] == "finished"
    if not finished:
        refresh_table(directory)
    frame = read_frame(directory)
    how = sampled(stored["configuration"])
    asked = stored["requirements"] if requirements is None else requirements
    verdicts = judge_campaign(frame, asked, how)
    whole = overall(verdicts, frame, how)
    status = exit_code(verdicts, bool(whole.crashed))
    if finished and requirements is None:
        record.update(directory, {"exit_code": status})
    try:
        page = write_report(directory, requirements)
    except OSError as error:
        raise StoreError(f"the report cannot be written: {error}") from error
    console.print(verdict_table(verdicts))
    for table in _comparison_tables(how.drawn(frame), asked, verdicts):
        console.print(table)
    lines = [f"verdict: {whole.word}", whole.sentence, f"report: {page}"]
    if not finished:
        lines.insert(
            0, f"INCOMPLETE: {len(frame)} of {stored['cases']} cases; {_how_it_stands(directory, stored['state'])}"
        )
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    # what has been met so far is not met yet
    return status if finished else status or Exit.INSUFFICIENT


def _comparison_tables(
    frame: pd.DataFrame, requirements: Sequence[Mapping[str, Any]], verdicts: Sequence[Verdict]
) -> list[Table]:
    """What algorithms on the same cases did; nothing where there is one only."""
    from marsyard.showing import grid_table
    from reports.columns import primary_metric
    from reports.comparison import comparison, comparison_grids

    metric = primary_metric(frame, requirements)
    bound = next((v.bound for v in verdicts if v.metric == metric and math.isfinite(v.bound)), None)
    contenders, differences = comparison(frame, metric, bound)
    if not contenders:
        return []
    tables = []
    titles = ("Algorithms on the same cases", f"Against {contenders[0].name}")
    for title, grid in zip(titles, comparison_grids(contenders, differences, metric), strict=True):
        if grid.rows:
            tables.append(grid_table(title, grid))
    return tables


def _how_it_stands(directory: Path, state: str) -> str:
    """Why a campaign is incomplete, and what to do."""
    if is_locked(directory):
        return "it is running"
    return f"it was {'killed' if state == 'running' else state}; to go on: marsyard resume {directory}"


def read_frame(directory: Path) -> pd.DataFrame:
    """The stored rows of a campaign.

    Raises
    ------
    StoreError
        Where there are none.
    """
    import pandas as pd

    path = directory / TABLE_FILE
    if not path.is_file():
        raise StoreError(f"{directory} has no {TABLE_FILE}: the campaign did not end")
    try:
        return pd.read_parquet(path)
    except (OSError, ValueError) as error:
        raise StoreError(f"{path}: not a table of cases: {error}") from error
