"""Outcomes of unfinished cases, and of algorithms without a valid answer (`marsyard.algorithms.faults.Fault`).

No estimate may use these names.
"""

from __future__ import annotations

from collections.abc import Mapping

#: The case raised an exception, or its worker process died.
CRASHED = "CRASHED"
#: The case exceeded its time limit.
TIMED_OUT = "TIMED_OUT"
#: The case needed more memory than available, or than its limit.
OUT_OF_MEMORY = "OUT_OF_MEMORY"
#: The case exceeded its limit of standard output and error.
TOO_MUCH_OUTPUT = "TOO_MUCH_OUTPUT"
#: The algorithm's answer violated its interface.
BAD_ANSWER = "BAD_ANSWER"
#: All of them, by the names on the command line.
_OUTCOMES = (CRASHED, TIMED_OUT, OUT_OF_MEMORY, TOO_MUCH_OUTPUT, BAD_ANSWER)
RETRYABLE: Mapping[str, str] = {outcome.lower().replace("_", "-"): outcome for outcome in _OUTCOMES}
#: Cases with these outcomes fail requirements on all cases, and cause exit status 1.
UNFINISHED = frozenset(RETRYABLE.values())


class CaseEndedError(Exception):
    """A task that ended together with its process.

    outcome: one of this module's.
    reason: the same text each time that the task ends in this way.
    trace: where the process stood in Python, and its last output, as far as known.
    note: text that the task left through `worker_process.leave_note`.
    """

    def __init__(self, outcome: str, reason: str, trace: str, note: str = "") -> None:
        super().__init__(reason)
        self.outcome = outcome
        self.trace = trace
        self.note = note

    def __reduce__(self) -> tuple[type[CaseEndedError], tuple[str, str, str, str]]:
        return type(self), (self.outcome, str(self), self.trace, self.note)
