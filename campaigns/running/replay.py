"""Load stored campaigns, run single cases again (replay), and check custom algorithms in worker processes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from pydantic import ValidationError

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import CampaignDefinition, key_text, validation_problems
from marsyard.campaigns.definition.identity import Identity, create_identity
from marsyard.campaigns.errors import ENGINE_FAILURES, CampaignError, DefinitionError, Problem, WorkerExitError
from marsyard.campaigns.execution.cases import run_cases
from marsyard.campaigns.execution.worker_process import Executor, Work, WorkLimits, accept_process_state
from marsyard.campaigns.execution.workers import LocalExecutor
from marsyard.campaigns.sampling.design import ADAPTIVE
from marsyard.campaigns.sampling.study_points import POINT_COLUMN, StudyPoint
from marsyard.campaigns.store import record
from marsyard.campaigns.store.origin import check_origin, check_rows
from marsyard.campaigns.store.products import ALL_PRODUCTS, REPLAYED_PRODUCTS, PackedProducts
from marsyard.campaigns.store.rows import Row
from marsyard.campaigns.store.table import stored_row
from marsyard.scenarios import conformance as suite
from marsyard.scenarios.systems import UnknownScenarioError, scenario


@dataclass(frozen=True)
class Replay:
    """A case that was run again.

    - row, stored: new row and stored row of the case (None if no row is stored)
    - differing: columns in which the two rows differ, except those with `time` in their name
    - products: products for figures; None if the scenario returned none, or none that can be stored
    - note: reason why there are no products; empty without a problem
    - changed: differences in definition, code and package versions from the stored campaign
    """

    case: int
    row: Row
    stored: Row | None
    differing: tuple[str, ...]
    products: PackedProducts | None
    note: str = ""
    changed: tuple[str, ...] = ()

    @property
    def failed(self) -> bool:
        """Whether the case did not finish in the replay, although it finished in the stored campaign."""
        was_finished = self.stored is not None and self.stored["outcome"] not in ENGINE_FAILURES
        return was_finished and self.row["outcome"] in ENGINE_FAILURES


def replay(directory: Path, case: int) -> Replay:
    """Run one case of a stored campaign again, in a worker process.

    Raises CampaignError if the folder contains no campaign, the case does not exist, or the scenario or an algorithm
    cannot be imported.
    """
    definition = record.stored_definition(directory)
    if not 0 <= case < definition.total_cases:
        raise CampaignError(f"{directory} has no case {case}; allowed: 0 to {definition.total_cases - 1}")
    load_stored_campaign(directory, definition)
    check_rows(directory)
    stored = stored_row(directory, case)
    changed = Identity.read(record.read(directory)["identity"]).differences(create_identity(definition))
    if stored is None and definition.design.kind == ADAPTIVE:
        raise CampaignError(f"{directory}: the study has not run case {case}")
    with LocalExecutor(1) as workers:
        return replay_in_executor(workers, definition, case, stored, tuple(changed))


def replay_in_executor(
    executor: Executor,
    definition: CampaignDefinition,
    case: int,
    stored: Row | None,
    changed: tuple[str, ...] = (),
    *,
    timeline: bool = True,
) -> Replay:
    """Run one case again in an executor, and compare it with its stored row, which contains the point of a study.

    timeline: whether the products contain the timeline of the case
    """
    text = None if stored is None else stored.get(POINT_COLUMN)
    points = {case: StudyPoint.read(text)} if isinstance(text, str) else {}
    selection = REPLAYED_PRODUCTS if timeline else ALL_PRODUCTS
    ((completed,),) = run_cases(executor, definition, [case], selection=selection, points=points)
    differing = differing_columns(completed.row, stored) if stored is not None else ()
    return Replay(case, completed.row, stored, differing, completed.products, completed.note, changed)


def differing_columns(row: Row, stored: Row) -> tuple[str, ...]:
    """List the columns in which two rows are not bit-identical, except times; a missing number equals NaN.

    The traceback of an unfinished case is not compared, since a process is not always terminated at the same line.
    """
    excluded_columns = {"traceback"} if row.get("outcome") in ENGINE_FAILURES else set()
    differing = []
    for name in dict.fromkeys((*row, *stored)):
        # NaN differs from itself
        values = [None if value is None or value != value else value for value in (row.get(name), stored.get(name))]
        if "time" not in name and name not in excluded_columns and values[0] != values[1]:
            differing.append(name)
    return tuple(differing)


def load_stored_campaign(directory: Path, definition: CampaignDefinition) -> Campaign:
    """Create the campaign of a stored definition; imports its scenario and algorithms.

    Raises CampaignError if the folder was created elsewhere and names code, and DefinitionError if the scenario or
    an algorithm cannot be imported, or a parameter is invalid.
    """
    check_origin(directory, definition)
    try:
        campaign = Campaign(definition, scenario(definition.scenario))
        campaign.base_parameters()
    except (UnknownScenarioError, ValidationError) as error:
        problems = [("scenario", str(error))]
        if isinstance(error, ValidationError):
            errors = validation_problems(error, campaign.scenario.parameters_type)
            problems = [(key_text(("parameters", *key)), message) for key, message in errors]
        hint = "custom modules are imported from the current folder: start the command in the campaign's first folder"
        problems.append(("", f"nothing was run or changed; {hint}"))
        raise DefinitionError([Problem(str(directory), *problem) for problem in problems]) from error
    return campaign


#: Limits of output and memory of a conformance check, bytes.
_OUTPUT_BYTES, _MEMORY_BYTES = 10e6, 4e9


def create_subject(spec: str, task: str | None, limit_s: float) -> suite.CandidateAlgorithm:
    """Create the subject of conformance checks from the name of an algorithm or of a custom part of the simulation.

    limit_s: time limit of one answer
    task: task of the algorithm; None for the task that its interface determines.
    Raises CampaignError if the name or the task is unknown.
    """
    if task is not None and task not in suite.subject_kinds():
        raise CampaignError(f"--task {task}: unknown; allowed: {', '.join(suite.subject_kinds())}")
    try:
        task_name = suite.determine_task(spec) if task is None else task
        suite.check_subject(spec, task_name)
    except ValueError as error:
        raise CampaignError(str(error)) from error
    return suite.CandidateAlgorithm(spec, task_name, limit_s)


def run_conformance_checks(subject: suite.CandidateAlgorithm) -> Iterator[suite.Finding]:
    """Run all checks in order; stop after the first check (an ordinary case) if its worker process dies."""
    # the time limit of an answer, the same time for the other work of the check, and 5 s
    limits = WorkLimits(2.0 * subject.limit_s + 5.0, _MEMORY_BYTES, _OUTPUT_BYTES)
    with LocalExecutor(1) as workers:
        for number, (name, requirement) in enumerate(suite.check_names(subject)):
            ((result,),) = workers.run(
                Work(partial(suite.run_check, subject), [number], limits, load=partial(_load_subject, subject))
            )
            finding, error = result.result, result.error
            if finding is None and isinstance(error, WorkerExitError):
                frames = [line.strip() for line in error.trace.splitlines() if line.strip().startswith("File ")][:1]
                problem = f"{error.outcome}: {error}{f' ({frames[0]})' if frames else ''}"
                advice = "it must return within the limits of time and memory for every image"
                finding = suite.Finding(name, requirement, problem, advice)
            elif finding is None:
                problem = f"{type(error).__name__}: {error}"
                advice = "this is a defect of the checks or of the types in the answer"
                finding = suite.Finding(name, requirement, problem, advice)
            elif finding.passed and result.changed:
                problem = f"it changed the state of its process: {'; '.join(result.changed)}"
                advice = "restore the state before returning, and end every thread and child process"
                finding = replace(finding, problem=problem, next_step=f"{advice}: a case must not affect later cases")
            yield finding
            if number == 0 and isinstance(error, WorkerExitError):
                return


def _load_subject(subject: suite.CandidateAlgorithm) -> None:
    """Load and compile the subject of conformance checks in a worker."""
    subject.prepare()
    accept_process_state()
