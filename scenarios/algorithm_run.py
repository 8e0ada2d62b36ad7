"""Run the algorithms of a case separately: a failure of one does not affect the others, nor do changes of its inputs.

The first algorithm of a campaign is under test: its columns have no prefix. Those of the compared ones have their label
as a prefix (`homography.velocity_error_m_s`), with their own `outcome`, `answered` and `error`.
"""

from __future__ import annotations

import copy
import hashlib
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Annotated, Any, ClassVar, Generic, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.answers import AlgorithmError, Fault, describe_error
from marsyard.algorithms.exchange import ExecutableLimits, ProgramDetails
from marsyard.scenarios.estimators import Task, check_algorithms, labels
from marsyard.scenarios.interface import CaseResult, Failure, Scalar, record_conditions

Answer = TypeVar("Answer")
Given = TypeVar("Given")

#: Columns of the algorithm under test, and of a program's standard error.
ALGORITHM, STDERR = "algorithm", "stderr"


@dataclass(frozen=True)
class AlgorithmRun(Generic[Answer]):
    """The answer or failure of an algorithm.

    - answer: valid answer; None for a failure
    - failure: None for an answer
    - row: computation time (processor; of a program, wall-clock), and a program's standard error
    """

    answer: Answer | None
    failure: Failure | None
    row: Mapping[str, Scalar]

    def outcome(self, of_answer: Callable[[Answer], str]) -> str:
        """Return the name of the answer's outcome, or of the fault."""
        if self.answer is not None:
            return of_answer(self.answer)
        return self.failure.outcome if self.failure is not None else Fault.CRASHED.name


class Handover(Generic[Given]):
    """One algorithm's read-only copy `given` of its inputs: data classes, arrays and poses."""

    def __init__(self, original: Given) -> None:
        self.given = copy_inputs(original)
        self._fingerprint = hash_inputs(self.given)

    def check(self) -> None:
        """Raise AlgorithmError (BAD_ANSWER) if the algorithm changed its copy, pictures included."""
        if hash_inputs(self.given) != self._fingerprint:
            raise AlgorithmError(
                Fault.BAD_ANSWER, "it changed the measurements that it was given; allowed: to read them, or copies"
            )


def copy_inputs(original: Given, *, writable: bool = False) -> Given:
    """Return a deep copy whose arrays are read-only, or writable to detect changes.

    Rotations and transforms are immutable and not copied: a copy would be normalised again, with other last digits.
    """
    poses = {id(part): part for part in _parts(original) if isinstance(part, Rotation | RigidTransform)}
    copied = copy.deepcopy(original, dict(poses))
    for part in _parts(copied):
        if isinstance(part, np.ndarray):
            part.flags.writeable = writable
    return copied


def hash_inputs(value: Any, leave: tuple[str, ...] = ()) -> str:
    """Compute the SHA-256 of all values in arrays, poses and data classes, without the fields in `leave`."""
    digest = hashlib.sha256()
    for part in _parts(value, leave):
        if isinstance(part, np.ndarray):
            digest.update(f"{part.dtype}{part.shape}".encode())
            digest.update(np.ascontiguousarray(part).data)
        elif isinstance(part, Rotation):
            digest.update(part.as_quat().tobytes())
        elif isinstance(part, RigidTransform):
            digest.update(part.as_matrix().tobytes())
        else:
            digest.update(repr(part).encode())
    return digest.hexdigest()


def _parts(value: Any, leave: tuple[str, ...] = ()) -> Iterator[Any]:
    """Yield the arrays, poses and other values in data classes, lists and tuples, and the names of the types."""
    if is_dataclass(value) and not isinstance(value, type):
        yield type(value).__name__
        for field in fields(value):
            if field.name not in leave:
                yield from _parts(getattr(value, field.name), leave)
    elif isinstance(value, list | tuple):
        yield len(value)
        for inner in value:
            yield from _parts(inner, leave)
    else:
        yield value


def run_algorithm(ask: Callable[[], object], check: Callable[[object], Answer]) -> AlgorithmRun[Answer]:
    """Run an algorithm and validate its answer; all exceptions become failures of the algorithm."""
    started = time.process_time()
    try:
        raw = ask()
        elapsed_s = time.process_time() - started
        answer = check(raw)
    except Exception as error:
        row: dict[str, Scalar] = {"estimation_time_s": time.process_time() - started}
        if isinstance(error, AlgorithmError):
            row |= {STDERR: error.stderr} if error.stderr else {}
            return AlgorithmRun(None, Failure(error.fault.name, str(error), ""), row)
        fault = Fault.OUT_OF_MEMORY if isinstance(error, MemoryError) else Fault.CRASHED
        return AlgorithmRun(None, Failure(fault.name, describe_error(error), traceback.format_exc()), row)
    row = {"estimation_time_s": answer_time_s(answer, elapsed_s)}
    details = getattr(answer, "details", None)
    if isinstance(details, ProgramDetails):
        row[STDERR] = details.stderr
    return AlgorithmRun(answer, None, row)


def run_algorithm_on_copy(
    ask: Callable[[Given], object], check: Callable[[object], Answer], measurements: Given
) -> AlgorithmRun[Answer]:
    """Run an algorithm on its own copy of the measurements, which it may not change; see `run_algorithm`."""
    handover = Handover(measurements)

    def check_both(answer: object) -> Answer:
        handover.check()
        return check(answer)

    return run_algorithm(lambda: ask(handover.given), check_both)


def answer_time_s(answer: object, taken_s: float) -> float:
    """Return the computation time: the measured processor time; of a program, the wall-clock time that it reports."""
    details = getattr(answer, "details", None)
    return details.time_s if isinstance(details, ProgramDetails) else taken_s


def case_result(
    algorithms: Sequence[str], evaluate: Callable[[str], CaseResult], conditions: Mapping[str, Scalar]
) -> CaseResult:
    """Record the conditions, score each algorithm by `evaluate` (the first is under test), and combine the results."""
    record_conditions(conditions)
    names = labels(algorithms)
    first, *others = [evaluate(spec) for spec in algorithms]
    row: dict[str, Scalar] = {ALGORITHM: names[0], **first.row, **conditions}
    for name, other in zip(names[1:], others, strict=True):
        own: dict[str, Scalar] = {"outcome": other.outcome, "answered": other.answered, **other.row}
        own["error"] = "" if other.failure is None else other.failure.error
        row |= {f"{name}.{column}": value for column, value in own.items()}
    return replace(first, row=row)


class AlgorithmSelection(BaseModel):
    """Parameters of scenarios with selectable algorithms; subclasses define the field `algorithm`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    task: ClassVar[Task[Any, Any]]

    algorithm: str
    compared: Annotated[
        tuple[str, ...], Field(description="further algorithms, run on the same cases and compared with the first")
    ] = ()
    executable: Annotated[ExecutableLimits, Field(description="what an algorithm that is a program may use")] = (
        ExecutableLimits()
    )

    @property
    def algorithms(self) -> tuple[str, ...]:
        """All algorithms; the first is the one under test."""
        return (self.algorithm, *self.compared)

    @field_validator("algorithm")
    @classmethod
    def _check_algorithm(cls, name: str) -> str:
        cls.task.check(name)
        return name

    @field_validator("compared")
    @classmethod
    def _check_compared(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        check_algorithms(cls.task, names)
        return names

    @model_validator(mode="after")
    def _check_distinct(self) -> AlgorithmSelection:
        if self.algorithm in self.compared:
            raise ValueError(f"the algorithm '{self.algorithm}' is named twice")
        return self
