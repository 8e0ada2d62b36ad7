"""Comparison of algorithms on the same cases, and of two stored campaigns.

Other algorithms are compared with the tested one (the algorithm under test) case by case: successes by the cases in
which only one algorithm succeeded, errors by the differences of the cases that both answered
(`marsyard.reports.statistics.changes`). Campaigns with the same draws (name, seed, dispersions) are paired as well;
otherwise they are compared per terrain if they share terrains, else with terrains as independent clusters. Cases on one
terrain form a cluster. All p-values are corrected by Holm's method.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Int

from marsyard.campaigns.definition.parameter_paths import leaves
from marsyard.campaigns.outcomes import ENGINE_FAILURES
from marsyard.reports import rates
from marsyard.reports.column_selection import primary_metric
from marsyard.reports.column_values import numbers
from marsyard.reports.decision import requirement_masks
from marsyard.reports.rates import CONFIDENCE, success_mask
from marsyard.reports.sampling_design import read_sampling_design
from marsyard.reports.section import Block, Grid, Section, Subject, build_grid
from marsyard.reports.statistics.changes import (
    Metric,
    Sample,
    compare_errors,
    compare_successes,
    correct_holm,
    difference_p_value,
    symmetry_p_value,
)
from marsyard.reports.stored import StoredRun, table
from marsyard.reports.wording import NOTHING, format_fraction, label, note_text, number, p_text, percent
from marsyard.scenarios.columns import split_unit


@dataclass(frozen=True)
class AlgorithmResult:
    """Results of one algorithm.

    - failed, succeeded: number of unfinished cases, and of cases with an error within the bound (None without a bound)
    - median, p95: median and 95 % quantile of the error's magnitude over the answered cases
    """

    name: str
    cases: int
    answered: int
    failed: int
    succeeded: int | None
    median: float
    p95: float


@dataclass(frozen=True)
class PairedComparison:
    """Another algorithm compared with the tested one on the same cases; p-values are corrected by Holm's method.

    - only_first, only_other: cases within the bound only for the tested or the other algorithm; None without bound
    - success_p, error_p: two-sided p-values of successes (`compare_successes`) and of the mean (`compare_errors`)
    - pairs: number of cases that both algorithms answered
    - mean, lower, upper: mean of the other algorithm's error minus the tested one's (magnitudes), with its interval
    """

    name: str
    only_first: int | None
    only_other: int | None
    success_p: float
    pairs: int
    mean: float
    lower: float
    upper: float
    error_p: float


def list_compared_algorithms(frame: pd.DataFrame) -> list[str]:
    """List the names of the other algorithms in the rows, which are compared with the tested one."""
    names = [str(column).removesuffix(".answered") for column in frame.columns if str(column).endswith(".answered")]
    return [name for name in names if rates.is_flag(frame, f"{name}.answered")]


def select_algorithm(frame: pd.DataFrame, name: str) -> pd.DataFrame:
    """Return the rows with the results of another algorithm in the columns of the tested one."""
    prefix = f"{name}."
    columns = [str(column) for column in frame.columns if str(column).startswith(prefix)]
    new_names = {name: name.removeprefix(prefix) for name in columns}
    return frame.drop(columns=[name for name in new_names.values() if name in frame]).rename(columns=new_names)


def summarize_algorithm(frame: pd.DataFrame, name: str, metric: str | None, bound: float | None) -> AlgorithmResult:
    """Summarize the rows of one algorithm; `name` is its label in the result."""
    magnitude = np.abs(numbers(frame, metric)) if metric is not None else np.full(len(frame), np.nan)
    finite = magnitude[np.isfinite(magnitude)]
    succeeded = None
    if metric is not None and bound is not None:
        succeeded = int(success_mask(frame, metric, bound).sum()) if metric in frame else 0
    return AlgorithmResult(
        name=name,
        cases=len(frame),
        answered=int(frame["answered"].eq(True).sum()),
        failed=int(frame["outcome"].isin(ENGINE_FAILURES).sum()),
        succeeded=succeeded,
        median=float(np.median(finite)) if finite.size else math.nan,
        p95=float(np.quantile(finite, 0.95)) if finite.size else math.nan,
    )


def compare_with_tested(
    tested: pd.DataFrame, other: pd.DataFrame, name: str, metric: str, bound: float | None
) -> PairedComparison:
    """Compare another algorithm, called `name`, with the tested one, from rows of the same cases in the same order."""
    tested_error, other_error = (np.abs(numbers(frame, metric)) for frame in (tested, other))
    both_answered, groups = np.isfinite(tested_error) & np.isfinite(other_error), rates.terrain_groups(tested)
    success: tuple[int | None, int | None, float] = (None, None, math.nan)
    if bound is not None:
        success = compare_successes(tested_error <= bound, other_error <= bound, groups)
    answered_groups = None if groups is None else groups[both_answered]
    mean, lower, upper, p_value = compare_errors(
        (other_error - tested_error)[both_answered], answered_groups, CONFIDENCE
    )
    return PairedComparison(name, *success, int(both_answered.sum()), mean, lower, upper, p_value)


def compare_algorithms(
    frame: pd.DataFrame, metric: str | None, bound: float | None
) -> tuple[list[AlgorithmResult], list[PairedComparison]]:
    """Summarize all algorithms, the tested one first, and compare the others with it; empty for a single algorithm."""
    names = list_compared_algorithms(frame)
    # cases that ended before any algorithm ran have no answers to compare
    frame = frame[np.logical_and.reduce([frame[f"{name}.answered"].notna() for name in names])] if names else frame
    if not names or frame.empty:
        return [], []
    tested_name = str(frame["algorithm"].iloc[0]) if "algorithm" in frame else "tested"
    frames = {name: select_algorithm(frame, name) for name in names}
    results = [summarize_algorithm(frame, tested_name, metric, bound)]
    results += [summarize_algorithm(rows, name, metric, bound) for name, rows in frames.items()]
    if metric is None:
        return results, []
    differences = [
        compare_with_tested(frame, rows, name, metric, bound) for name, rows in frames.items() if metric in rows
    ]
    success_p, error_p = (
        correct_holm([difference.success_p for difference in differences]),
        correct_holm([difference.error_p for difference in differences]),
    )
    corrected_p_values = zip(differences, success_p, error_p, strict=True)
    return results, [
        replace(difference, success_p=success_p_value, error_p=error_p_value)
        for difference, success_p_value, error_p_value in corrected_p_values
    ]


def comparison_section(subject: Subject) -> Section | None:
    """Compare the algorithms; None for a single algorithm."""
    results, differences = compare_algorithms(subject.frame, subject.metric, subject.bound)
    if not results:
        return None
    grids = comparison_grids(results, differences, subject.metric)
    tested_name = results[0].name
    note = note_text("common.comparison", tested=tested_name, confidence=format_fraction(CONFIDENCE))
    blocks = [Block(grid=grids[0])]
    if differences:
        blocks.append(Block(heading=f"Against {tested_name}", grid=grids[1], note=note))
    data = {"algorithms": results, "against": tested_name, "differences": differences}
    return Section("algorithms", "Algorithms", "Algorithms on the same cases", blocks, data)


def comparison_grids(
    results: Sequence[AlgorithmResult], differences: Sequence[PairedComparison], metric: str | None
) -> tuple[Grid, Grid]:
    """Create the tables of results and of differences."""
    unit = f" ({split_unit(metric)[1]})" if metric is not None and split_unit(metric)[1] else ""
    first = build_grid(
        results,
        {
            "Algorithm": lambda result: result.name,
            "Answered": lambda result: percent(result.answered / result.cases),
            "Failed": lambda result: f"{result.failed:,}",
            "Within the bound (of all cases)": lambda result: (
                NOTHING if result.succeeded is None else percent(result.succeeded / result.cases)
            ),
            f"Median{unit}": lambda result: number(result.median),
            f"95th percentile{unit}": lambda result: number(result.p95),
        },
    )
    tested_name = results[0].name if results else ""
    rows = []
    for difference in differences:
        successes = [NOTHING if n is None else f"{n:,}" for n in (difference.only_first, difference.only_other)]
        mean_text = f"{number(difference.mean)} ({number(difference.lower)} to {number(difference.upper)})"
        texts = [difference.name, *successes, p_text(difference.success_p), f"{difference.pairs:,}"]
        rows.append([*texts, mean_text if difference.pairs else NOTHING, p_text(difference.error_p)])
    head = ["Algorithm", f"Success only: {tested_name}", "Success only: other", "p (success)", "Cases answered by both"]
    return first, Grid([*head, f"Difference{unit}", "p (error)"], rows)


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

    name: str
    first: Metric
    second: Metric
    p_value: float


def list_metrics(run: StoredRun) -> tuple[pd.DataFrame, list[Metric]]:
    """Return the rows without the nominal case, and the metrics that can be compared between campaigns.

    Metrics: success of each requirement, errors, "answered", and "came to an end" (the case was completed).
    """
    frame = read_sampling_design(run.definition).exclude_nominal_case(run.frame)
    metrics: dict[str, Metric] = {}
    terrains = number_stored_terrains(frame)

    def add_metric(name: str, values: Float[np.ndarray, " n"], title: str = "", *, is_rate: bool = True) -> None:
        metrics[name] = Metric(title or name, is_rate, Sample(values, terrains))

    error_columns = dict.fromkeys([primary_metric(frame, run.requirements)])
    for requirement in run.requirements:
        name, metric = str(requirement.get("id", "?")), str(requirement.get("metric", ""))
        masks = requirement_masks(frame, requirement)
        if masks is None:
            continue
        member, success = masks
        add_metric(name, np.where(member, success.astype(np.float64), np.nan))
        if metric in frame and isinstance(requirement.get("bound"), int | float):
            error_columns[metric] = None
    for column in filter(None, error_columns):
        magnitude = np.abs(numbers(frame, column))
        add_metric(column, np.where(np.isfinite(magnitude), magnitude, np.nan), label(column), is_rate=False)
    if rates.is_flag(frame, "answered"):
        add_metric("answered", rates.population_mask(frame, "valid").astype(np.float64))
    add_metric("came to an end", rates.population_mask(frame, "completed").astype(np.float64))
    return frame, list(metrics.values())


def compare_campaigns(first: StoredRun, second: StoredRun) -> tuple[bool, list[MetricComparison]]:
    """Return whether the campaigns' cases are paired, and the comparisons of the metrics of both campaigns."""
    frames, metrics = zip(*(list_metrics(run) for run in (first, second)), strict=True)
    are_paired = have_same_draws(first, second)
    second_metrics = {metric.name: metric for metric in metrics[1]}
    metric_pairs = [(metric, second_metrics[metric.name]) for metric in metrics[0] if metric.name in second_metrics]
    share_terrains = have_same_terrains(first, second)
    p_values = correct_holm(
        [
            _paired_p_value(frames[0], pair[0], frames[1], pair[1])
            if are_paired
            else _unpaired_p_value(*pair, share_terrains)
            for pair in metric_pairs
        ]
    )
    comparisons = [
        MetricComparison(pair[0].name, *pair, p_value) for pair, p_value in zip(metric_pairs, p_values, strict=True)
    ]
    return are_paired, comparisons


def have_same_draws(first: StoredRun, second: StoredRun) -> bool:
    """Whether equal case numbers are the same case in both campaigns."""
    keys = ("name", "scenario", "seed", "dispersions", "design")
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


def number_stored_terrains(frame: pd.DataFrame) -> Int[np.ndarray, " n"]:
    """Return the stored terrain numbers of cases, which are comparable between campaigns."""
    groups = rates.terrain_groups(frame)
    if groups is None:
        return np.zeros(len(frame), dtype=np.int64)
    terrains = pd.to_numeric(frame["terrain"], errors="coerce").to_numpy(dtype=np.float64, na_value=np.nan)
    # negative numbers: one for each case of unknown terrain, and one for each terrain without a number
    return np.where(np.isfinite(terrains), np.nan_to_num(terrains), -1.0 - groups).astype(np.int64)


def _unpaired_p_value(first: Metric, second: Metric, share_terrains: bool) -> float:
    first_sample, second_sample = first.sample, second.sample
    if not share_terrains:  # equal numbers are different terrains: shift the second numbers above the first
        if not first_sample.terrains.size or not second_sample.terrains.size:
            return math.nan
        renumbered = second_sample.terrains + (1 + int(first_sample.terrains.max()) - int(second_sample.terrains.min()))
        second_sample = Sample(second_sample.values, renumbered)
    return difference_p_value(first_sample, second_sample)


def _paired_p_value(first: pd.DataFrame, first_metric: Metric, second: pd.DataFrame, second_metric: Metric) -> float:
    _, first_index, second_index = np.intersect1d(first["case"], second["case"], return_indices=True)
    first_values, second_values = first_metric.sample.values[first_index], second_metric.sample.values[second_index]
    finite = np.isfinite(first_values) & np.isfinite(second_values)
    if not finite.any():
        return math.nan
    groups = rates.terrain_groups(first)
    finite_groups = None if groups is None else groups[first_index][finite]
    if first_metric.is_rate:
        return compare_successes(first_values[finite] > 0.5, second_values[finite] > 0.5, finite_groups)[2]
    return symmetry_p_value(second_values[finite] - first_values[finite], finite_groups)
