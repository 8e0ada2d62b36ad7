"""From a campaign's stored rows to its verdict, its report and the exit status."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from marsyard.campaigns.errors import StoreError, writing
from marsyard.campaigns.store import record
from marsyard.campaigns.store.record import is_locked
from marsyard.campaigns.store.table import TABLE_FILE, refresh_table
from marsyard.cli.options import Exit

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import Console
    from rich.table import Table

    from marsyard.reports.evaluation import Judged
    from marsyard.reports.verdicts import Verdict


def conclude(directory: Path, console: Console, requirements: Sequence[Mapping[str, Any]] | None = None) -> int:
    """Judge a campaign, write its report, print both, and return the exit status.

    An unfinished campaign is judged by its rows so far, with a status that is never 0; its record is not changed.
    `requirements` replace the campaign's own; the record then keeps its status too.

    Raises StoreError where the folder holds no campaign with rows, or the report cannot be written.
    """
    from marsyard.reports.tables import verdict_table
    from marsyard.reports.wording import count

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
        come = f"{len(found.run.whole)} of {count(stored['cases'], 'case')}"
        lines.insert(0, f"INCOMPLETE: {come}; {_state_text(directory, stored['state'])}")
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    # what has been met so far is not met yet
    return found.exit_code if finished else found.exit_code or Exit.INSUFFICIENT


def settle(directory: Path, requirements: Sequence[Mapping[str, Any]] | None = None) -> tuple[Judged, Path]:
    """Judge a campaign's rows and write its report; return the verdicts and the page.

    The record stores the exit status of a finished campaign that is judged by its own requirements.

    Raises StoreError where the folder holds no campaign with rows, or the report cannot be written.
    """
    from marsyard.reports.campaign import write_evaluation
    from marsyard.reports.evaluation import judged

    found = judged(directory, requirements)
    if requirements is None and found.run.said("state") == "finished":
        record.update(directory, {"exit_code": found.exit_code})
    with writing("the report"):
        return found, write_evaluation(found)


def _comparison_tables(
    frame: pd.DataFrame, requirements: Sequence[Mapping[str, Any]], verdicts: Sequence[Verdict]
) -> list[Table]:
    """Comparison of algorithms on the same cases; empty for a single one."""
    from marsyard.cli.showing import grid_table
    from marsyard.reports.columns import primary_metric
    from marsyard.reports.comparison import comparison, comparison_grids

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


def _state_text(directory: Path, state: str) -> str:
    """Why a campaign is incomplete, and the next command."""
    if is_locked(directory):
        return "it is running"
    return f"it was {'killed' if state == 'running' else state}; to go on: marsyard resume {directory}"


def read_frame(directory: Path) -> pd.DataFrame:
    """The stored rows of a campaign.

    Raises StoreError where there are none.
    """
    import pandas as pd

    path = directory / TABLE_FILE
    if not path.is_file():
        raise StoreError(f"{directory} has no {TABLE_FILE}: the campaign did not end")
    try:
        return pd.read_parquet(path)
    except (OSError, ValueError) as error:
        raise StoreError(f"{path}: not a table of cases: {error}") from error
