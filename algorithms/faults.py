"""Faults of an algorithm under test, and the error that reports one."""

from __future__ import annotations

from enum import Enum


class Fault(Enum):
    """How an algorithm failed to answer at all. None of these is an expected failure: those are in its own outcomes."""

    CRASHED = "it raised, or its process ended without an answer"
    TIMED_OUT = "it took longer than it may"
    OUT_OF_MEMORY = "it asked for more memory than it may have"
    TOO_MUCH_OUTPUT = "it wrote more than it may"
    BAD_ANSWER = "its answer is not of the form that the interface states"


def describe_error(error: BaseException | None) -> str:
    """Type and message of an error; the type alone if the message cannot be formatted."""
    try:
        return f"{type(error).__name__}: {error}"
    except Exception:
        return f"{type(error).__name__}, whose message cannot be had"


class AlgorithmError(Exception):
    """Failure of an algorithm under test to answer; `stderr` is the end of its standard error output, if known."""

    def __init__(self, fault: Fault, message: str, stderr: str = "") -> None:
        super().__init__(message)
        self.fault = fault
        self.stderr = stderr

    def __reduce__(self) -> tuple[type[AlgorithmError], tuple[Fault, str, str]]:
        return type(self), (self.fault, str(self), self.stderr)


def bad_answer(message: str) -> AlgorithmError:
    """The error for an answer of the wrong form."""
    return AlgorithmError(Fault.BAD_ANSWER, message)
