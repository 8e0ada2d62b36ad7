"""Worker processes and their watching: whatever a case does, it takes nothing but itself with it.

Each worker is a loky executor (joblib's) of one process. With one process an executor that breaks says which batch
broke it, its board says which case, and the others go on undisturbed; `jobs=1` is the same set-up with one of them. The
parent looks at every worker some twenty times a second, and ends one whose case is over a limit.
"""

from __future__ import annotations

import math
import os
import re
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

from joblib.externals.loky.process_executor import BrokenProcessPool

from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.batches import Batches
from marsyard.campaigns.execution.temporary import WorkersFolder
from marsyard.campaigns.execution.watched import LOOK_S, WatchedWorker
from marsyard.campaigns.execution.work import Work
from marsyard.campaigns.execution.worker_process import BatchEnd, Done
from marsyard.campaigns.outcomes import CRASHED, OUT_OF_MEMORY, CaseEndedError

Result = TypeVar("Result")

#: Times that a task is given to a worker before its death, or want of memory, is laid to the task: a worker may have
#: been damaged or filled by an earlier task, or killed from outside. The last time is in a fresh worker.
_ATTEMPTS = 2

#: Workers that may die one after another before they have begun a task.
_DEATHS_AT_START = 3

#: Part of the memory that is free when work begins that all workers may have together, where no limit is stated.
_SHARE_OF_MEMORY = 0.8


def available_cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


class LocalWorkers:
    """A number of worker processes, as a context: left normally they end, left by an exception they are killed.

    Parameters
    ----------
    jobs
        How many.
    sharers
        How many such groups, this one included, share the memory of the machine.
    """

    def __init__(self, jobs: int, sharers: int = 1) -> None:
        self._share_bytes = _SHARE_OF_MEMORY * free_memory() / (jobs * sharers)
        try:
            self._folder = WorkersFolder()
            self._workers = [WatchedWorker(self._folder.path / str(number)) for number in range(jobs)]
        except OSError as error:
            raise CampaignError(f"temporary files cannot be written (TMPDIR says where they go): {error}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop(kill=kind is not None)

    def stop(self, *, kill: bool) -> None:
        """Ends the processes."""
        with ThreadPoolExecutor(len(self._workers)) as pool:
            list(pool.map(lambda worker: worker.stop(kill=kill), self._workers))
        self._folder.remove()

    def run(self, work: Work[Result]) -> Iterator[list[Done[Result]]]:
        """See `Workers.run`."""
        yield from _Run(work, work.limits.memory_bytes or self._share_bytes, self._workers).results()


class _Run:
    """Work being done: what is given to whom, and what came of it."""

    def __init__(self, work: Work[Any], memory_bytes: float, workers: Sequence[WatchedWorker]) -> None:
        self._work = work
        self._batches = Batches(work.items, work.total, len(workers))
        self._memory_bytes = memory_bytes
        self._idle = deque(workers)
        self._again: deque[list[int]] = deque()
        self._attempts: dict[int, int] = {}
        self._spoilers: dict[int, int | None] = {}
        self._running: dict[Future[Any], tuple[WatchedWorker, Sequence[int]]] = {}
        self._deaths_at_start = 0

    def results(self) -> Iterator[list[Done[Any]]]:
        """See `Workers.run`."""
        while True:
            self._give()
            if not self._running:
                return
            ended, _ = wait(self._running, timeout=LOOK_S, return_when=FIRST_COMPLETED)
            done = [one for future in ended for one in self._settled(future)]
            for worker, _ in self._running.values():
                worker.look(self._work.limits, self._memory_bytes)
            if done:
                # before they are stored, so that no worker waits for that
                self._give()
                yield done

    def _give(self) -> None:
        """Gives every idle worker a batch, as long as there are any."""
        while self._idle:
            batch = self._again.popleft() if self._again else self._batches.next()
            if not batch:
                return
            self._submit(self._idle.popleft(), batch)

    def _submit(self, worker: WatchedWorker, batch: Sequence[int]) -> None:
        self._running[worker.submit(self._work.task, batch)] = (worker, batch)

    def _settled(self, future: Future[Any]) -> list[Done[Any]]:
        """What a batch that ended came to."""
        worker, batch = self._running.pop(future)
        error = future.exception()
        if isinstance(error, BrokenProcessPool):
            return self._bereaved(worker, batch, error)
        if error is None:
            self._deaths_at_start = 0
            return self._ended(worker, future.result())
        self._idle.append(worker)
        if len(batch) > 1:
            # something in it cannot be sent
            self._again.extend([item] for item in batch)
            return []
        return [Done(batch[0], None, error if isinstance(error, Exception) else RuntimeError(repr(error)))]

    def _ended(self, worker: WatchedWorker, end: BatchEnd[Any]) -> list[Done[Any]]:
        """What a batch that its worker delivered came to; a worker that is spent is replaced."""
        self._again.extend([item] for item in end.alone)
        if end.rest:
            self._again.append(list(end.rest))
        if end.done:
            self._batches.took(len(end.done), end.seconds)
        if end.spent:
            worker.replace()
        suspects = [one for one in end.done if one.crashed and one.before is not None]
        for one in suspects:
            # at most one, the last of the batch; in the process that is now fresh
            self._spoilers[one.item] = one.before
            self._submit(worker, [one.item])
        if not suspects:
            self._idle.append(worker)
        return [self._judged(one) for one in end.done if one not in suspects]

    def _judged(self, done: Done[Any]) -> Done[Any]:
        """A task as it ended; says so where it crashed in a used process, and in a fresh one does not."""
        spoiler = self._spoilers.pop(done.item, None)
        return done if done.crashed else replace(done, spoiled_by=spoiler)

    def _bereaved(self, worker: WatchedWorker, batch: Sequence[int], error: BaseException) -> list[Done[Any]]:
        """What becomes of a batch whose worker died: one task is at fault, the others are run again."""
        guilty, death = worker.death(error)
        if guilty is None or guilty not in batch:
            self._note_death_at_start(death)
            self._again.append(list(batch))
            self._idle.append(worker)
            return []
        self._deaths_at_start = 0
        place = batch.index(guilty)
        self._again.extend(list(part) for part in (batch[:place], batch[place + 1 :]) if part)
        attempt = self._attempts.pop(guilty, 1)
        if death.outcome in (CRASHED, OUT_OF_MEMORY) and attempt < _ATTEMPTS:
            self._attempts[guilty] = attempt + 1
            self._submit(worker, [guilty])
            return []
        self._idle.append(worker)
        return [Done(guilty, None, death)]

    def _note_death_at_start(self, death: CaseEndedError) -> None:
        self._deaths_at_start += 1
        if self._deaths_at_start >= _DEATHS_AT_START:
            said = f"{death}\n{death.trace}".strip()
            raise CampaignError(f"worker processes die before they begin a case; the last: {said}")


def free_memory() -> float:
    """Bytes that programs can still have without anything being swapped; endless where Linux does not tell."""
    try:
        text = Path("/proc/meminfo").read_text()
    except OSError:
        return math.inf
    found = re.search(r"^MemAvailable:\s+(\d+) kB", text, re.MULTILINE)
    return float(found[1]) * 1024.0 if found else math.inf
