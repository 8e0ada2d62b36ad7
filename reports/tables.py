"""Tables of the page: statistics of errors, and single cases (largest errors, no answer, crashed)."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Int

from marsyard.reports.column_selection import axis_columns
from marsyard.reports.column_values import numbers
from marsyard.reports.populations import population_mask
from marsyard.reports.provenance import replay_command
from marsyard.reports.rates import terrain_groups
from marsyard.reports.section import Grid
from marsyard.reports.statistics.error_summary import ErrorSummary, summarize
from marsyard.reports.stored import StoredRun
from marsyard.reports.wording import NOTHING, format_fraction, format_value, interval, label, number


def error_summaries(frame: pd.DataFrame, metric: str) -> list[tuple[str, ErrorSummary]]:
    """Compute statistics of a metric and of its signed components (x, y), with labels, over all cases with a value."""
    columns = [metric, *axis_columns(metric, [str(column) for column in frame.columns])]
    groups = terrain_groups(frame)
    return [(label(column), summarize(numbers(frame, column), groups=groups)) for column in columns]


def statistics_grid(frame: pd.DataFrame, metric: str) -> Grid:
    """Create a table of statistics with a column for the metric and for each of its components."""
    summaries = error_summaries(frame, metric)
    return Grid(["", *(name for name, _ in summaries)], statistics_rows([summary for _, summary in summaries]))


def statistics_rows(summaries: Sequence[ErrorSummary]) -> list[list[str]]:
    """Create the rows of a table of statistics: name of the statistic, then its value in each summary."""
    if not summaries:
        return []
    confidence = format_fraction(summaries[0].confidence)
    rows = [
        ["cases", *(str(summary.n) for summary in summaries)],
        ["mean", *(number(summary.mean) for summary in summaries)],
        [f"mean, {confidence} interval", *(interval(summary.mean_lower, summary.mean_upper) for summary in summaries)],
        ["standard deviation", *(number(summary.sd) for summary in summaries)],
        [
            f"standard deviation, {confidence} interval",
            *(interval(summary.sd_lower, summary.sd_upper) for summary in summaries),
        ],
        [
            "robust standard deviation (1.4826 × median absolute deviation)",
            *(number(summary.robust_sd) for summary in summaries),
        ],
        ["root mean square", *(number(summary.rms) for summary in summaries)],
    ]
    for index, quantile in enumerate(summaries[0].quantiles):
        name = "median" if quantile.probability == 0.5 else f"{format_fraction(quantile.probability)} quantile"
        quantiles = [summary.quantiles[index] for summary in summaries]
        rows.append([name, *(number(quantile.estimate) for quantile in quantiles)])
        rows.append(
            [f"{name}, {confidence} bounds", *(interval(quantile.lower, quantile.upper) for quantile in quantiles)]
        )
    return [*rows, ["maximum magnitude", *(number(summary.largest) for summary in summaries)]]


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
    """Create the table of the first `_MAX_CASES` rows in an order, with the values of the columns that exist."""
    frame = run.all_cases
    names = [name for name in columns if name in frame]
    rows = []
    for index in order[:_MAX_CASES].tolist():
        case = str(frame["case"].iloc[index]) if "case" in frame else str(index)
        texts = [_cell_text(frame, name, index) for name in ("outcome", *names)]
        message, trace = _cell_text(frame, "error", index), _cell_text(frame, "traceback", index)
        rows.append(CaseRow(case, case in with_images, texts, replay_command(run, case), message, trace))
    return CaseTable(["Case", "Outcome", *(label(name) for name in names)], rows, max(0, order.size - _MAX_CASES))


def _cell_text(frame: pd.DataFrame, column: str, index: int) -> str:
    if column not in frame:
        return NOTHING
    value = frame[column].iloc[index]
    return NOTHING if pd.isna(value) or value == "" else format_value(value)
