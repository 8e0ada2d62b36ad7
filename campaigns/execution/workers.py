"""Isolated worker processes on this machine: a crash, hang or memory overrun of one case cannot affect another.

Each worker is a loky executor (of joblib) with one process, which runs batches of cases. If a worker dies, its executor
identifies the batch, and its status board (shared memory) identifies the case. The parent checks each worker about
twenty times per second, and terminates a worker whose case exceeds a limit
(`marsyard.campaigns.execution.monitoring`).
"""

import fcntl
import math
import os
import re
import shutil
import tempfile
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from joblib.externals.loky.process_executor import BrokenProcessPool

from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.batches import Batches
from marsyard.campaigns.execution.monitoring import POLL_INTERVAL_S, MonitoredWorker
from marsyard.campaigns.execution.work import TaskResult, Work
from marsyard.campaigns.execution.worker_process import BatchResult
from marsyard.campaigns.outcomes import CRASHED, OUT_OF_MEMORY, TIMED_OUT

Result = TypeVar("Result")

#: Number of attempts before the death of a worker, or a time limit exceeded by a suspended process, is attributed to
#: the task; the last attempt is in a fresh worker. An earlier task may have damaged the worker or used its memory, or
#: an external process may have killed or stopped it. The task itself may be the cause, so attempts are counted.
_MAX_ATTEMPTS = 2
#: Maximum number of consecutive deaths of each worker before it starts a task, and the pause after the first, s; each
#: pause is twice as long as the previous one, because a lack of memory or processes on the machine can be temporary.
_MAX_START_DEATHS, _DEATH_PAUSE_S = 4, 1.0
#: Prefix of the names of executors' temporary folders.
_PREFIX = "marsyard-"
#: Lock file in the folder of an executor; the process of the executor locks it while it runs.
_LOCK = "lock"
#: Default memory limit of all workers together, as a fraction of the memory that is free at the start.
_MEMORY_FRACTION = 0.8


class LocalExecutor(AbstractContextManager["LocalExecutor"]):
    """Executor with worker processes on this machine, as a context; an exception in the context kills the processes.

    - jobs: number of workers
    - executors: number of executors that share the memory of the machine, including this executor
    """

    def __init__(self, jobs: int, executors: int = 1) -> None:
        self._default_memory_bytes = _MEMORY_FRACTION * _free_memory() / (jobs * executors)
        try:
            _remove_abandoned_folders()
            self._folder = Path(tempfile.mkdtemp(prefix=_PREFIX))
            # the lock file is locked before it gets its final name, so that no other process can lock it first
            temporary_path = self._folder / "lock.partial"
            self._lock = os.open(temporary_path, os.O_RDWR | os.O_CREAT, 0o600)
            fcntl.flock(self._lock, fcntl.LOCK_EX)
            temporary_path.rename(self._folder / _LOCK)
            self._workers = [MonitoredWorker(self._folder / str(number)) for number in range(jobs)]
        except OSError as error:
            raise CampaignError(f"temporary files cannot be written (TMPDIR defines their folder): {error}") from error

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.stop(kill=kind is not None)

    def stop(self, *, kill: bool) -> None:
        """End the processes and remove their folder."""
        with ThreadPoolExecutor(len(self._workers)) as pool:
            list(pool.map(lambda worker: worker.stop(kill=kill), self._workers))
        os.close(self._lock)
        shutil.rmtree(self._folder, ignore_errors=True)

    def run(self, work: Work[Result]) -> Iterator[list[TaskResult[Result]]]:
        """Run work as described in `Executor.run`."""
        yield from _WorkProgress(work, work.limits.memory_bytes or self._default_memory_bytes, self._workers).results()


class _WorkProgress:
    """Progress of one `Work`: batches at workers, items to be run again, and results."""

    def __init__(self, work: Work[Any], memory_bytes: float, workers: Sequence[MonitoredWorker]) -> None:
        self._work = work
        self._batches = Batches(work.items, work.total, len(workers), work.limits.time_s)
        self._memory_bytes = memory_bytes
        self._idle = deque(workers)
        self._retries: deque[list[int]] = deque()
        self._repetitions: Counter[int] = Counter()
        self._suspect_predecessors: dict[int, int | None] = {}
        self._running: dict[Future[Any], tuple[MonitoredWorker, Sequence[int]]] = {}
        # consecutive deaths before a task, and end of the pause (monotonic clock, s), by worker
        self._deaths_at_start = dict.fromkeys(workers, 0)
        self._pausing: dict[MonitoredWorker, float] = {}

    def results(self) -> Iterator[list[TaskResult[Any]]]:
        """Run the work as described in `Executor.run`."""
        while True:
            self._submit_batches()
            if not self._running:
                if not self._pausing or not self._retries:
                    return
                time.sleep(POLL_INTERVAL_S)
                continue
            futures, _ = wait(self._running, timeout=POLL_INTERVAL_S, return_when=FIRST_COMPLETED)
            results = [
                replace(result, attempts=1 + self._repetitions.pop(result.item, 0))
                for future in futures
                for result in self._collect(future)
            ]
            for worker, _ in self._running.values():
                worker.enforce_limits(self._work.limits, self._memory_bytes, self._batches.max_duration_s)
            if results:
                # submit before the caller stores the results, so that no worker waits
                self._submit_batches()
                yield results

    def _submit_batches(self) -> None:
        """Submit a batch to each idle worker; items to be run again come first."""
        for worker in [worker for worker, end_s in self._pausing.items() if end_s <= time.monotonic()]:
            del self._pausing[worker]
            self._idle.append(worker)
        while self._idle:
            batch = self._retries.popleft() if self._retries else self._batches.next()
            if not batch:
                return
            self._submit(self._idle.popleft(), batch)

    def _submit(self, worker: MonitoredWorker, batch: Sequence[int]) -> None:
        self._running[worker.submit(self._work, batch)] = (worker, batch)

    def _collect(self, future: Future[Any]) -> list[TaskResult[Any]]:
        """Return the results of a finished batch, and arrange its unfinished items to run again."""
        worker, batch = self._running.pop(future)
        error = future.exception()
        if isinstance(error, BrokenProcessPool):
            return self._handle_worker_crash(worker, batch, error)
        if worker.is_loading:
            self._submit(worker, batch)
            return []
        is_ambiguous = worker.is_ambiguous(self._work.limits)
        if error is None and not is_ambiguous:
            self._deaths_at_start[worker] = 0
            return self._handle_batch_result(worker, future.result())
        self._idle.append(worker)
        if is_ambiguous or len(batch) > 1:
            # one of its items may have exceeded the time limit, or one of its results cannot be pickled
            self._repetitions.update(batch)
            self._retries.extend([item] for item in batch)
            return []
        return [TaskResult(batch[0], None, error if isinstance(error, Exception) else RuntimeError(repr(error)))]

    def _handle_batch_result(self, worker: MonitoredWorker, batch_result: BatchResult[Any]) -> list[TaskResult[Any]]:
        """Return the final results of a batch; an item that an earlier one may have crashed runs again."""
        if batch_result.not_started:
            self._retries.append(list(batch_result.not_started))
        if batch_result.results:
            self._batches.record_time(len(batch_result.results), batch_result.seconds)
        if batch_result.must_replace:
            worker.replace()
        crashed_results = [
            result for result in batch_result.results if result.crashed and result.previous_item is not None
        ]
        for suspect in crashed_results:
            # there is at most one, the last item of the batch; it runs again in the fresh process
            self._suspect_predecessors[suspect.item] = suspect.previous_item
            self._repetitions[suspect.item] += 1
            self._submit(worker, [suspect.item])
        if not crashed_results:
            self._idle.append(worker)
        final_results = [result for result in batch_result.results if result not in crashed_results]
        pairs = [(result, self._suspect_predecessors.pop(result.item, None)) for result in final_results]
        # an item that does not crash in a fresh process crashed because of the previous item
        return [
            result if result.crashed else replace(result, crashed_only_after=predecessor)
            for result, predecessor in pairs
        ]

    def _handle_worker_crash(
        self, worker: MonitoredWorker, batch: Sequence[int], error: BaseException
    ) -> list[TaskResult[Any]]:
        """Identify the task that ended the worker; run the other tasks of its batch again.

        Results of earlier tasks of the batch are lost with the worker. Their repetition does not count, since it does
        not depend on these results.
        """
        death = worker.handle_death(error)
        item, exit_error = death.item, death.error
        if item is None:
            self._deaths_at_start[worker] = deaths = self._deaths_at_start[worker] + 1
            if min(self._deaths_at_start.values()) >= _MAX_START_DEATHS:
                reason = f"{exit_error}\n{exit_error.trace}".strip()
                raise CampaignError(f"all worker processes die before they start a case; last death: {reason}")
            self._retries.append(list(batch))
            self._pausing[worker] = time.monotonic() + _DEATH_PAUSE_S * 2.0 ** min(deaths - 1, _MAX_START_DEATHS)
            return []
        self._deaths_at_start[worker] = 0
        index = batch.index(item)
        if exit_error.outcome == TIMED_OUT and len(batch) > 1:
            # the time of an item is measured only if it runs alone
            self._repetitions[item] += 1
            self._retries.extend([started] for started in batch[: index + 1])
            self._retries.extend([list(batch[index + 1 :])] if batch[index + 1 :] else [])
            self._idle.append(worker)
            return []
        self._retries.extend(list(part) for part in (batch[:index], batch[index + 1 :]) if part)
        is_uncertain = exit_error.outcome in (CRASHED, OUT_OF_MEMORY) or death.was_suspended
        if is_uncertain and 1 + self._repetitions[item] < _MAX_ATTEMPTS:
            self._repetitions[item] += 1
            self._submit(worker, [item])
            return []
        self._idle.append(worker)
        return [TaskResult(item, None, exit_error)]


def _remove_abandoned_folders() -> None:
    """Remove the folders of executors whose processes have ended, so that their lock is free."""
    for lock in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*/{_LOCK}"):
        with suppress(OSError):
            descriptor = os.open(lock, os.O_RDWR)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(lock.parent, ignore_errors=True)
            finally:
                os.close(descriptor)


def _free_memory() -> float:
    """Return the available memory in bytes; infinite if the operating system does not report it."""
    try:
        text = Path("/proc/meminfo").read_text()
    except OSError:
        return math.inf
    match = re.search(r"^MemAvailable:\s+(\d+) kB", text, re.MULTILINE)
    return float(match[1]) * 1024.0 if match else math.inf
