"""Tables of verdicts and confirmations for terminals, and of outcomes and error statistics for pages.

Cells of terminal tables are `Text` objects, so that brackets in names are not read as markup.
"""

import math
from collections.abc import Sequence

import pandas as pd
from rich import box
from rich.table import Table
from rich.text import Text

from marsyard.campaigns.definition.confirmation import Confirmation
from marsyard.campaigns.outcomes import ENGINE_FAILURES
from marsyard.reports.column_selection import axis_columns
from marsyard.reports.column_values import numbers
from marsyard.reports.rates import is_flag, population_mask, terrain_groups
from marsyard.reports.section import Grid
from marsyard.reports.statistics.samples import ErrorSummary, summarize
from marsyard.reports.verdicts import Status, Verdict
from marsyard.reports.wording import NOTHING, format_fraction, interval, label, number, percent, requirement_text

_STYLES = {
    Status.PASS: "bold green",
    Status.MET_BY_RATE: "bold cyan",
    Status.FAIL: "bold red",
    Status.INSUFFICIENT: "bold yellow",
    Status.UNREGISTERED: "bold cyan",
    Status.OTHER_CLAIMS: "bold cyan",
}


def verdict_table(verdicts: Sequence[Verdict]) -> Table:
    """Create a table of requirements with verdicts and evidence, for terminals of at least 80 columns."""
    table = Table(title="Verdict", box=box.SIMPLE_HEAD, expand=False, title_justify="left", caption_justify="left")
    table.add_column("Requirement", overflow="fold", ratio=None, min_width=18)
    table.add_column("Verdict", no_wrap=True)
    for heading in ("Failed", "Succeeded", "Bounds", "Needed"):
        table.add_column(heading, justify="right", no_wrap=True)
    for verdict in verdicts:
        requirement = Text(verdict.requirement_id, style="bold")
        requirement.append(f"\n{requirement_text(verdict)}", style="dim")
        table.add_row(
            requirement,
            Text(str(verdict.status), style=_STYLES[verdict.status]),
            f"{verdict.failures} of {verdict.n}",
            percent(verdict.estimate),
            NOTHING if math.isnan(verdict.lower) else f"≥ {percent(verdict.lower)}\n≤ {percent(verdict.upper)}",
            NOTHING if verdict.additional_cases is None else str(verdict.additional_cases),
        )
    if not verdicts:
        table.add_row(Text("no requirement"), "", "", "", "", "")
    lines = []
    if any(not math.isnan(verdict.lower) for verdict in verdicts):
        lines.append("Bounds: one-sided Clopper-Pearson bounds at the required confidence.")
        lines.append("Needed: additional cases, all without failure, that would lead to PASS.")
    if len(verdicts) > 1 and verdicts[0].note and len({verdict.note for verdict in verdicts}) == 1:
        lines.append(verdicts[0].note)
    else:
        lines += [f"{verdict.requirement_id}: {verdict.note}" for verdict in verdicts if verdict.note]
    table.caption = Text("\n".join(lines), style="dim", justify="left")
    return table


def outcome_counts(frame: pd.DataFrame) -> list[tuple[str, int]]:
    """Count cases by outcome: answers first, unfinished cases last, larger numbers first."""
    if "outcome" not in frame:
        return []
    counts = frame["outcome"].astype("object").fillna("(none)").astype(str).value_counts()
    pairs = [(str(name), int(count)) for name, count in counts.items()]
    outcomes_with_answer = answered_outcomes(frame)
    return sorted(
        pairs, key=lambda pair: (pair[0] in ENGINE_FAILURES, pair[0] not in outcomes_with_answer, -pair[1], pair[0])
    )


def answered_outcomes(frame: pd.DataFrame) -> set[str]:
    """Return the outcomes of cases with an answer; VALID if the rows have no column `answered`."""
    if "outcome" not in frame or not is_flag(frame, "answered"):
        return {"VALID"}
    return {str(name) for name in frame.loc[population_mask(frame, "valid"), "outcome"].dropna().unique()}


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


def confirmations_table(entries: Sequence[Confirmation]) -> Table:
    """Create a table of confirmations (`marsyard run --confirm`) for terminals.

    A confirmation is a run with a new seed after the algorithm was frozen. The column Number counts the confirmations
    of one claim.
    """
    table = Table(title="Confirmations", box=box.SIMPLE_HEAD, title_justify="left")
    for heading in ("Campaign", "Algorithm", "Claim"):
        table.add_column(heading, overflow="fold")
    for heading in ("Number", "Date", "Cases"):
        table.add_column(heading, no_wrap=True)
    table.add_column("Results", min_width=14)
    for entry in entries:
        results = "not finished"
        if not entry.is_unfinished:
            results = "\n".join(f"{name}: {status}" for name, status in (entry.results or {}).items())
            results = results or "no requirement"
        claim = entry.claim[:8] if entry.is_chained else NOTHING
        cells = (entry.campaign, entry.frozen.algorithm, claim, str(entry.number), entry.started_utc[:10])
        table.add_row(*map(Text, (*cells, str(entry.cases), results)))
    return table
