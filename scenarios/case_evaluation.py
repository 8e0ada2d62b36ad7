"""Evaluation of a case: run each algorithm, score its answer, and combine the rows.

The first algorithm of a campaign is under test: its columns have no prefix. The columns of the compared algorithms have
their label as a prefix (`homography.velocity_error_m_s`), with separate `outcome`, `answered` and `error`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from marsyard.scenarios.algorithm_labels import labels
from marsyard.scenarios.algorithm_run import AlgorithmRun
from marsyard.scenarios.algorithm_selection import AlgorithmSelection
from marsyard.scenarios.interface import CaseResult, Scalar
from marsyard.scenarios.parts.scores import ScoredCase, compute_scores
from marsyard.scenarios.timeline import Timeline, timeline_products

Answer = TypeVar("Answer")

#: Column of the label of the algorithm under test.
ALGORITHM = "algorithm"


@dataclass(frozen=True)
class Score:
    """Score of an algorithm's answer.

    - answered: whether the answer is valid (the population `valid` of requirements)
    - row: columns of the answer and of its errors
    - products: arrays for the case's figures
    - custom_input: input of custom scores; None without an answer
    - timeline: creates the timeline of the case with this answer
    - outcome: outcome of the answer; empty for the name of its attribute `outcome`, or of the failure
    """

    answered: bool
    row: Mapping[str, Scalar]
    products: Mapping[str, Any] = field(default_factory=dict)
    custom_input: ScoredCase | None = None
    timeline: Callable[[], Timeline] | None = None
    outcome: str = ""


#: Runs of the algorithms by name, the one under test first.
Runs = Mapping[str, AlgorithmRun[Answer]]


def evaluate_case(
    p: AlgorithmSelection,
    conditions: Mapping[str, Scalar],
    run: Callable[[str], AlgorithmRun[Answer]],
    score: Callable[[str, Runs[Answer]], Score],
) -> CaseResult:
    """Evaluate all algorithms of a case.

    - p: selected algorithms, with the custom scores
    - conditions: columns that do not depend on an algorithm
    - run: runs an algorithm, given by name
    - score: scores the answer or failure of an algorithm, given by its name and the runs so far
    """
    runs: dict[str, AlgorithmRun[Answer]] = {}

    def evaluate(algorithm: str) -> CaseResult:
        runs[algorithm] = algorithm_run = run(algorithm)
        scored = score(algorithm, runs)
        row: dict[str, Scalar] = {**scored.row, **algorithm_run.row}
        if scored.custom_input is not None:
            row |= compute_scores(getattr(p, "scores", ()), scored.custom_input, {*row, *conditions})
        products = dict(scored.products)
        if scored.timeline is not None:
            products |= timeline_products(scored.timeline, is_tested=algorithm == p.algorithm)
        outcome = scored.outcome or algorithm_run.outcome_name
        return CaseResult(outcome, scored.answered, row, products, algorithm_run.failure)

    return _combine_results(labels(p.algorithms), [evaluate(name) for name in p.algorithms], conditions)


def _combine_results(
    names: Sequence[str], results: Sequence[CaseResult], conditions: Mapping[str, Scalar]
) -> CaseResult:
    """Combine the rows of the algorithms, given by their labels; the first is under test."""
    first, *compared_results = results
    row: dict[str, Scalar] = {ALGORITHM: names[0], **first.row, **conditions}
    for name, result in zip(names[1:], compared_results, strict=True):
        columns: dict[str, Scalar] = {"outcome": result.outcome, "answered": result.answered}
        columns |= _empty_columns(first.row) if result.failure is not None else {}
        columns |= result.row
        columns["error"] = "" if result.failure is None else result.failure.error
        row |= {f"{name}.{column}": value for column, value in columns.items()}
    return replace(first, row=row)


def _empty_columns(row: Mapping[str, Scalar]) -> dict[str, Scalar]:
    """Return the columns of a failed algorithm: without them a report would show those of the algorithm under test."""
    return {
        column: False if isinstance(value, bool | np.bool_) else float("nan")
        for column, value in row.items()
        if not isinstance(value, str)
    }
