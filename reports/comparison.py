"""Comparison of algorithms on the same cases.

Other algorithms are compared with the tested one (the algorithm under test) case by case: successes by the cases in
which only one algorithm succeeded, errors by the differences of the cases that both answered
(`marsyard.reports.statistics.paired_tests`). All p-values are corrected by Holm's method.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from jaxtyping import Float

from marsyard.campaigns.outcomes import ENGINE_FAILURES
from marsyard.reports import populations, rates
from marsyard.reports.column_values import numbers
from marsyard.reports.populations import success_mask
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Block, Grid, Section, Subject, build_grid
from marsyard.reports.statistics.difference_tests import correct_holm
from marsyard.reports.statistics.paired_tests import compare_errors, compare_successes
from marsyard.reports.wording import NOTHING, count, format_fraction, note_text, number, p_text, percent
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
    return [name for name in names if populations.is_flag(frame, f"{name}.answered")]


def select_algorithm(frame: pd.DataFrame, name: str) -> pd.DataFrame:
    """Return the rows with the results of another algorithm in the columns of the tested one."""
    prefix = f"{name}."
    columns = [str(column) for column in frame.columns if str(column).startswith(prefix)]
    new_names = {name: name.removeprefix(prefix) for name in columns}
    return frame.drop(columns=[name for name in new_names.values() if name in frame]).rename(columns=new_names)


def summarize_algorithm(frame: pd.DataFrame, name: str, metric: str | None, bound: float | None) -> AlgorithmResult:
    """Summarize the rows of one algorithm; `name` is its label in the result."""
    magnitude = _error_magnitudes(frame, metric) if metric is not None else np.full(len(frame), np.nan)
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


def _error_magnitudes(frame: pd.DataFrame, metric: str) -> Float[np.ndarray, " n"]:
    """Return the magnitude of the error of each case; NaN for unfinished cases, whose errors no algorithm caused."""
    return np.where(populations.engine_failed(frame), np.nan, np.abs(numbers(frame, metric)))


def compare_with_tested(
    tested: pd.DataFrame, other: pd.DataFrame, name: str, metric: str, bound: float | None
) -> PairedComparison:
    """Compare another algorithm, called `name`, with the tested one, from rows of the same cases in the same order."""
    tested_error, other_error = (_error_magnitudes(frame, metric) for frame in (tested, other))
    both_answered, groups = np.isfinite(tested_error) & np.isfinite(other_error), rates.terrain_groups(tested)
    success: tuple[int | None, int | None, float] = (None, None, math.nan)
    if bound is not None:
        tested_success, other_success = (success_mask(frame, metric, bound) for frame in (tested, other))
        success = compare_successes(tested_success, other_success, groups)
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
    success_p = correct_holm([difference.success_p for difference in differences])
    error_p = correct_holm([difference.error_p for difference in differences])
    corrected = zip(differences, success_p, error_p, strict=True)
    return results, [replace(item, success_p=p_success, error_p=p_error) for item, p_success, p_error in corrected]


def comparison_section(subject: Subject) -> Section | None:
    """Compare the algorithms; None for a single algorithm."""
    results, differences = compare_algorithms(subject.frame, subject.metric, subject.bound)
    if not results:
        return None
    result_grid, difference_grid = comparison_grids(results, differences, subject.metric)
    tested_name = results[0].name
    note = note_text("common.comparison", tested=tested_name, confidence=format_fraction(CONFIDENCE))
    left_out = len(subject.frame) - results[0].cases
    left_out_note = f"Left out: {count(left_out, 'case')} that ended before all algorithms had run."
    blocks = [Block(grid=result_grid, note=left_out_note if left_out else "")]
    if differences:
        blocks.append(Block(heading=f"Against {tested_name}", grid=difference_grid, note=note))
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
            "Not finished": lambda result: f"{result.failed:,}",
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
