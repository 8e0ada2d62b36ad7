"""Check custom algorithms and parts of the simulation in worker processes (`marsyard conformance`)."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.work import Work, WorkLimits
from marsyard.campaigns.execution.worker_process import accept_process_state
from marsyard.campaigns.execution.workers import LocalExecutor
from marsyard.campaigns.outcomes import WorkerExitError
from marsyard.scenarios.conformance import candidates
from marsyard.scenarios.conformance.checks import Finding

#: Limits of output and memory of a conformance check, bytes.
_OUTPUT_BYTES, _MEMORY_BYTES = 10e6, 4e9
#: Time for the other work of a check in addition to twice the time of an answer, s.
_MARGIN_S = 5.0


def create_subject(spec: str, task: str | None, limit_s: float) -> candidates.Subject:
    """Create the subject of conformance checks from the name of an algorithm or of a custom part of the simulation.

    - task: task of the algorithm; None for the task that its interface determines
    - limit_s: time limit of one answer

    Raises CampaignError if the name or the task is unknown.
    """
    if task is not None and task not in candidates.subject_kinds():
        raise CampaignError(f"--task {task}: unknown; allowed: {', '.join(candidates.subject_kinds())}")
    try:
        task_name = candidates.determine_task(spec) if task is None else task
        candidates.check_subject(spec, task_name)
    except ValueError as error:
        raise CampaignError(str(error)) from error
    return candidates.Subject(spec, task_name, limit_s)


def run_conformance_checks(subject: candidates.Subject) -> Iterator[Finding]:
    """Run all checks in order; stop after the first check (an ordinary case) if its worker process dies."""
    limits = WorkLimits(2.0 * subject.limit_s + _MARGIN_S, _MEMORY_BYTES, _OUTPUT_BYTES)
    with LocalExecutor(1) as workers:
        for number, (name, requirement) in enumerate(candidates.list_checks(subject)):
            # one batch with one result
            ((result,),) = workers.run(
                Work(partial(candidates.run_check, subject), [number], limits, load=partial(_load_subject, subject))
            )
            finding, error = result.result, result.error
            if finding is None and isinstance(error, WorkerExitError):
                frames = [line.strip() for line in error.trace.splitlines() if line.strip().startswith("File ")][:1]
                problem = f"{error.outcome}: {error}{f' ({frames[0]})' if frames else ''}"
                advice = "it must return within the limits of time and memory for every image"
                finding = Finding(name, requirement, problem, advice)
            elif finding is None:
                problem = f"{type(error).__name__}: {error}"
                advice = "this is a defect of the checks or of the types in the answer"
                finding = Finding(name, requirement, problem, advice)
            elif finding.passed and result.changed:
                problem = f"it changed the state of its process: {'; '.join(result.changed)}"
                advice = "restore the state before returning, and end every thread and child process"
                finding = replace(finding, problem=problem, next_step=f"{advice}: a case must not affect later cases")
            yield finding
            if number == 0 and isinstance(error, WorkerExitError):
                return


def _load_subject(subject: candidates.Subject) -> None:
    """Load and compile the subject of conformance checks in a worker."""
    subject.prepare()
    accept_process_state()
