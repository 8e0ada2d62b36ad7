"""What an algorithm under test must not do, and what is said of it when it does."""

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
    """Type and message of an error; the type alone where its message cannot be had."""
    try:
        return f"{type(error).__name__}: {error}"
    except Exception:
        return f"{type(error).__name__}, whose message cannot be had"


class AlgorithmError(Exception):
    """An algorithm under test that failed to answer.

    Parameters
    ----------
    fault
        In which way.
    message
        What is wrong, in the same words each time.
    stderr
        The last that it wrote to its standard error; empty where that is not known.
    """

    def __init__(self, fault: Fault, message: str, stderr: str = "") -> None:
        super().__init__(message)
        self.fault = fault
        self.stderr = stderr

    def __reduce__(self) -> tuple[type[AlgorithmError], tuple[Fault, str, str]]:
        return type(self), (self.fault, str(self), self.stderr)
