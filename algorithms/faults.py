"""Faults: reasons why an algorithm returned no usable answer, and the error that reports them.

This module imports no large packages, because each worker process imports it.
"""

from __future__ import annotations

from enum import Enum


class Fault(Enum):
    """Reason why an algorithm returned no usable answer. Expected failures are outcomes of the algorithm instead."""

    CRASHED = "it raised an exception, or its process ended without an answer"
    TIMED_OUT = "it exceeded the time limit"
    OUT_OF_MEMORY = "it exceeded the memory limit"
    TOO_MUCH_OUTPUT = "it exceeded the output limit"
    BAD_ANSWER = "its answer does not have the form that the interface defines"


def describe_error(error: BaseException | None) -> str:
    """Return the type and message of an error; the type alone if the message cannot be formatted."""
    try:
        return f"{type(error).__name__}: {error}"
    except Exception:
        return f"{type(error).__name__} (its message cannot be formatted)"


class AlgorithmError(Exception):
    """Error of an algorithm under test that returned no usable answer.

    - fault: Reason
    - stderr: End of the algorithm's standard error
    - trace: Traceback of an exception in the algorithm's own process
    """

    def __init__(self, fault: Fault, message: str, stderr: str = "", trace: str = "") -> None:
        super().__init__(message)
        self.fault = fault
        self.stderr = stderr
        self.trace = trace

    def __reduce__(self) -> tuple[type[AlgorithmError], tuple[Fault, str, str, str]]:
        return type(self), (self.fault, str(self), self.stderr, self.trace)


def bad_answer(message: str) -> AlgorithmError:
    """Return the error for an answer of the wrong form."""
    return AlgorithmError(Fault.BAD_ANSWER, message)
