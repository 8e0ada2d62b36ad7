"""Page that reports the changes of a night."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import takewhile

from marsyard.reports.history import FINISHED, Night, NightCampaign
from marsyard.reports.history_changes import MAX_FALSE_ALARM_PROBABILITY, MetricChange
from marsyard.reports.wording import count, format_fraction, number, percent


def format_night_page(
    night: Night,
    earlier: Sequence[Night],
    campaigns: Sequence[NightCampaign],
    changes: Sequence[MetricChange],
    compared: int,
) -> str:
    """Format the night's page in Markdown.

    - earlier: previous nights, the latest first
    - changes: changed metrics
    - compared: number of compared metrics
    """
    regressions = [change for change in changes if change.is_regression]
    improvements = [change for change in changes if not change.is_regression]
    verdict_counts = Counter(campaign.verdict for campaign in campaigns)
    headline, end = night.state.upper(), f"{night.state}: its metrics are excluded from comparisons"
    if night.state == FINISHED:
        verdicts = ", ".join(f"{n_campaigns} {verdict}" for verdict, n_campaigns in verdict_counts.items())
        headline = verdicts + (f", {count(len(regressions), 'regression')}" if regressions else "")
        end = f"ended {night.finished_utc}"
    lines = [f"# Night {night.night}: {headline}", ""]
    lines.append(f"Started {night.started_utc}, {end}; commit {night.git_commit or 'not known'}.")
    unfinished_nights = list(takewhile(lambda earlier_night: earlier_night.state != FINISHED, earlier))
    lines += [""] * bool(unfinished_nights)
    lines += [
        f"Night {previous.night}, started {previous.started_utc}, was {previous.state}."
        for previous in unfinished_nights
    ]
    lines += ["", "| Campaign | Verdict | |", "|---|---|---|"]
    lines += [f"| {_escape(run.name)} | {_escape(run.verdict)} | {_escape(run.sentence)} |" for run in campaigns]
    for title, group_changes in (("Regressions", regressions), ("Improvements", improvements)):
        if group_changes:
            lines += ["", f"## {title}", ""]
        for change in group_changes:
            before, now = ((percent if change.is_rate else number)(value) for value in (change.before, change.now))
            values = f"{before} in {count(change.nights, 'earlier night')}, {now} now (p = {change.p_value:.1g})"
            lines.append(f"- **{_escape(change.campaign)}: {_escape(change.metric)}**: {values}")
    text = (
        f"{count(compared, 'metric')} compared with earlier nights; the probability of a false alarm is at most "
        f"{format_fraction(MAX_FALSE_ALARM_PROBABILITY)}.{'' if changes else ' No metric has changed.'}"
    )
    lines += ["", text if compared else "No metric has a history for a comparison yet.", ""]
    return "\n".join(lines)


def _escape(text: str) -> str:
    """Escape characters with a meaning in Markdown or HTML."""
    escapes = {letter: f"&#{ord(letter)};" for letter in "&<>|"} | {letter: f"\\{letter}" for letter in "\\`*_[]#"}
    return "".join(escapes.get(letter, letter) for letter in " ".join(text.split()))
