"""Conformance suite of an algorithm or part, each check in a worker process of its own."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.worker_process import LOADING_S, Work, WorkLimits, accept_process_state, start_clock
from marsyard.campaigns.execution.workers import LocalExecutor
from marsyard.campaigns.outcomes import CaseEndedError
from marsyard.scenarios import conformance as suite

#: Limits of output and memory of a check.
_OUTPUT_BYTES, _MEMORY_BYTES = 10e6, 4e9


def subject_of(spec: str, task: str | None, limit_s: float) -> suite.Subject:
    """Algorithm or part of a name, for a stated task, or the task that it states itself.

    Raises CampaignError where the name or the task is unknown.
    """
    if task is not None and task not in suite.SUBJECT_KINDS:
        raise CampaignError(f"--task {task}: unknown; allowed: {', '.join(suite.SUBJECT_KINDS)}")
    try:
        chosen = suite.determine_task(spec) if task is None else task
        suite.check_subject(spec, chosen)
    except ValueError as error:
        raise CampaignError(str(error)) from error
    return suite.Subject(spec, chosen, limit_s)


def examine(subject: suite.Subject) -> Iterator[suite.Finding]:
    """Run all checks in order; only the first, the ordinary case, if its worker process ends."""
    # the time limit of an answer, and as much again for the rest of the check
    limits = WorkLimits(2.0 * subject.limit_s + 5.0, _MEMORY_BYTES, _OUTPUT_BYTES)
    with LocalExecutor(1) as workers:
        for number, (name, asked) in enumerate(suite.check_names(subject)):
            ((done,),) = workers.run(Work(partial(_run_check, subject), [number], limits))
            finding, error = done.result, done.error
            if finding is None and isinstance(error, CaseEndedError):
                where = [line.strip() for line in error.trace.splitlines() if line.strip().startswith("File ")][:1]
                problem = f"{error.outcome}: {error}{f' ({where[0]})' if where else ''}"
                advice = "no picture may make it hang, end its process or take all memory"
                finding = suite.Finding(name, asked, problem, advice)
            elif finding is None:
                problem = f"{type(error).__name__}: {error}"
                finding = suite.Finding(name, asked, problem, "this is a defect of the suite or of the answer's types")
            elif finding.passed and done.changed:
                problem = f"it changed the state of its process: {'; '.join(done.changed)}"
                advice = "set it back before returning, and end every thread and child process"
                finding = replace(finding, problem=problem, next_step=f"{advice}: a case must leave no trace")
            yield finding
            if number == 0 and isinstance(error, CaseEndedError):
                return


def _run_check(subject: suite.Subject, number: int) -> suite.Finding:
    """Run one check in a worker; its clock starts once everything is loaded, and again with every question."""
    start_clock(grace_s=LOADING_S)
    subject.prepare()
    accept_process_state()
    start_clock()
    return suite.run_check(subject, number)
