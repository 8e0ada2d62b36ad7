"""Puts an algorithm or a part to its suite, each check in a worker process: what ends the worker ends one check."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.work import Work, WorkLimits
from marsyard.campaigns.execution.worker_process import LOADING_S, Done, settle, start_clock
from marsyard.campaigns.execution.workers import LocalWorkers
from marsyard.campaigns.outcomes import CaseEndedError
from marsyard.scenarios.conformance import EXAMINED, Finding, Subject, check_names, check_subject, run_check, task_of

#: Output that a check may write, and memory that it may have.
_OUTPUT_BYTES, _MEMORY_BYTES = 10e6, 4e9


def subject_of(spec: str, task: str | None, limit_s: float) -> Subject:
    """The algorithm or part of a name, for the task or of the kind that is stated or that it tells by itself.

    Raises
    ------
    CampaignError
        Where there is nothing of this name, or no such task.
    """
    if task is not None and task not in EXAMINED:
        raise CampaignError(f"--task {task}: unknown; allowed: {', '.join(EXAMINED)}")
    try:
        chosen = task_of(spec) if task is None else task
        check_subject(spec, chosen)
    except ValueError as error:
        raise CampaignError(str(error)) from error
    return Subject(spec, chosen, limit_s)


def examine(subject: Subject) -> Iterator[Finding]:
    """What came of each check, in their order.

    Where the first, the ordinary case, does not come to an end, the others are not tried.
    """
    names = check_names(subject)
    limits = WorkLimits(_limit_s(subject), _MEMORY_BYTES, _OUTPUT_BYTES)
    with LocalWorkers(1) as workers:
        for number, (name, asked) in enumerate(names):
            work = Work(partial(_check, subject), [number], limits)
            ((done,),) = workers.run(work)
            yield _finding(done, name, asked)
            if number == 0 and isinstance(done.error, CaseEndedError):
                return


def _limit_s(subject: Subject) -> float:
    """Time of a check: the time of an answer, and as much again for what is around it."""
    return 2.0 * subject.limit_s + 5.0


def _check(subject: Subject, number: int) -> Finding:
    """One check, in a worker; its clock starts once everything is loaded, and again with every question."""
    start_clock(grace_s=LOADING_S)
    subject.prepare()
    settle()
    start_clock()
    return run_check(subject, number)


def _finding(done: Done[Finding], name: str, asked: str) -> Finding:
    if done.result is not None:
        return _with_state(done.result, done.changed)
    error = done.error
    if isinstance(error, CaseEndedError):
        where = [line.strip() for line in error.trace.splitlines() if line.strip().startswith("File ")][:1]
        problem = f"{error.outcome}: {error}{f' ({where[0]})' if where else ''}"
        return Finding(name, asked, problem, "no picture may make it hang, end its process or take all memory")
    return Finding(
        name, asked, f"{type(error).__name__}: {error}", "this is a defect of the suite or of the answer's types"
    )


def _with_state(finding: Finding, changed: tuple[str, ...]) -> Finding:
    """A finding, failed where the check passed but changed what later cases of the same process would meet."""
    if not changed or not finding.passed:
        return finding
    return replace(
        finding,
        problem=f"it changed the state of its process: {'; '.join(changed)}",
        next_step="set it back before returning, and end every thread and child process: a case must leave no trace",
    )
