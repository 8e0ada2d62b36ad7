"""Outcomes of cases that did not come to an end, or whose algorithm failed to answer
(`marsyard.algorithms.faults.Fault`).

No estimate may use these names.
"""

from __future__ import annotations

from collections.abc import Mapping

#: The case raised, or took its worker process down.
CRASHED = "CRASHED"
#: The case ran longer than its limit, in Python or in C.
TIMED_OUT = "TIMED_OUT"
#: The case asked for more memory than there is, or than its worker may have.
OUT_OF_MEMORY = "OUT_OF_MEMORY"
#: The case wrote more to its standard output and error than its limit.
TOO_MUCH_OUTPUT = "TOO_MUCH_OUTPUT"

#: The algorithm's answer was not of the form that its interface states.
BAD_ANSWER = "BAD_ANSWER"

#: All of them, in the words of the command line.
RETRYABLE: Mapping[str, str] = {
    "crashed": CRASHED,
    "timed-out": TIMED_OUT,
    "out-of-memory": OUT_OF_MEMORY,
    "too-much-output": TOO_MUCH_OUTPUT,
    "bad-answer": BAD_ANSWER,
}

#: Cases with these outcomes count as failures of requirements on all cases, and make the exit status 1.
UNFINISHED = frozenset(RETRYABLE.values())


class CaseEndedError(Exception):
    """A task that was ended, by itself or by its watcher, with the process that it ran in.

    Parameters
    ----------
    outcome
        One of this module's.
    reason
        The same words each time that the task ends so.
    trace
        Where in Python the process stood, and the last that it wrote, as far as that is known.
    note
        What the task had left by `worker_process.leave_note`.
    """

    def __init__(self, outcome: str, reason: str, trace: str, note: str = "") -> None:
        super().__init__(reason)
        self.outcome = outcome
        self.trace = trace
        self.note = note

    def __reduce__(self) -> tuple[type[CaseEndedError], tuple[str, str, str, str]]:
        return type(self), (self.outcome, str(self), self.trace, self.note)
