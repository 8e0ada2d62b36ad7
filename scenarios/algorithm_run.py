"""Run the algorithms of a case separately: a failure or changed inputs of one algorithm do not affect the others."""

from __future__ import annotations

import copy
import hashlib
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Annotated, Any, ClassVar, Generic, TypeVar

import numpy as np
from pydantic import Field, field_validator, model_validator
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.exchange import ExecutableLimits, ProgramDetails, answer_time_s
from marsyard.algorithms.faults import AlgorithmError, Fault, describe_error
from marsyard.scenarios.estimators import Task, check_algorithms
from marsyard.scenarios.interface import Failure, Scalar
from marsyard.scenarios.isolation.remote import algorithm_time_s, is_remote
from marsyard.sim.parameters import Parameters

Algorithm = TypeVar("Algorithm")
Answer = TypeVar("Answer")
Inputs = TypeVar("Inputs")

#: Column of the standard error of an external program.
STDERR = "stderr"


@dataclass(frozen=True)
class AlgorithmRun(Generic[Answer]):
    """The answer or failure of an algorithm.

    - answer: valid answer; None for a failure
    - failure: None for an answer
    - row: columns: computation time (processor time; wall-clock time of an external program), and standard error
    """

    answer: Answer | None
    failure: Failure | None
    row: Mapping[str, Scalar]

    @property
    def outcome_name(self) -> str:
        """Name of the answer's outcome, or of the fault if there is no answer."""
        if self.answer is not None:
            return str(self.answer.outcome.name)  # type: ignore[attr-defined]
        return self.failure.outcome if self.failure is not None else Fault.CRASHED.name


class InputCopy(Generic[Inputs]):
    """Read-only copy `inputs` of the inputs of one algorithm: data classes, arrays and poses."""

    def __init__(self, original: Inputs) -> None:
        self.inputs = copy_inputs(original)
        self._fingerprint = hash_inputs(self.inputs)

    def check(self) -> None:
        """Raise AlgorithmError (BAD_ANSWER) if the algorithm changed its copy, images included."""
        if hash_inputs(self.inputs) != self._fingerprint:
            raise AlgorithmError(
                Fault.BAD_ANSWER, "it changed its measurements; allowed: reading them, and changing copies"
            )


def copy_inputs(original: Inputs, *, writable: bool = False) -> Inputs:
    """Return a deep copy whose arrays are read-only, or writable to detect changes.

    Rotations and transforms are immutable and not copied: a copy would be normalised again, with different last digits.
    """
    # `deepcopy` does not copy the objects in its second argument
    immutable = {id(item): item for item in _walk_values(original) if isinstance(item, Rotation | RigidTransform)}
    duplicate = copy.deepcopy(original, dict(immutable))
    for item in _walk_values(duplicate):
        if isinstance(item, np.ndarray):
            item.flags.writeable = writable
    return duplicate


def hash_inputs(value: Any, excluded: tuple[str, ...] = ()) -> str:
    """Compute the SHA-256 of all values in arrays, poses and data classes, without the fields in `excluded`."""
    digest = hashlib.sha256()
    array_digests: dict[int, bytes] = {}  # all images of a stream contain the same calibration
    for item in _walk_values(value, excluded):
        if isinstance(item, np.ndarray):
            if id(item) not in array_digests:
                array_digests[id(item)] = hashlib.sha256(np.ascontiguousarray(item).data).digest()
            digest.update(f"{item.dtype}{item.shape}".encode())
            digest.update(array_digests[id(item)])
        elif isinstance(item, Rotation):
            digest.update(item.as_quat().tobytes())
        elif isinstance(item, RigidTransform):
            digest.update(item.as_matrix().tobytes())
        else:
            digest.update(repr(item).encode())
    return digest.hexdigest()


def _walk_values(value: Any, excluded: tuple[str, ...] = ()) -> Iterator[Any]:
    """Walk through data classes, lists and tuples; yield the class names, lengths, arrays, poses and other values."""
    if is_dataclass(value) and not isinstance(value, type):
        yield type(value).__name__
        for field in fields(value):
            if field.name not in excluded:
                yield from _walk_values(getattr(value, field.name), excluded)
    elif isinstance(value, list | tuple):
        yield len(value)
        for inner in value:
            yield from _walk_values(inner, excluded)
    else:
        yield value


def run_algorithm(call: Callable[[], object], check: Callable[[object], Answer]) -> AlgorithmRun[Answer]:
    """Run an algorithm and validate its answer; all exceptions become failures of the algorithm."""
    start_s = algorithm_time_s()
    try:
        raw_answer = call()
        elapsed_s = algorithm_time_s() - start_s
        answer = check(raw_answer)
    except Exception as error:
        row: dict[str, Scalar] = {"estimation_time_s": algorithm_time_s() - start_s}
        if isinstance(error, AlgorithmError):
            row |= {STDERR: error.stderr} if error.stderr else {}
            return AlgorithmRun(None, Failure(error.fault.name, str(error), error.trace), row)
        fault = Fault.OUT_OF_MEMORY if isinstance(error, MemoryError) else Fault.CRASHED
        return AlgorithmRun(None, Failure(fault.name, describe_error(error), traceback.format_exc()), row)
    row = {"estimation_time_s": answer_time_s(answer, elapsed_s)}
    details = getattr(answer, "details", None)
    if isinstance(details, ProgramDetails):
        row[STDERR] = details.stderr
    return AlgorithmRun(answer, None, row)


def call_estimate(estimator: Any, measurements: Any) -> object:
    """Call the method `estimate` of an estimator."""
    return estimator.estimate(measurements)


def run_on_measurements(
    create: Callable[[], Algorithm],
    check: Callable[[object], Answer],
    measurements: Inputs,
    call: Callable[[Algorithm, Inputs], object] = call_estimate,
) -> AlgorithmRun[Answer]:
    """Create an algorithm, call it with the measurements and validate its answer; see `run_algorithm`.

    An algorithm in this process receives a copy of the measurements, which it must not change. One in a process of its
    own cannot change them.
    """
    input_copy: InputCopy[Inputs] | None = None

    def create_and_call() -> object:
        nonlocal input_copy
        algorithm = create()
        if is_remote(algorithm):
            return call(algorithm, measurements)
        input_copy = InputCopy(measurements)
        return call(algorithm, input_copy.inputs)

    def check_inputs_and_answer(answer: object) -> Answer:
        if input_copy is not None:
            input_copy.check()
        return check(answer)

    return run_algorithm(create_and_call, check_inputs_and_answer)


class AlgorithmSelection(Parameters):
    """Parameters of scenarios with selectable algorithms; subclasses define the field `algorithm`."""

    task: ClassVar[Task[Any, Any]]

    algorithm: str
    compared: Annotated[
        tuple[str, ...], Field(description="further algorithms, run on the same cases and compared with the first")
    ] = ()
    executable: Annotated[ExecutableLimits, Field(description="limits and isolation of custom algorithms")] = (
        ExecutableLimits()
    )

    @property
    def algorithms(self) -> tuple[str, ...]:
        """All algorithms; the first is the one under test."""
        return (self.algorithm, *self.compared)

    @property
    def options(self) -> Any:
        """Options of the published algorithm, for all algorithms of Marsyard."""
        return next((value for _, value in self if isinstance(value, self.task.options)), self.task.options())

    def make(self, algorithm: str, case: int) -> Any:
        """Create an algorithm for a case. Raises ValueError, and the exceptions of a user's constructor."""
        return self.task.make(algorithm, self.options, self.executable, case)

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
            raise ValueError(f"the algorithm '{self.algorithm}' is listed twice")
        return self

    @model_validator(mode="after")
    def _check_options(self) -> AlgorithmSelection:
        """Create the algorithms of Marsyard once, which checks their options."""
        for name in self.algorithms:
            if name in self.task.shipped:
                self.task.shipped[name](self.options)
        return self
