"""Isolated worker processes on this machine: a crash, hang or memory overrun of one case cannot affect another.

Each worker is a loky executor (of joblib) with one process, which runs batches of cases. If a worker dies, its executor
identifies the batch, and its status board (shared memory) identifies the case. The parent checks each worker about
twenty times per second, and terminates a worker whose case exceeds a limit.
"""

from __future__ import annotations

import fcntl
import itertools
import math
import os
import re
import shutil
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from joblib.externals.loky import ProcessPoolExecutor
from joblib.externals.loky.process_executor import BrokenProcessPool

from marsyard.algorithms.processes import descendants, used_memory
from marsyard.campaigns.errors import CRASHED, OUT_OF_MEMORY, TIMED_OUT, TOO_MUCH_OUTPUT, CampaignError, WorkerExitError
from marsyard.campaigns.execution import supervisor, worker_process
from marsyard.campaigns.execution.supervisor import DUMP_SIGNAL, END_SIGNAL, find_marked_processes, kill
from marsyard.campaigns.execution.worker_process import BatchResult, Executor, TaskResult, Work, WorkLimits, run_batch

Result = TypeVar("Result")

_THREAD_VARIABLES = (
    *("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "NUMEXPR_NUM_THREADS"),
    *("VECLIB_MAXIMUM_THREADS", "OPENCV_FOR_THREADS_NUM", "LP_NUM_THREADS"),
)
#: Set before a worker loads any library: one thread each, reproducible order of sets, and assertions enabled (pyrender
#: calls GL inside assertions, which `python -O` removes).
_WORKER_ENVIRONMENT = dict.fromkeys(_THREAD_VARIABLES, "1") | {"PYTHONHASHSEED": "0", "PYTHONOPTIMIZE": ""}
#: Seconds between two checks of a worker.
_POLL_INTERVAL_S = 0.05
#: Maximum bytes of the stored output of a dead process, and of a task's note.
_MAX_OUTPUT, _MAX_NOTE = 2000, 1_000_000
#: Maximum seconds for a worker to write its stack trace.
_DUMP_S = 0.3
#: Maximum seconds for a worker to end after all work, and for its supervisor to kill all descendants.
_EXIT_S, _KILLING_S = 5.0, 2.0
#: Environment variable by which the descendants of a worker are found, even if their supervisor has ended.
_MARK = "MARSYARD_WORKER"
#: Number of attempts before a crash or lack of memory is attributed to the task; the last attempt is in a fresh worker.
#: An earlier task may have damaged the worker or used its memory, or an external process may have killed the worker.
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


def available_cores() -> int:
    """Number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


#: Minimum target duration of a batch, s: a worker that dies loses at most one batch.
_BATCH_S = 1.0
#: Time that sending a batch takes, s, and the maximum fraction of its time that the program spends with this.
_SENDING_S, _MAX_SENDING = 0.005, 0.5
#: Maximum number of items in a batch.
MAX_BATCH = 1000
#: Weight of the latest batch in the exponential mean of the time per item.
_LATEST_WEIGHT = 0.3


def batch_duration_s(workers: int) -> float:
    """Return the target duration of a batch: longer for many workers, so that sending batches is not the bottleneck."""
    return max(_BATCH_S, _SENDING_S / _MAX_SENDING * workers)


class Batches:
    """Batches of items, sized by the measured time per item.

    - items: iterator that is advanced only when a batch is requested
    - total: number of items, if known; the last batches are then small, so that all workers end together
    - workers: number of workers that run the batches
    """

    def __init__(self, items: Iterable[int], total: int | None, workers: int) -> None:
        self._source = iter(items)
        self._remaining = math.inf if total is None else total
        self.workers = workers
        self._size = 1
        self._item_s = math.nan

    def next(self) -> list[int]:
        """Return the next batch; empty if no items remain."""
        size = max(1, int(min(self._size, self._remaining / (2 * self.workers))))
        batch = list(itertools.islice(self._source, size))
        self._remaining -= len(batch)
        return batch

    def record_time(self, items: int, seconds: float) -> None:
        """Update the time per item from a finished batch; a batch is at most twice as large as the previous one."""
        latest, mean = seconds / items, self._item_s
        self._item_s = latest if math.isnan(mean) else mean + _LATEST_WEIGHT * (latest - mean)
        target_size = MAX_BATCH if self._item_s <= 0.0 else int(batch_duration_s(self.workers) / self._item_s)
        self._size = max(1, min(target_size, 2 * self._size, MAX_BATCH))


class MonitoredWorker:
    """One worker process, which is monitored, and replaced when it dies.

    Signals are sent only to the process that loky started: the worker's supervisor, which ends after its descendants.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self._parent_folder = folder
        self._generation = 0
        self._start()

    def _start(self) -> None:
        """Prepare a new process with a new folder; loky starts the process with the first batch."""
        self._generation += 1
        self._folder = self._parent_folder / str(self._generation)
        (self._folder / "tmp").mkdir(parents=True)
        self._mark = f"{_MARK}={self._folder}"
        self._board = worker_process.StatusBoard.create(self._folder / "board")
        self._termination: tuple[int, WorkerExitError] | None = None
        self._checked_s = -math.inf
        self._process: Any = None
        self._executor: Any = ProcessPoolExecutor(
            max_workers=1,
            initializer=worker_process.start_worker,
            initargs=(os.getpid(), str(self._folder)),
            env={**_WORKER_ENVIRONMENT, _MARK: str(self._folder), "TMPDIR": str(self._folder / "tmp")},
        )

    def submit(self, task: Callable[[int], Result], batch: Sequence[int]) -> Future[BatchResult[Result]]:
        """Submit a batch; start a fresh process if the last one died while idle."""
        try:
            future: Future[Any] = self._executor.submit(run_batch, task, batch)
        except BrokenProcessPool:
            self.replace()
            future = self._executor.submit(run_batch, task, batch)
        if self._process is None:
            self._process = next(iter(list(self._executor._processes.values())), None)
        return future

    def enforce_limits(self, limits: WorkLimits, memory_bytes: float) -> None:
        """Terminate the process if its task exceeds a limit."""
        now = time.monotonic()
        if self._termination is not None or now - self._checked_s < _POLL_INTERVAL_S:
            return
        self._checked_s = now
        if not self._is_alive():
            # descendants without a supervisor keep loky's pipe open, so loky waits for their end: kill them
            kill(find_marked_processes(self._mark))
            return
        item, since_s = self._board.read()
        if item is None:
            return
        output = self._folder / "output"
        if now - since_s > limits.time_s:
            self._terminate(item, TIMED_OUT, f"took longer than its limit of {limits.time_s:g} s")
        elif used_memory(descendants(self._process.pid), memory_bytes) > memory_bytes:
            limit = "its default limit" if limits.memory_bytes is None else f"its limit of {memory_bytes / 1e9:g} GB"
            self._terminate(item, OUT_OF_MEMORY, f"used more memory than {limit}")
        elif output.exists() and output.stat().st_size > limits.output_bytes:
            self._terminate(item, TOO_MUCH_OUTPUT, f"wrote more than its limit of {limits.output_bytes / 1e6:g} MB")

    def _terminate(self, item: int, outcome: str, reason: str) -> None:
        """Request the stack trace of the process, then kill the process."""
        trace = self._folder / "trace"
        self._signal(DUMP_SIGNAL)
        deadline = time.monotonic() + _DUMP_S
        while not (trace.exists() and trace.stat().st_size > 0) and time.monotonic() < deadline:
            time.sleep(0.01)
        self._termination = (item, WorkerExitError(outcome, reason, self._last_trace(with_output=False)))
        self._kill()

    def _is_alive(self) -> bool:
        return self._process is not None and self._process.is_alive()

    def _signal(self, number: int) -> None:
        """Send a signal to the supervisor; its process id cannot be reused until loky has registered its end."""
        if self._is_alive():
            with suppress(ProcessLookupError):
                os.kill(self._process.pid, number)

    def _kill(self) -> None:
        self._signal(END_SIGNAL)
        if self._process is None or self._wait_for_end(_KILLING_S):
            return
        # the supervisor was stopped or is busy, so its processes are killed directly
        kill([*descendants(self._process.pid), self._process.pid, *find_marked_processes(self._mark)])

    def _wait_for_end(self, max_seconds: float) -> bool:
        """Wait for the end of the process; return whether it has ended."""
        deadline = time.monotonic() + max_seconds
        while self._is_alive() and time.monotonic() < deadline:
            time.sleep(0.005)
        return not self._is_alive()

    def handle_death(self, error: BaseException) -> tuple[int | None, WorkerExitError]:
        """Identify the item of the dead process (may be None) and the cause of death; prepare a new process."""
        item: int | None
        if self._termination is not None:
            item, cause = self._termination
        else:
            # loky's message contains the exit status: ``SIGABRT(-6)``
            exit_codes = re.findall(r"([A-Z]+)\((-?\d+)\)", str(error))
            status = ", ".join(f"{name} ({code})" for name, code in exit_codes) or "exit status unknown"
            reason = f"the worker process died: {status}"
            if status == f"EXIT ({worker_process.FILES_CLOSED})":
                reason = "the case closed or replaced the worker's file descriptors"
            item, cause = (self._board.read()[0], WorkerExitError(CRASHED, reason, self._last_trace(with_output=True)))
        self._kill()
        note = self._folder / "note"
        cause.note = note.read_bytes()[:_MAX_NOTE].decode(errors="replace") if note.exists() else ""
        self.replace()
        return item, cause

    def _last_trace(self, *, with_output: bool) -> str:
        """Return the fatal error, the stack of the failed thread, and the last output of the process."""
        trace, output = (self._folder / name for name in ("trace", "output"))
        text = trace.read_text(errors="replace") if trace.exists() else ""
        parts = [part.strip() for part in text.split("\n\n") if part.strip()]
        stacks = [part for part in parts if "(most recent call first)" in part.partition("\n")[0]]
        stacks.sort(key=lambda part: not part.startswith("Current thread"))
        lines = [parts[0]] if parts and parts[0].startswith("Fatal") else []
        lines += stacks[:1]
        if with_output and output.exists():
            tail = output.read_bytes()[-_MAX_OUTPUT:].decode(errors="replace").strip()
            lines += [f"Its output:\n{tail}"] if tail else []
        return "\n".join(lines)

    def replace(self) -> None:
        """Kill the process, if it is running, and prepare a new one."""
        self._kill()
        self._executor.shutdown(wait=False)
        self._board.close()
        shutil.rmtree(self._folder, ignore_errors=True)
        self._start()

    def stop(self, *, kill: bool) -> None:
        """End the process and wait for its end; kill it now if `kill` is set, otherwise after some seconds."""
        manager = self._executor._executor_manager_thread
        if kill:
            self._kill()
        self._executor.shutdown(wait=False)
        if not self._wait_for_end(_EXIT_S):
            self._kill()
        if manager is not None:
            manager.join(_KILLING_S)
            if manager.is_alive():
                supervisor.kill(find_marked_processes(self._mark))
                manager.join(_KILLING_S)
        self._board.close()


class LocalExecutor(AbstractContextManager["LocalExecutor"]):
    """Executor with worker processes on this machine, as a context; an exception in the context kills the processes.

    - jobs: number of workers
    - executors: number of executors that share the memory of the machine, including this executor
    """

    def __init__(self, jobs: int, executors: int = 1) -> None:
        self._default_memory_bytes = _MEMORY_FRACTION * free_memory() / (jobs * executors)
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
        self._batches = Batches(work.items, work.total, len(workers))
        self._memory_bytes = memory_bytes
        self._idle = deque(workers)
        self._retries: deque[list[int]] = deque()
        self._attempts: dict[int, int] = {}
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
                time.sleep(_POLL_INTERVAL_S)
                continue
            futures, _ = wait(self._running, timeout=_POLL_INTERVAL_S, return_when=FIRST_COMPLETED)
            results = [result for future in futures for result in self._collect(future)]
            for worker, _ in self._running.values():
                worker.enforce_limits(self._work.limits, self._memory_bytes)
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
        self._running[worker.submit(self._work.task, batch)] = (worker, batch)

    def _collect(self, future: Future[Any]) -> list[TaskResult[Any]]:
        """Return the results of a finished batch, and arrange its unfinished items to run again."""
        worker, batch = self._running.pop(future)
        error = future.exception()
        if isinstance(error, BrokenProcessPool):
            return self._handle_worker_crash(worker, batch, error)
        if error is None:
            self._deaths_at_start[worker] = 0
            return self._handle_batch_result(worker, future.result())
        self._idle.append(worker)
        if len(batch) > 1:
            # one of its results cannot be pickled
            self._retries.extend([item] for item in batch)
            return []
        return [TaskResult(batch[0], None, error if isinstance(error, Exception) else RuntimeError(repr(error)))]

    def _handle_batch_result(self, worker: MonitoredWorker, batch_result: BatchResult[Any]) -> list[TaskResult[Any]]:
        """Return the final results of a batch; an item that crashed after others runs again in a fresh process."""
        self._retries.extend([item] for item in batch_result.to_isolate)
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
        """Identify the task that ended the worker; run the other tasks of its batch again."""
        item, exit_error = worker.handle_death(error)
        if item is None or item not in batch:
            self._deaths_at_start[worker] = deaths = self._deaths_at_start[worker] + 1
            if min(self._deaths_at_start.values()) >= _MAX_START_DEATHS:
                reason = f"{exit_error}\n{exit_error.trace}".strip()
                raise CampaignError(f"all worker processes die before they start a case; last death: {reason}")
            self._retries.append(list(batch))
            self._pausing[worker] = time.monotonic() + _DEATH_PAUSE_S * 2.0 ** min(deaths - 1, _MAX_START_DEATHS)
            return []
        self._deaths_at_start[worker] = 0
        index = batch.index(item)
        self._retries.extend(list(part) for part in (batch[:index], batch[index + 1 :]) if part)
        attempt = self._attempts.pop(item, 1)
        if exit_error.outcome in (CRASHED, OUT_OF_MEMORY) and attempt < _MAX_ATTEMPTS:
            self._attempts[item] = attempt + 1
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


def free_memory() -> float:
    """Return the available memory in bytes; infinite if the operating system does not report it."""
    try:
        text = Path("/proc/meminfo").read_text()
    except OSError:
        return math.inf
    match = re.search(r"^MemAvailable:\s+(\d+) kB", text, re.MULTILINE)
    return float(match[1]) * 1024.0 if match else math.inf


@dataclass(frozen=True)
class ExecutorConfig:
    """Configuration of an executor: `jobs` worker processes on this machine, or a cluster if `cluster` is set.

    `cluster` is the address of a Dask scheduler (`tcp://host:8786`), or `local:N` for a new local cluster of N workers.
    """

    jobs: int = 1
    cluster: str | None = None

    def describe(self) -> str:
        """Describe the executor for the campaign's record, without the names of hosts."""
        if self.cluster is None:
            return f"{self.jobs} on this machine"
        return f"cluster {self.cluster}" if self.cluster.startswith("local:") else "cluster"


def create_executor(config: ExecutorConfig) -> AbstractContextManager[Executor]:
    """Create an executor as a context; at the end its workers end, or are killed after an exception.

    Raises CampaignError if the cluster cannot be reached or Dask is not installed.
    """
    if config.cluster is None:
        return LocalExecutor(config.jobs)
    from marsyard.campaigns.execution.cluster import ClusterExecutor

    return ClusterExecutor(config.cluster)
