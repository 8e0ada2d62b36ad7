"""Stored campaigns loaded again, single cases compared with their stored rows, and checks of an algorithm."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from pydantic import ValidationError

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.configuration import CampaignConfiguration, key_text, validation_problems
from marsyard.campaigns.definition.identity import Identity, create_identity
from marsyard.campaigns.errors import UNFINISHED, CampaignError, CaseEndedError, ConfigurationError, Problem
from marsyard.campaigns.execution.cases import run_cases
from marsyard.campaigns.execution.worker_process import (
    LOADING_S,
    Executor,
    Work,
    WorkLimits,
    accept_process_state,
    start_clock,
)
from marsyard.campaigns.execution.workers import LocalExecutor
from marsyard.campaigns.store.products import KEEP_ALL, PackedProducts
from marsyard.campaigns.store.record import read, stored_configuration
from marsyard.campaigns.store.rows import Row
from marsyard.campaigns.store.table import stored_row
from marsyard.scenarios import conformance as suite
from marsyard.scenarios.systems import UnknownScenarioError, scenario


@dataclass(frozen=True)
class Replay:
    """A case that was run again.

    row, stored: its row now, and as stored (None if it has none yet).
    differing: columns in which the two differ, except those with `time` in their name.
    products: products for figures; None where the scenario returned none, or none that can be stored.
    note: why there are none; empty where nothing is wrong.
    changed: differences in configuration, code and package versions from the stored campaign.
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
        """Whether the case is unfinished now, although its stored row is finished."""
        stored = self.stored
        return self.row["outcome"] in UNFINISHED and stored is not None and stored["outcome"] not in UNFINISHED


def replay(directory: Path, case: int) -> Replay:
    """Run one case of a stored campaign again, in a worker process.

    Raises CampaignError where the folder holds no campaign, the case does not exist, or the scenario or an algorithm
    cannot be imported; no case is run then.
    """
    configuration = stored_configuration(directory)
    if not 0 <= case < configuration.total_cases:
        raise CampaignError(f"{directory} has no case {case}; allowed: 0 to {configuration.total_cases - 1}")
    load_stored_campaign(directory, configuration)
    stored = stored_row(directory, case)
    identity = read(directory).get("identity")
    changed = Identity.read(identity).differences(create_identity(configuration)) if identity else []
    with LocalExecutor(1) as workers:
        return replay_with(workers, configuration, case, stored, tuple(changed))


def replay_with(
    executor: Executor,
    configuration: CampaignConfiguration,
    case: int,
    stored: Row | None,
    changed: tuple[str, ...] = (),
) -> Replay:
    """Run one case again in given workers, and compare it with a row."""
    ((completed,),) = run_cases(executor, configuration, [case], keep=KEEP_ALL)
    differing = differing_columns(completed.row, stored) if stored is not None else ()
    return Replay(case, completed.row, stored, differing, completed.products, completed.note, changed)


def differing_columns(row: Row, other: Row) -> tuple[str, ...]:
    """Columns in which two rows differ bit for bit, except times; a missing number equals NaN.

    The traceback of an unfinished case is not compared: a process is not ended at the same instruction twice.
    """
    excluded = {"traceback"} if row.get("outcome") in UNFINISHED else set()
    differing = []
    for name in dict.fromkeys((*row, *other)):
        # NaN differs from itself
        values = [None if one is None or one != one else one for one in (row.get(name), other.get(name))]
        if "time" not in name and name not in excluded and values[0] != values[1]:
            differing.append(name)
    return tuple(differing)


def load_stored_campaign(directory: Path, configuration: CampaignConfiguration) -> Campaign:
    """Campaign of a stored configuration, with its scenario and algorithms imported.

    Raises ConfigurationError where the scenario or an algorithm cannot be imported, or a parameter is not accepted.
    """
    try:
        campaign = Campaign(configuration, scenario(configuration.scenario))
        campaign.base_parameters()
    except (UnknownScenarioError, ValidationError) as error:
        problems = [("scenario", str(error))]
        if isinstance(error, ValidationError):
            errors = validation_problems(error, campaign.scenario.parameters_type)
            problems = [(key_text(("parameters", *key)), message) for key, message in errors]
        hint = "modules of your own are searched for in the current folder"
        problems.append(("", f"nothing was run or changed; {hint}: start the command where the campaign was run"))
        raise ConfigurationError([Problem(str(directory), *problem) for problem in problems]) from error
    return campaign


#: Limits of output and memory of a check.
_OUTPUT_BYTES, _MEMORY_BYTES = 10e6, 4e9


def create_subject(spec: str, task: str | None, limit_s: float) -> suite.Subject:
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
