"""Subjects of conformance checks, algorithms and user-defined parts: the task and the suite of each, and its checks."""

import inspect
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

from marsyard.algorithms.exchange import PREFIXES, ExecutableLimits
from marsyard.scenarios.conformance import estimators, parts, trackers
from marsyard.scenarios.conformance.checks import Finding, Suite
from marsyard.scenarios.custom_algorithms import list_installed
from marsyard.scenarios.imports import import_object
from marsyard.scenarios.landing_task import LANDING
from marsyard.scenarios.offline_algorithms import is_offline
from marsyard.scenarios.parts.named import KINDS
from marsyard.scenarios.rover.task import TRACKING
from marsyard.scenarios.systems import systems
from marsyard.scenarios.tasks import Task
from marsyard.scenarios.velocity import VELOCITY


@cache
def tasks() -> Mapping[str, Task[Any, Any]]:
    """Return the tasks with a conformance suite, by name."""
    found: dict[str, Task[Any, Any]] = {task.name: task for task in (VELOCITY, TRACKING, LANDING)}
    for path in dict.fromkeys(path for system in systems() for path in system.tasks):
        with suppress(ImportError):  # the campaigns of the system report the error
            task = import_object(path)
            if task.suite:
                found.setdefault(task.name, task)
    return found


def subject_kinds() -> tuple[str, ...]:
    """Return the names, on the command line, of the tasks and kinds of parts that have a suite."""
    return (*tasks(), *KINDS)


@dataclass(frozen=True)
class Subject:
    """The algorithm or the user-defined part under test.

    - spec: name of the algorithm (`marsyard.scenarios.tasks`) or part (`marsyard.scenarios.parts`)
    - task: name of the algorithm's task, or of the part's kind
    - limit_s: maximum computation time of an answer
    """

    spec: str
    task: str
    limit_s: float

    def suite(self) -> Suite:
        """Return the conformance suite of the algorithm or part."""
        if self.task in KINDS:
            kind = KINDS[self.task]
            create = partial(parts.load_part, kind, self.spec)
            return parts.PartSuite(create, self.spec, is_program=False, limit_s=self.limit_s, kind=kind)
        task = tasks()[self.task]
        limits = ExecutableLimits(time_s=self.limit_s, isolated=False)
        is_program = self.spec.startswith(tuple(PREFIXES))
        suite = self._suite(task, partial(task.make, self.spec, task.options(), limits), is_program)
        if is_program or self.spec in task.shipped or is_offline(self.spec):
            return suite
        isolated_limits = limits.model_copy(update={"isolated": True})
        return replace(suite, make_remote=partial(task.make, self.spec, task.options(), isolated_limits))

    def _suite(self, task: Task[Any, Any], create: Callable[[], Any], is_program: bool) -> Suite:
        """Return the suite of an algorithm of a task; `create` constructs the algorithm."""
        if task.suite:
            suite: Suite = import_object(task.suite)(create, self.spec, is_program, self.limit_s)
            return suite
        if task is TRACKING:
            return trackers.TrackerSuite(create, self.spec, is_program, self.limit_s)
        arguments = create, self.spec, is_program, self.limit_s
        if task.accepts_stream(self.spec):
            return estimators.StreamSuite(*arguments, estimators.STREAM_RULES)
        rules = estimators.VELOCITY_RULES if task is VELOCITY else estimators.LANDING_RULES
        return estimators.EstimatorSuite(*arguments, rules)

    def prepare(self) -> None:
        """Check that the algorithm or part exists, import it, and create and cache the inputs of its suite."""
        check_subject(self.spec, self.task)
        suite = self.suite()
        suite.cases()
        if ":" in self.spec and suite.make_remote is not None:
            import_object(self.spec)


def check_subject(spec: str, task: str) -> None:
    """Raise ValueError with the allowed names if a task or kind has no algorithm or part of this name."""
    if task in KINDS:
        parts.load_part(KINDS[task], spec)
    else:
        tasks()[task].check(spec)


def list_checks(subject: Subject) -> list[tuple[str, str]]:
    """Return the name and the requirement of each check of a subject."""
    return [(check.name, check.requirement) for check in subject.suite().checks()]


def run_check(subject: Subject, number: int) -> Finding:
    """Run the check of a subject with this index in `list_checks`."""
    return list(subject.suite().checks())[number].evaluate()


def determine_task(spec: str) -> str:
    """Determine the task or kind of a name from entry point, methods or annotations; velocity if they are ambiguous.

    Raises ValueError if the algorithm does not exist.
    """
    shipped = next((task.name for task in tasks().values() if spec in task.shipped), None)
    if shipped is not None:
        return shipped
    if spec.startswith(tuple(PREFIXES)):
        return VELOCITY.name
    kind = None if spec in list_installed() else parts.determine_kind(spec)
    if kind is not None:
        return kind
    path = list_installed()[spec].value if spec in list_installed() else spec
    if ":" not in path:
        VELOCITY.check(spec)
    try:
        algorithm = import_object(path)
    except ImportError as error:
        raise ValueError(f"cannot import algorithm '{spec}': {error}") from error
    if hasattr(algorithm, "designate"):
        return TRACKING.name
    for task in tasks().values():
        if task.suite and task.methods and all(hasattr(algorithm, method) for method in task.methods):
            return task.name
    start = getattr(algorithm, "start", None)
    if hasattr(algorithm, "process_image") and start is not None and len(inspect.signature(start).parameters) > 1:
        # a stream that starts with inputs, in addition to `self`
        return next(task.name for task in tasks().values() if not task.methods)
    annotations = inspect.get_annotations(getattr(algorithm, "estimate", None) or algorithm)
    is_landing = any("Landing" in str(item) or "Site" in str(item) for item in annotations.values())
    return LANDING.name if is_landing else VELOCITY.name
