"""Run the algorithms of a case separately: a failure or changed inputs of one algorithm do not affect the others."""

import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from marsyard.algorithms.exchange import ProgramDetails, answer_time_s
from marsyard.algorithms.faults import AlgorithmError, Fault, describe_error
from marsyard.scenarios.input_copies import InputCopy, Inputs
from marsyard.scenarios.interface import Failure, Scalar
from marsyard.scenarios.isolation.remote import algorithm_time_s, is_remote

Algorithm = TypeVar("Algorithm")
Answer = TypeVar("Answer")
#: Column of the standard error of an external program.
STDERR = "stderr"


@dataclass(frozen=True)
class AlgorithmRun(Generic[Answer]):
    """The answer or failure of an algorithm.

    - answer: valid answer; None for a failure
    - failure: None for an answer
    - row: columns: computation time (processor time; wall-clock time of an external program), with copying of the
      measurements, and with construction if that is in this process; NaN after a failure; standard error
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


def run_algorithm(call: Callable[[], object], check: Callable[[object], Answer]) -> AlgorithmRun[Answer]:
    """Run an algorithm and validate its answer; all exceptions become failures of the algorithm."""
    start_s = algorithm_time_s()
    try:
        raw_answer = call()
        elapsed_s = algorithm_time_s() - start_s
        answer = check(raw_answer)
    except Exception as error:
        row: dict[str, Scalar] = {"estimation_time_s": float("nan")}  # the computation was not finished
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
