"""Algorithms under test in a case: each is tried on its own, and what it does wrong is its own.

The first of a campaign's algorithms is the one that is judged: its columns stand in the row as they are. Those of every
further one stand behind, after its label and a point (`homography.velocity_error_m_s`), with its own `outcome`,
`answered` and `error`.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from marsyard.algorithms.exchange import ProgramDetails
from marsyard.algorithms.faults import AlgorithmError, Fault, describe_error
from marsyard.scenarios.estimators import labels
from marsyard.scenarios.handover import Given, Handover
from marsyard.scenarios.interface import CaseResult, Failure, Scalar, record_conditions

Answer = TypeVar("Answer")

#: The column that names the algorithm under test, and that of what a program wrote to its standard error.
ALGORITHM, STDERR = "algorithm", "stderr"


@dataclass(frozen=True)
class Attempt(Generic[Answer]):
    """What came of asking an algorithm.

    Attributes
    ----------
    answer
        Its answer, valid by the interface; None where it failed to give one.
    failure
        How it failed; None where it did not.
    row
        The time that it took (processor; of a program, wall-clock), and what a program wrote to its standard error.
    """

    answer: Answer | None
    failure: Failure | None
    row: Mapping[str, Scalar]

    def outcome(self, of_answer: Callable[[Answer], str]) -> str:
        """The outcome's name: the answer's own, or the fault's."""
        if self.answer is not None:
            return of_answer(self.answer)
        return self.failure.outcome if self.failure is not None else Fault.CRASHED.name


def attempted(ask: Callable[[], object], check: Callable[[object], Answer]) -> Attempt[Answer]:
    """Asks an algorithm, and holds its answer against the interface; whatever it raises is a failure of its own."""
    started = time.process_time()
    try:
        raw = ask()
        taken = time.process_time() - started
        answer = check(raw)
    except AlgorithmError as error:
        said = {STDERR: error.stderr} if error.stderr else {}
        return Attempt(None, Failure(error.fault.name, str(error), ""), {**_time(started), **said})
    except MemoryError as error:
        failure = Failure(Fault.OUT_OF_MEMORY.name, describe_error(error), traceback.format_exc())
        return Attempt(None, failure, _time(started))
    except Exception as error:
        failure = Failure(Fault.CRASHED.name, describe_error(error), traceback.format_exc())
        return Attempt(None, failure, _time(started))
    row: dict[str, Scalar] = {"estimation_time_s": answer_time_s(answer, taken)}
    details = getattr(answer, "details", None)
    if isinstance(details, ProgramDetails):
        row[STDERR] = details.stderr
    return Attempt(answer, None, row)


def attempted_with(
    ask: Callable[[Given], object], check: Callable[[object], Answer], measurements: Given
) -> Attempt[Answer]:
    """As `attempted`, of an algorithm that is given its own copy of measurements, and is not to change it."""
    handover = Handover(measurements)

    def check_both(answer: object) -> Answer:
        handover.check()
        return check(answer)

    return attempted(lambda: ask(handover.given), check_both)


def answer_time_s(answer: object, taken_s: float) -> float:
    """The time that an answer took: processor time, measured around it; of a program, the wall-clock time it tells."""
    details = getattr(answer, "details", None)
    return details.time_s if isinstance(details, ProgramDetails) else taken_s


def _time(started: float) -> dict[str, Scalar]:
    return {"estimation_time_s": time.process_time() - started}


@dataclass(frozen=True)
class Judged:
    """What one algorithm made of a case, scored. See `CaseResult`."""

    outcome: str
    answered: bool
    row: Mapping[str, Scalar]
    products: Mapping[str, Any] = field(default_factory=dict)
    failure: Failure | None = None


def case_result(
    algorithms: Sequence[str], judge: Callable[[str], Judged], conditions: Mapping[str, Scalar]
) -> CaseResult:
    """A case's result with every algorithm judged in it; its conditions are recorded before any is asked.

    Parameters
    ----------
    algorithms
        Their names, the first the one that is judged.
    judge
        Asks one of them, and scores its answer.
    conditions
        What the case was like: columns that do not depend on any algorithm.
    """
    record_conditions(conditions)
    names = labels(algorithms)
    first, *others = [judge(spec) for spec in algorithms]
    row: dict[str, Scalar] = {ALGORITHM: names[0], **first.row, **conditions}
    for name, other in zip(names[1:], others, strict=True):
        own: dict[str, Scalar] = {"outcome": other.outcome, "answered": other.answered, **other.row}
        own["error"] = "" if other.failure is None else other.failure.error
        row |= {f"{name}.{column}": value for column, value in own.items()}
    return CaseResult(
        outcome=first.outcome, answered=first.answered, row=row, products=first.products, failure=first.failure
    )
