"""Parent side of one worker process: it starts the process, measures its times and memory, and replaces it.

A worker reports on its status board (shared memory) only which item it runs. Code of a case could write there, so the
parent measures all times itself.
"""

import math
import os
import re
import shutil
import time
from collections.abc import Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from joblib.externals.loky import ProcessPoolExecutor
from joblib.externals.loky.process_executor import BrokenProcessPool

from marsyard.algorithms.processes import descendants, used_memory
from marsyard.algorithms.processes import kill as kill_processes
from marsyard.algorithms.worker_device import WORKER_NUMBER
from marsyard.campaigns.execution import worker_process
from marsyard.campaigns.execution.supervisor import DUMP_SIGNAL, END_SIGNAL, find_marked_processes, is_stopped
from marsyard.campaigns.execution.work import Work, WorkLimits
from marsyard.campaigns.execution.worker_process import load_task, run_batch
from marsyard.campaigns.outcomes import CRASHED, OUT_OF_MEMORY, TIMED_OUT, TOO_MUCH_OUTPUT, WorkerExitError

_THREAD_VARIABLES = (
    *("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "NUMEXPR_NUM_THREADS"),
    *("VECLIB_MAXIMUM_THREADS", "OPENCV_FOR_THREADS_NUM", "LP_NUM_THREADS"),
)
#: Set before a worker loads any library: one thread each, reproducible order of sets, and assertions enabled (pyrender
#: calls GL inside assertions, which `python -O` removes).
_WORKER_ENVIRONMENT = dict.fromkeys(_THREAD_VARIABLES, "1") | {"PYTHONHASHSEED": "0", "PYTHONOPTIMIZE": ""}
#: Seconds between two checks of a worker.
POLL_INTERVAL_S = 0.05
#: Time without a check after which the parent was suspended, or busy, s.
_MAX_GAP_S = 1.0
#: Maximum seconds for starting a process and loading the code of its items, in addition to their time limits.
_LOADING_S = 300.0
#: Maximum bytes of the stored output of a dead process.
_MAX_OUTPUT = 2000
#: Maximum seconds for a worker to write its stack trace.
_DUMP_S = 0.3
#: Maximum seconds for a worker to end after all work, and for its supervisor to kill all descendants.
_EXIT_S, _KILLING_S = 5.0, 2.0
#: Environment variable by which the descendants of a worker are found, even if their supervisor has ended.
_MARK = "MARSYARD_WORKER"


class BatchClock:
    """Time and present item of a batch, as the parent observes them.

    The time begins with the submission, and ends when the results arrive. The items run in the order of the batch: a
    report of an earlier item, or of no item, has no effect.

    - batch: items, at least one
    - start_s, end_s: times of the submission and of the arrival of the results (monotonic clock)
    - was_suspended: whether the worker or the parent did not run at some time
    - has_started: whether the worker has reported an item
    """

    def __init__(self, batch: Sequence[int], start_s: float) -> None:
        self.batch, self.start_s, self.end_s = batch, start_s, math.inf
        self._index = 0
        self.was_suspended = self.has_started = False

    @property
    def item(self) -> int:
        """The present item."""
        return self.batch[self._index]

    def update(self, item: int | None) -> None:
        """Update the present item from the worker's report; None means no item."""
        if item is not None and item in self.batch:
            self.has_started = True
            self._index = max(self._index, self.batch.index(item))

    def finish(self, _: object) -> None:
        """Record the arrival of the results; called by the thread that receives them."""
        self.end_s = time.monotonic()


@dataclass(frozen=True)
class WorkerDeath:
    """Death of a worker process.

    - item: item that the process ran; None if it had not started an item
    - error: outcome and cause
    - was_suspended: whether the worker or the parent did not run at some time of the batch
    """

    item: int | None
    error: WorkerExitError
    was_suspended: bool


class MonitoredWorker:
    """One worker process, which is monitored, and replaced when it dies.

    Signals are sent only to the process that loky started: the worker's supervisor, which ends after its descendants.

    - folder: new folder of the worker, with a folder for the files of each process
    - is_loading: whether the latest submission loads the code of its work instead of running the batch
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
        self._termination: WorkerDeath | None = None
        self._loaded: Work[Any] | None = None
        self.is_loading = False
        self._clock = BatchClock([0], -math.inf)  # until the first batch
        self._checked_s = -math.inf
        self._process: Any = None
        self._executor: Any = ProcessPoolExecutor(
            max_workers=1,
            initializer=worker_process.start_worker,
            initargs=(os.getpid(), str(self._folder), str(self._parent_folder.parent)),
            env={
                **_WORKER_ENVIRONMENT,
                _MARK: str(self._folder),
                WORKER_NUMBER: self._parent_folder.name,
                "TMPDIR": str(self._folder / "tmp"),
            },
        )

    def submit(self, work: Work[Any], batch: Sequence[int]) -> Future[Any]:
        """Submit a batch; start a fresh process if the last one died while idle.

        A process that has not loaded the code of the work loads it instead (`is_loading`): submit the batch again.
        """
        if self._termination is not None:
            self.replace()  # the process was killed at the moment in which it sent the results of its batch
        try:
            return self._submit(work, batch)
        except BrokenProcessPool:
            self.replace()
            return self._submit(work, batch)

    def _submit(self, work: Work[Any], batch: Sequence[int]) -> Future[Any]:
        self.is_loading = self._loaded is not work
        call = (load_task, work.task, work.load, batch[0]) if self.is_loading else (run_batch, work.task, batch)
        future: Future[Any] = self._executor.submit(*call)
        self._loaded = work  # after an error of loading, each item raises it again
        self._checked_s = time.monotonic()
        self._clock = BatchClock(batch[:1] if self.is_loading else batch, self._checked_s)
        future.add_done_callback(self._clock.finish)
        if self._process is None:
            self._process = next(iter(list(self._executor._processes.values())), None)
        return future

    def enforce_limits(self, limits: WorkLimits, memory_bytes: float, batch_s: float) -> None:
        """Terminate the process if its task exceeds a limit, or a batch of several items the time `batch_s`."""
        now_s = time.monotonic()
        gap_s = now_s - self._checked_s
        if self._termination is not None or gap_s < POLL_INTERVAL_S:
            return
        self._checked_s = now_s
        if not self._is_alive():
            # descendants without a supervisor keep loky's pipe open, so loky waits for their end: kill them
            kill_processes(find_marked_processes(self._mark))
            return
        clock = self._clock
        clock.update(self._board.read())
        if gap_s > _MAX_GAP_S:
            # results that arrived meanwhile are collected before the next check
            clock.was_suspended = True
            return
        processes, output = descendants(self._process.pid), self._folder / "output"
        clock.was_suspended |= any(map(is_stopped, (self._process.pid, *processes)))
        time_s = _LOADING_S if self.is_loading else limits.time_s
        if now_s - clock.start_s > (time_s if len(clock.batch) == 1 else min(time_s, batch_s)):
            prefix = "loading " if self.is_loading else ""
            self._terminate(TIMED_OUT, f"{prefix}took longer than its limit of {time_s:g} s")
        elif used_memory(processes, memory_bytes) > memory_bytes:
            limit = "its default limit" if limits.memory_bytes is None else f"its limit of {memory_bytes / 1e9:g} GB"
            self._terminate(OUT_OF_MEMORY, f"used more memory than {limit}")
        elif output.exists() and output.stat().st_size > limits.output_bytes:
            self._terminate(TOO_MUCH_OUTPUT, f"wrote more than its limit of {limits.output_bytes / 1e6:g} MB")

    def is_ambiguous(self, limits: WorkLimits) -> bool:
        """Whether several items of a finished batch together took longer than one may: each could have exceeded it."""
        end_s = min(self._clock.end_s, time.monotonic())
        return len(self._clock.batch) > 1 and end_s - self._clock.start_s > limits.time_s

    def _terminate(self, outcome: str, reason: str) -> None:
        """Request the stack trace of the process, then kill the process."""
        item = None if self.is_loading and not self._clock.has_started else self._clock.item
        trace = self._folder / "trace"
        self._signal(DUMP_SIGNAL)
        deadline = time.monotonic() + _DUMP_S
        while not (trace.exists() and trace.stat().st_size > 0) and time.monotonic() < deadline:
            time.sleep(0.01)
        error = WorkerExitError(outcome, reason, self._last_trace(with_output=False))
        self._termination = WorkerDeath(item, error, self._clock.was_suspended)
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
        kill_processes([*descendants(self._process.pid), self._process.pid, *find_marked_processes(self._mark)])

    def _wait_for_end(self, max_seconds: float) -> bool:
        """Wait for the end of the process; return whether it has ended."""
        deadline = time.monotonic() + max_seconds
        while self._is_alive() and time.monotonic() < deadline:
            time.sleep(0.005)
        return not self._is_alive()

    def handle_death(self, error: BaseException) -> WorkerDeath:
        """Identify the item of the dead process and the cause of death; prepare a new process."""
        death = self._termination
        if death is None:
            # loky's message contains the exit status: ``SIGABRT(-6)``
            exit_codes = re.findall(r"([A-Z]+)\((-?\d+)\)", str(error))
            status = ", ".join(f"{name} ({code})" for name, code in exit_codes) or "exit status unknown"
            reason = f"the worker process died: {status}"
            if status == f"EXIT ({worker_process.FILES_CLOSED})":
                reason = "the case closed or replaced the worker's file descriptors"
            cause = WorkerExitError(CRASHED, reason, self._last_trace(with_output=True))
            self._clock.update(self._board.read())
            item = self._clock.item if self._clock.has_started else None
            death = WorkerDeath(item, cause, self._clock.was_suspended)
        self._kill()
        self.replace()
        return death

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
                kill_processes(find_marked_processes(self._mark))
                manager.join(_KILLING_S)
        self._board.close()
