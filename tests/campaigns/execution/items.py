"""Run the items of a task in worker processes; in campaigns the items are the case numbers."""

import os
import time
from collections.abc import Callable, Iterable
from itertools import chain
from pathlib import Path
from typing import Any

from marsyard.campaigns.execution.work import TaskResult, Work, WorkLimits
from marsyard.campaigns.execution.workers import LocalExecutor
from marsyard.campaigns.outcomes import WorkerExitError

#: Maximum duration of runs that could wait forever, in seconds.
MAX_DURATION_S = 60.0


def run_items(
    task: Callable[[int], Any],
    items: Iterable[int],
    limits: WorkLimits | None = None,
    load: Callable[[], object] | None = None,
    *,
    total: int | None = None,
    jobs: int = 1,
) -> dict[int, TaskResult[Any]]:
    """Run items; return their results after the workers have ended."""
    with LocalExecutor(jobs) as workers:
        batches = workers.run(Work(task, items, limits or WorkLimits(), total, load))
        return {result.item: result for result in chain.from_iterable(batches)}


def list_results(results: dict[int, TaskResult[Any]]) -> dict[int, Any]:
    """Return the results of the items without an error."""
    return {item: result.result for item, result in results.items() if result.error is None}


def read_exit(result: TaskResult[Any]) -> WorkerExitError:
    """Return the error of an item whose worker was ended."""
    assert isinstance(result.error, WorkerExitError), result.error
    return result.error


def get_process_id(_: int) -> int:
    time.sleep(0.1)
    return os.getpid()


def sleep_and_return(seconds: float, item: int) -> int:
    time.sleep(seconds)
    return item


def has_ended(process: int) -> bool:
    """Return whether no process has this id, or the process is a zombie (state Z)."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except OSError:
        return True
