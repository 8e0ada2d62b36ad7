"""Tables of single cases: the largest errors, cases without an answer, crashed cases."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Int

from marsyard.reports.column_selection import axis_columns
from marsyard.reports.column_values import numbers
from marsyard.reports.populations import population_mask
from marsyard.reports.provenance import replay_command
from marsyard.reports.stored import StoredRun
from marsyard.reports.wording import NOTHING, format_value, label

#: Maximum number of rows of the tables of single cases.
_MAX_CASES = 10


@dataclass(frozen=True)
class CaseRow:
    """A case with its values, its replay command, and its error if it crashed."""

    case: str
    has_images: bool
    values: Sequence[str]
    command: str
    message: str
    trace: str


@dataclass(frozen=True)
class CaseTable:
    """Cases with the headings of their values, and the number of omitted cases."""

    head: Sequence[str]
    rows: Sequence[CaseRow]
    n_omitted: int = 0


def worst_cases(run: StoredRun, metric: str, with_images: Collection[str] = ()) -> CaseTable:
    """List the cases with the largest errors; `with_images` are the cases with images on the page."""
    magnitude = np.abs(numbers(run.all_cases, metric))
    finite_rows = np.flatnonzero(np.isfinite(magnitude))
    order = finite_rows[np.argsort(-magnitude[finite_rows], kind="stable")]
    columns = [metric, *axis_columns(metric, [str(name) for name in run.all_cases.columns])]
    return _case_table(run, order, [*columns, *_condition_columns(run, metric)], with_images)


def unanswered_cases(run: StoredRun, metric: str, with_images: Collection[str] = ()) -> CaseTable:
    """List the completed cases without a value of the metric."""
    order = np.flatnonzero(~np.isfinite(numbers(run.all_cases, metric)) & population_mask(run.all_cases, "completed"))
    return _case_table(run, order, _condition_columns(run, metric), with_images)


def crashed_rows(run: StoredRun) -> CaseTable:
    """List the cases that the engine could not finish, with their error messages."""
    return _case_table(run, np.flatnonzero(~population_mask(run.all_cases, "completed")), ())


def _condition_columns(run: StoredRun, metric: str) -> list[str]:
    return ["terrain", *run.driver_columns(metric, max_columns=3)]


def _case_table(
    run: StoredRun, order: Int[np.ndarray, " n"], columns: Sequence[str], with_images: Collection[str] = ()
) -> CaseTable:
    frame = run.all_cases
    names = [name for name in columns if name in frame]
    rows = []
    for index in order[:_MAX_CASES].tolist():
        case = str(frame["case"].iloc[index]) if "case" in frame else str(index)
        texts = [_cell_text(frame, name, index) for name in ("outcome", *names)]
        error = _cell_text(frame, "error", index), _cell_text(frame, "traceback", index)
        rows.append(CaseRow(case, case in with_images, texts, replay_command(run, case), *error))
    return CaseTable(["Case", "Outcome", *(label(name) for name in names)], rows, max(0, order.size - _MAX_CASES))


def _cell_text(frame: pd.DataFrame, column: str, index: int) -> str:
    if column not in frame:
        return NOTHING
    value = frame[column].iloc[index]
    return NOTHING if pd.isna(value) or value == "" else format_value(value)
