"""The suite of each task, check by check."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from marsyard.algorithms.exchange import PREFIXES, ExecutableLimits
from marsyard.scenarios.conformance import estimators, inputs, parts, surfaces, trackers
from marsyard.scenarios.conformance.checks import Check, Finding
from marsyard.scenarios.dotted import found_at
from marsyard.scenarios.estimators import LANDING, TASKS, TRACKING, VELOCITY, Task, installed
from marsyard.scenarios.parts.named import KINDS

_INPUTS: Mapping[str, Sequence[Callable[[], object]]] = {
    "velocity": [inputs.descent, estimators.STREAM.measurements],
    "landing": [inputs.landing],
    "tracking": [trackers.mast, surfaces.texture],
}


@dataclass(frozen=True)
class Subject:
    """An algorithm, or a part of a user's own, to be examined.

    Attributes
    ----------
    spec
        How it is named; see `marsyard.scenarios.estimators`, `marsyard.scenarios.parts`.
    task
        The name of its task, or of its kind.
    limit_s
        Longest time that an answer may take.
    """

    spec: str
    task: str
    limit_s: float

    def checks(self) -> Iterator[Check]:
        """The task's suite for it."""
        if self.task in KINDS:
            return parts.PartSuite.of(KINDS[self.task], self.spec, self.limit_s).checks()
        task: Task[Any, Any] = TASKS[self.task]
        limits = ExecutableLimits(time_s=self.limit_s)
        program = self.spec.startswith(tuple(PREFIXES))

        def make() -> Any:
            return task.make(self.spec, task.options(), limits)

        if task is TRACKING:
            return trackers.TrackerSuite(make, self.spec, program, self.limit_s).checks()
        protocol = estimators.VELOCITY if task is VELOCITY else estimators.LANDING
        if task.takes_stream(self.spec):
            protocol = estimators.STREAM
        return estimators.EstimatorSuite(make, self.spec, program, self.limit_s, protocol).checks()

    def prepare(self) -> None:
        """Loads and compiles what the suite itself needs, and the algorithm's code."""
        check_subject(self.spec, self.task)
        if self.task in KINDS:
            parts.PartSuite.of(KINDS[self.task], self.spec, self.limit_s).cases()
            return
        task: Task[Any, Any] = TASKS[self.task]
        for one in _INPUTS[task.name]:
            one()


#: What can be examined, by the words of the command line.
EXAMINED = (*TASKS, *KINDS)


def check_subject(spec: str, task: str) -> None:
    """Raises ValueError where there is nothing of this name for a task, or of a kind; it says what is allowed."""
    if task in KINDS:
        parts.check_part(KINDS[task], spec)
    else:
        TASKS[task].check(spec)


def check_names(subject: Subject) -> list[tuple[str, str]]:
    """The checks that a subject is put to: their names, and what they ask for."""
    return [(check.name, check.asked) for check in subject.checks()]


def run_check(subject: Subject, number: int) -> Finding:
    """Does one check."""
    return list(subject.checks())[number].finding()


def task_of(spec: str) -> str:
    """What a name is for, or of: as far as it, its methods or their annotations tell; else velocity.

    Raises
    ------
    ValueError
        Where there is no such algorithm.
    """
    shipped = next((task.name for task in TASKS.values() if spec in task.shipped), None)
    if shipped is not None:
        return shipped
    if spec.startswith(tuple(PREFIXES)):
        return VELOCITY.name
    kind = None if spec in installed() else parts.kind_of(spec)
    if kind is not None:
        return kind
    path = installed()[spec].value if spec in installed() else spec
    if ":" not in path:
        VELOCITY.check(spec)
    try:
        found = found_at(path)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"no algorithm at '{spec}': {error}") from error
    if hasattr(found, "designate"):
        return TRACKING.name
    annotations = inspect.get_annotations(getattr(found, "estimate", None) or found)
    landing = any("Landing" in str(one) or "Site" in str(one) for one in annotations.values())
    return LANDING.name if landing else VELOCITY.name
