"""Work that an executor is given: a task, its items and limits; and the division of items into batches."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from marsyard.campaigns.execution.worker_process import TaskResult

Result = TypeVar("Result")


@dataclass(frozen=True)
class WorkLimits:
    """Limits of one task.

    time_s: wall-clock time.
    memory_bytes: private memory of its worker and of the processes that it started, without mapped files and shared
    libraries; None for an equal fraction of 80 % of the free memory when work begins.
    output_bytes: bytes on standard output and standard error.
    """

    time_s: float = math.inf
    memory_bytes: float | None = None
    output_bytes: float = math.inf


@dataclass(frozen=True)
class Work(Generic[Result]):
    """A task to be run on many items.

    task: a pure function of the item that can be pickled.
    items: taken only as workers need them.
    limits: limits of the task for one item.
    total: number of items, as far as known.
    """

    task: Callable[[int], Result]
    items: Iterable[int]
    limits: WorkLimits = WorkLimits()
    total: int | None = None


class Executor(Protocol):
    """Processes that run tasks, on this machine or on a cluster."""

    def run(self, work: Work[Result]) -> Iterator[list[TaskResult[Result]]]:
        """Run the task on every item, and yield results as they arrive, in no particular order.

        An error is the exception that the task raised, or a `CaseEndedError`.
        """
        ...


#: Target duration of a batch: sending one costs 3 ms, and a worker that dies loses at most one.
_BATCH_S = 1.0
#: Maximum number of items in a batch.
MAX_BATCH = 1000
#: Weight of the latest batch in the running mean of the time per item.
_WEIGHT = 0.3


class Batches:
    """Batches of items, sized by the measured time per item.

    items: taken only as batches are requested.
    total: number of items, as far as known: the last batches are then small, so that all workers end together.
    workers: number of workers that share the items.
    """

    def __init__(self, items: Iterable[int], total: int | None, workers: int) -> None:
        self._source = iter(items)
        self._left = total
        self._workers = workers
        self._size = 1
        self._item_s = math.nan

    def next(self) -> list[int]:
        """Next batch; empty where no items are left."""
        size = self._size
        if self._left is not None:
            size = max(1, min(size, self._left // (2 * self._workers)))
        batch = list(itertools.islice(self._source, size))
        if self._left is not None:
            self._left -= len(batch)
        return batch

    def record_time(self, items: int, seconds: float) -> None:
        """Update the time per item from a finished batch; a batch is at most twice as large as the one before."""
        latest, mean = seconds / items, self._item_s
        self._item_s = latest if math.isnan(mean) else mean + _WEIGHT * (latest - mean)
        wanted = MAX_BATCH if self._item_s <= 0.0 else int(_BATCH_S / self._item_s)
        self._size = max(1, min(wanted, 2 * self._size, MAX_BATCH))
