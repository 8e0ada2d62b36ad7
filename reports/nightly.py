"""Changes of the metrics of a nightly run ("night") since earlier nights, and the page of a night."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import takewhile

import numpy as np

from marsyard.reports.metrics import Metric
from marsyard.reports.night_history import FINISHED, History, MetricChange, Night, NightCampaign
from marsyard.reports.statistics.difference_tests import Sample, correct_holm, difference_p_value
from marsyard.reports.wording import count, format_fraction, number, percent

#: Maximum probability of at least one false alarm in a night in which no metric has changed.
MAX_FALSE_ALARM_PROBABILITY = 0.01
#: Significance level of changes. The other half of the probability allows for a second false alarm: after a false
#: alarm, the only reference is one unusual night (docs/adr/0027).
_SIGNIFICANCE = 0.5 * MAX_FALSE_ALARM_PROBABILITY
#: Expected number of permutations that exceed a change at the significance level.
_MIN_EXCEEDANCES = 10


@dataclass(frozen=True)
class NightComparison:
    """A metric of one night, and its samples in earlier nights (`before`); without values if its column is missing."""

    campaign: str
    metric: Metric
    before: Sequence[Sample]


def find_changes(comparisons: Sequence[NightComparison]) -> list[MetricChange]:
    """Find the changed metrics of a night; a false alarm has at most the probability `MAX_FALSE_ALARM_PROBABILITY`.

    A metric whose column is missing has changed with certainty.
    """
    earlier_samples = [_join_samples(comparison.before) for comparison in comparisons]
    # Holm's method compares the smallest p-value with the significance level divided by the number of metrics
    permutations = math.ceil(_MIN_EXCEEDANCES * len(comparisons) / _SIGNIFICANCE)
    p_values = correct_holm(
        [
            math.nan
            if sample is None or _is_missing(comparison)
            else difference_p_value(comparison.metric.sample, sample, permutations)
            for comparison, sample in zip(comparisons, earlier_samples, strict=True)
        ]
    )
    p_values = [
        0.0 if _is_missing(comparison) else p_value for comparison, p_value in zip(comparisons, p_values, strict=True)
    ]
    return [
        MetricChange(
            campaign=comparison.campaign,
            metric=comparison.metric.name,
            is_rate=comparison.metric.is_rate,
            before=replace(comparison.metric, sample=sample).summary,
            now=comparison.metric.summary,
            p_value=p_value,
            nights=len(comparison.before),
        )
        for comparison, sample, p_value in zip(comparisons, earlier_samples, p_values, strict=True)
        if sample is not None and p_value <= _SIGNIFICANCE
    ]


def _is_missing(comparison: NightComparison) -> bool:
    """Whether the rows of the night lack the column of a metric."""
    had_values = any(sample.values.size for sample in comparison.before)
    return had_values and not comparison.metric.sample.values.size


def _join_samples(samples: Sequence[Sample]) -> Sample | None:
    """Join the samples of several nights; None without a sample."""
    if not samples:
        return None
    return Sample(
        np.concatenate([sample.values for sample in samples]), np.concatenate([sample.terrains for sample in samples])
    )


def list_comparisons(history: History, night: int) -> list[NightComparison]:
    """List every metric of a night, and of the night before it, with its samples in earlier nights."""
    return [
        NightComparison(campaign.name, metric, history.earlier_samples(night, campaign, metric.name))
        for campaign in history.campaigns(night)
        for metric in (*history.metrics(night, campaign.name), *history.missing_metrics(night, campaign))
    ]


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
            if math.isnan(change.now):
                lines.append(f"- **{_escape(change.campaign)}: {_escape(change.metric)}**: its column is missing now")
                continue
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
