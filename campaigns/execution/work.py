"""Tasks of the worker processes, their results, and the executor that runs them.

A task is a function of an integer, its item: the number of a case, of a shared input or of a check.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

Result = TypeVar("Result")


@dataclass(frozen=True)
class TaskResult(Generic[Result]):
    """Result of a task for one item, or the error that prevented the result.

    - changed: names of the parts of the process state that the task changed
    - crashed: whether the task requested a fresh worker (`request_fresh_worker`)
    - previous_item: item that ran before in the same process and may have caused the crash; None without such a crash
    - crashed_only_after: predecessor item needed to reproduce the crash; the item does not crash in a fresh process
    - attempts: number of attempts to run the item; only the result of the last one is known
    """

    item: int
    result: Result | None
    error: Exception | None
    changed: tuple[str, ...] = ()
    crashed: bool = False
    previous_item: int | None = None
    crashed_only_after: int | None = None
    attempts: int = 1


@dataclass(frozen=True)
class WorkLimits:
    """Limits of one task.

    - time_s: wall-clock time
    - memory_bytes: private memory of the worker and its descendants, without mapped files and shared libraries; None
      for an equal fraction of 80 % of the free memory at the start of the work
    - output_bytes: bytes on standard output and standard error
    """

    time_s: float = math.inf
    memory_bytes: float | None = None
    output_bytes: float = math.inf


@dataclass(frozen=True)
class Work(Generic[Result]):
    """A task to be run on many items.

    - task: a pure, picklable function of the item; limits: limits of the task for one item
    - items: iterator that is advanced only when workers need items; total: number of items, if known
    - load: loads the code of the task once in each worker, without time limits of items; its errors are ignored
    """

    task: Callable[[int], Result]
    items: Iterable[int]
    limits: WorkLimits = WorkLimits()
    total: int | None = None
    load: Callable[[], object] | None = None


class Executor(Protocol):
    """Processes that run tasks, on this machine or on a cluster."""

    def run(self, work: Work[Result]) -> Iterator[list[TaskResult[Result]]]:
        """Run the task on each item, and yield results as they arrive, in any order.

        An error is the exception that the task raised, or a `WorkerExitError`.
        """
