"""Isolated worker processes: a crash, hang or memory overrun of one case cannot affect another.

Each worker is a loky executor (joblib's) of one process, also for `jobs=1`. If it breaks, its batch is known from the
executor and the case from the worker's status board, and the other workers continue. The parent checks every worker
about twenty times a second, and ends one whose case exceeds a limit.
"""

from __future__ import annotations

import fcntl
import math
import os
import re
import shutil
import tempfile
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

from joblib.externals.loky.process_executor import BrokenProcessPool

from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.watched import POLL_INTERVAL_S, WatchedWorker
from marsyard.campaigns.execution.work import Batches, Executor, Work
from marsyard.campaigns.execution.worker_process import BatchResult, TaskResult
from marsyard.campaigns.outcomes import CRASHED, OUT_OF_MEMORY, CaseEndedError

Result = TypeVar("Result")

#: Attempts before a crash or lack of memory is attributed to the task, the last in a fresh worker: an earlier task may
#: have damaged or filled the worker, or it was killed from outside.
_MAX_ATTEMPTS = 2

#: Maximum number of consecutive deaths of workers before they begin a task.
_MAX_START_DEATHS = 3

#: Fraction of the free memory at the start that all workers share, where no limit is stated.
_MEMORY_FRACTION = 0.8


def available_cores() -> int:
    """Number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


class LocalExecutor:
    """Worker processes on this machine, as a context: they end at its exit, and are killed at an exit by an exception.

    jobs: number of workers.
    sharers: number of such executors, this one included, that share the memory of the machine.
    """

    def __init__(self, jobs: int, sharers: int = 1) -> None:
        self._default_memory_bytes = _MEMORY_FRACTION * free_memory() / (jobs * sharers)
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
        """End the processes."""
        with ThreadPoolExecutor(len(self._workers)) as pool:
            list(pool.map(lambda worker: worker.stop(kill=kill), self._workers))
        self._folder.remove()

    def run(self, work: Work[Result]) -> Iterator[list[TaskResult[Result]]]:
        """See `Executor.run`."""
        yield from _Run(work, work.limits.memory_bytes or self._default_memory_bytes, self._workers).results()


class _Run:
    """Progress of one piece of work: batches at workers, retries, and results."""

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

    def results(self) -> Iterator[list[TaskResult[Any]]]:
        """See `Executor.run`."""
        while True:
            self._submit_batches()
            if not self._running:
                return
            ended, _ = wait(self._running, timeout=POLL_INTERVAL_S, return_when=FIRST_COMPLETED)
            done = [one for future in ended for one in self._collect(future)]
            for worker, _ in self._running.values():
                worker.enforce_limits(self._work.limits, self._memory_bytes)
            if done:
                # before the caller stores the results, so that no worker waits
                self._submit_batches()
                yield done

    def _submit_batches(self) -> None:
        """Submit a batch to every idle worker, while there are any."""
        while self._idle:
            batch = self._again.popleft() if self._again else self._batches.next()
            if not batch:
                return
            self._submit(self._idle.popleft(), batch)

    def _submit(self, worker: WatchedWorker, batch: Sequence[int]) -> None:
        self._running[worker.submit(self._work.task, batch)] = (worker, batch)

    def _collect(self, future: Future[Any]) -> list[TaskResult[Any]]:
        """Results of a batch that ended."""
        worker, batch = self._running.pop(future)
        error = future.exception()
        if isinstance(error, BrokenProcessPool):
            return self._handle_worker_crash(worker, batch, error)
        if error is None:
            self._deaths_at_start = 0
            return self._handle_batch_result(worker, future.result())
        self._idle.append(worker)
        if len(batch) > 1:
            # one of its results cannot be pickled
            self._again.extend([item] for item in batch)
            return []
        return [TaskResult(batch[0], None, error if isinstance(error, Exception) else RuntimeError(repr(error)))]

    def _handle_batch_result(self, worker: WatchedWorker, end: BatchResult[Any]) -> list[TaskResult[Any]]:
        """Results of a delivered batch; a spent worker is replaced."""
        self._again.extend([item] for item in end.alone)
        if end.rest:
            self._again.append(list(end.rest))
        if end.done:
            self._batches.record_time(len(end.done), end.seconds)
        if end.spent:
            worker.replace()
        suspects = [one for one in end.done if one.crashed and one.before is not None]
        for one in suspects:
            # at most one, the last of the batch; it runs again in the fresh process
            self._spoilers[one.item] = one.before
            self._submit(worker, [one.item])
        if not suspects:
            self._idle.append(worker)
        return [self._with_spoiler(one) for one in end.done if one not in suspects]

    def _with_spoiler(self, done: TaskResult[Any]) -> TaskResult[Any]:
        """Result with the earlier item that made it crash, where it does not crash in a fresh process."""
        spoiler = self._spoilers.pop(done.item, None)
        return done if done.crashed else replace(done, spoiled_by=spoiler)

    def _handle_worker_crash(
        self, worker: WatchedWorker, batch: Sequence[int], error: BaseException
    ) -> list[TaskResult[Any]]:
        """Find the task that ended the worker; run the others of its batch again."""
        item, death = worker.handle_death(error)
        if item is None or item not in batch:
            self._note_death_at_start(death)
            self._again.append(list(batch))
            self._idle.append(worker)
            return []
        self._deaths_at_start = 0
        index = batch.index(item)
        self._again.extend(list(part) for part in (batch[:index], batch[index + 1 :]) if part)
        attempt = self._attempts.pop(item, 1)
        if death.outcome in (CRASHED, OUT_OF_MEMORY) and attempt < _MAX_ATTEMPTS:
            self._attempts[item] = attempt + 1
            self._submit(worker, [item])
            return []
        self._idle.append(worker)
        return [TaskResult(item, None, death)]

    def _note_death_at_start(self, death: CaseEndedError) -> None:
        self._deaths_at_start += 1
        if self._deaths_at_start >= _MAX_START_DEATHS:
            reason = f"{death}\n{death.trace}".strip()
            raise CampaignError(f"worker processes die before they begin a case; the last: {reason}")


def free_memory() -> float:
    """Available memory in bytes; infinite where Linux does not state it."""
    try:
        text = Path("/proc/meminfo").read_text()
    except OSError:
        return math.inf
    found = re.search(r"^MemAvailable:\s+(\d+) kB", text, re.MULTILINE)
    return float(found[1]) * 1024.0 if found else math.inf


_PREFIX = "marsyard-"

#: Locked by the owner of a folder while it lives.
_LOCK = "lock"


class WorkersFolder:
    """A new temporary folder of a group of workers; abandoned ones of killed owners are removed."""

    def __init__(self) -> None:
        _remove_abandoned(Path(tempfile.gettempdir()))
        self.path = Path(tempfile.mkdtemp(prefix=_PREFIX))
        # renamed only once it is locked
        partial = self.path / "lock.partial"
        self._lock = os.open(partial, os.O_RDWR | os.O_CREAT, 0o600)
        fcntl.flock(self._lock, fcntl.LOCK_EX)
        partial.rename(self.path / _LOCK)

    def remove(self) -> None:
        """Remove the folder with its contents."""
        os.close(self._lock)
        shutil.rmtree(self.path, ignore_errors=True)


def _remove_abandoned(parent: Path) -> None:
    for lock in parent.glob(f"{_PREFIX}*/{_LOCK}"):
        with suppress(OSError):
            held = os.open(lock, os.O_RDWR)
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(lock.parent, ignore_errors=True)
            finally:
                os.close(held)


@dataclass(frozen=True)
class ExecutorConfig:
    """Choice of an executor: `jobs` worker processes on this machine, or a cluster where one is named.

    `cluster` is the address of a Dask scheduler (`tcp://host:8786`), or `local:N` for a new cluster of N workers here.
    """

    jobs: int = 1
    cluster: str | None = None

    def describe(self) -> str:
        """Text for the record."""
        return f"{self.jobs} on this machine" if self.cluster is None else f"cluster {self.cluster}"


@contextmanager
def create_executor(config: ExecutorConfig) -> Iterator[Executor]:
    """Start an executor; its workers are killed at an exit by an exception, and end otherwise.

    Raises CampaignError where the cluster cannot be reached, or Dask is not installed.
    """
    if config.cluster is None:
        with LocalExecutor(config.jobs) as local:
            yield local
        return
    from marsyard.campaigns.execution.cluster import ClusterExecutor

    with ClusterExecutor(config.cluster) as cluster:
        yield cluster
