"""What workers are asked to do, whoever they are."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from marsyard.campaigns.execution.worker_process import Done

Result = TypeVar("Result")


@dataclass(frozen=True)
class WorkLimits:
    """What one task may use.

    Attributes
    ----------
    time_s
        Wall-clock time.
    memory_bytes
        Memory that is its worker's alone, with what it started: neither mapped files nor shared libraries; None for
        an equal share of 80 % of what is free when work begins.
    output_bytes
        Written to standard output and standard error.
    """

    time_s: float = math.inf
    memory_bytes: float | None = None
    output_bytes: float = math.inf


#: Nothing is forbidden but to take all memory.
UNLIMITED = WorkLimits()


@dataclass(frozen=True)
class Work(Generic[Result]):
    """A task to be run on many items.

    Attributes
    ----------
    task
        A pure function of the item, which can be sent to other processes.
    items
        Taken as workers come to them, and no sooner.
    limits
        What the task may use for one item.
    total
        How many items there are, as far as known.
    """

    task: Callable[[int], Result]
    items: Iterable[int]
    limits: WorkLimits = UNLIMITED
    total: int | None = None


class Workers(Protocol):
    """Processes that run tasks, wherever they are."""

    def run(self, work: Work[Result]) -> Iterator[list[Done[Result]]]:
        """Runs the task on every item, and yields what ended since the last time, in no particular order.

        An error is what the task raised, or a `CaseEndedError`.
        """
        ...
