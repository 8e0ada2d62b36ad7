"""Comparison of two stored campaigns, metric by metric.

Campaigns with the same draws (name, seed, dispersions) are paired; otherwise they are compared per terrain if they
share terrains, else with terrains as independent clusters. Cases on one terrain form a cluster. All p-values are
corrected by Holm's method.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from marsyard.campaigns.definition.parameter_paths import leaves
from marsyard.reports import rates
from marsyard.reports.metrics import Metric, list_metrics
from marsyard.reports.section import Grid
from marsyard.reports.statistics.difference_tests import Sample, correct_holm, difference_p_value
from marsyard.reports.statistics.paired_tests import compare_successes, symmetry_p_value
from marsyard.reports.stored import StoredRun, table
from marsyard.reports.wording import NOTHING, number, p_text, percent


def metric_text(metric: Metric) -> str:
    """Format the rate with its number of cases, or median and 95 % quantile."""
    values = metric.finite_values
    if values.size == 0:
        return NOTHING
    if metric.is_rate:
        return f"{percent(metric.summary)} of {values.size:,}"
    return f"{number(metric.summary)}, 95 % {number(float(np.quantile(values, 0.95)))}"


@dataclass(frozen=True)
class MetricComparison:
    """One metric of both campaigns, and the corrected two-sided p-value of their difference."""

    first: Metric
    second: Metric
    p_value: float

    @property
    def name(self) -> str:
        """Name of the metric."""
        return self.first.name


def compare_campaigns(first: StoredRun, second: StoredRun) -> tuple[bool, list[MetricComparison]]:
    """Return whether the campaigns' cases are paired, and the comparisons of the metrics of both campaigns."""
    (first_frame, first_metrics), (second_frame, second_metrics) = list_metrics(first), list_metrics(second)
    are_paired = have_same_draws(first, second)
    seconds_by_name = {metric.name: metric for metric in second_metrics}
    metric_pairs = [
        (metric, seconds_by_name[metric.name]) for metric in first_metrics if metric.name in seconds_by_name
    ]
    # cases without terrains are independent of each other, as the cases of one and the same terrain
    has_terrains = any(rates.terrain_groups(frame) is not None for frame in (first_frame, second_frame))
    share_terrains = have_same_terrains(first, second) or not has_terrains
    p_values = correct_holm(
        [
            _paired_p_value(first_frame, first_metric, second_frame, second_metric)
            if are_paired
            else _unpaired_p_value(first_metric, second_metric, share_terrains)
            for first_metric, second_metric in metric_pairs
        ]
    )
    return are_paired, [MetricComparison(*pair, p_value) for pair, p_value in zip(metric_pairs, p_values, strict=True)]


def have_same_draws(first: StoredRun, second: StoredRun) -> bool:
    """Whether equal case numbers are the same case in both campaigns."""
    keys = ["name", "scenario", "seed", "dispersions", "design"]
    if table(first.recorded("design")).get("kind", "random") != "random":
        keys += ["cases", "appended"]  # the draws of a stratified design depend on the sizes of its blocks
    return _bank_seeds(first) == _bank_seeds(second) and all(
        first.recorded(key) == second.recorded(key) for key in keys
    )


def _bank_seeds(run: StoredRun) -> dict[str, Any]:
    """Return the seeds of the terrain banks by parameter path; terrains with other seeds are different terrains."""
    return {path: value for path, value in leaves(table(run.recorded("parameters"))) if path.endswith("bank_seed")}


def have_same_terrains(first: StoredRun, second: StoredRun) -> bool:
    """Whether equal terrain numbers are the same terrain: all parameters but the algorithm's are equal."""
    parameters = [
        {name: value for name, value in table(run.recorded("parameters")).items() if name != "algorithm"}
        for run in (first, second)
    ]
    return parameters[0] == parameters[1] and first.recorded("scenario") == second.recorded("scenario")


def campaign_diff_grid(names: Sequence[str], comparisons: Sequence[MetricComparison]) -> Grid:
    """Create a table with the metrics of both campaigns."""
    head = ["", *names, "p"]
    return Grid(
        head, [[row.name, metric_text(row.first), metric_text(row.second), p_text(row.p_value)] for row in comparisons]
    )


def campaign_diff_data(comparisons: Sequence[MetricComparison]) -> list[dict[str, Any]]:
    """Convert the comparisons to JSON data: rate or median of each campaign with its cases; None for NaN."""

    def summarize(metric: Metric) -> dict[str, Any]:
        key, cases = "rate" if metric.is_rate else "median", metric.finite_values.size
        return {key: metric.summary if cases else None, "cases": cases}

    return [
        {"name": row.name, "first": summarize(row.first), "second": summarize(row.second)}
        | {"p": None if math.isnan(row.p_value) else row.p_value}
        for row in comparisons
    ]


def _unpaired_p_value(first: Metric, second: Metric, share_terrains: bool) -> float:
    """Compare a metric of different cases; share_terrains: whether equal terrain numbers are the same terrain."""
    first_sample, second_sample = first.sample, second.sample
    if not share_terrains:  # equal numbers are different terrains: shift the second numbers above the first
        if not first_sample.terrains.size or not second_sample.terrains.size:
            return math.nan
        renumbered = second_sample.terrains + (1 + int(first_sample.terrains.max()) - int(second_sample.terrains.min()))
        second_sample = Sample(second_sample.values, renumbered)
    return difference_p_value(first_sample, second_sample)


def _paired_p_value(first: pd.DataFrame, first_metric: Metric, second: pd.DataFrame, second_metric: Metric) -> float:
    """Compare a metric of the cases that both campaigns have; NaN without such a case."""
    _, first_index, second_index = np.intersect1d(first["case"], second["case"], return_indices=True)
    first_values, second_values = first_metric.sample.values[first_index], second_metric.sample.values[second_index]
    finite = np.isfinite(first_values) & np.isfinite(second_values)
    if not finite.any():
        return math.nan
    groups = rates.terrain_groups(first)
    finite_groups = None if groups is None else groups[first_index][finite]
    if first_metric.is_rate:
        _, _, p_value = compare_successes(first_values[finite] > 0.5, second_values[finite] > 0.5, finite_groups)
        return p_value
    return symmetry_p_value(second_values[finite] - first_values[finite], finite_groups)
