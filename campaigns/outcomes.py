"""Outcomes of unfinished cases, which the engine assigns."""

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
_OUTCOMES = (CRASHED, TIMED_OUT, OUT_OF_MEMORY, TOO_MUCH_OUTPUT, BAD_ANSWER)
#: Outcomes by their command-line names (`--retry timed-out`).
RETRYABLE: Mapping[str, str] = {outcome.lower().replace("_", "-"): outcome for outcome in _OUTCOMES}
#: Cases with these outcomes fail the requirements on all cases, and result in exit status 1.
ENGINE_FAILURES = frozenset(RETRYABLE.values())


class WorkerExitError(Exception):
    """The worker process ended before its task finished.

    - outcome: one of this module's outcomes; reason: text that is equal for equal causes
    - trace: Python stack of the process and its last output, as far as available
    """

    def __init__(self, outcome: str, reason: str, trace: str) -> None:
        super().__init__(reason)
        self.outcome = outcome
        self.trace = trace

    def __reduce__(self) -> tuple[type[WorkerExitError], tuple[str, str, str]]:
        return type(self), (self.outcome, str(self), self.trace)
