"""Tables of error statistics for pages."""

from collections.abc import Sequence

import pandas as pd

from marsyard.reports.column_selection import axis_columns
from marsyard.reports.column_values import numbers
from marsyard.reports.rates import terrain_groups
from marsyard.reports.section import Grid
from marsyard.reports.statistics.error_summary import ErrorSummary, summarize
from marsyard.reports.wording import format_fraction, interval, label, number


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
