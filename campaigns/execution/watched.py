"""Monitored worker process: ended when its task exceeds a limit, replaced when it died."""

from __future__ import annotations

import math
import os
import re
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from joblib.externals.loky import ProcessPoolExecutor
from joblib.externals.loky.process_executor import BrokenProcessPool

from marsyard.algorithms.processes import descendants, used_memory
from marsyard.campaigns.execution import supervisor, worker_process
from marsyard.campaigns.execution.supervisor import DUMP_SIGNAL, END_SIGNAL, kill, marked_processes
from marsyard.campaigns.execution.work import WorkLimits
from marsyard.campaigns.execution.worker_process import FILES_CLOSED, BatchResult, StatusBoard, run_batch
from marsyard.campaigns.outcomes import CRASHED, OUT_OF_MEMORY, TIMED_OUT, TOO_MUCH_OUTPUT, CaseEndedError

Result = TypeVar("Result")

#: Set before a worker loads any library: one thread each, reproducible order of sets, and assertions enabled.
WORKER_ENVIRONMENT: Mapping[str, str] = {
    **dict.fromkeys(
        (
            "OMP_NUM_THREADS",
            "OPENBLAS_NUM_THREADS",
            "MKL_NUM_THREADS",
            "NUMBA_NUM_THREADS",
            "NUMEXPR_NUM_THREADS",
            "VECLIB_MAXIMUM_THREADS",
            "OPENCV_FOR_THREADS_NUM",
            "LP_NUM_THREADS",
        ),
        "1",
    ),
    "PYTHONHASHSEED": "0",
    # pyrender calls GL inside assertions, which `python -O` removes
    "PYTHONOPTIMIZE": "",
}

#: Seconds between two checks of a worker.
POLL_INTERVAL_S = 0.05

#: Bytes kept of the last output of a dead process, and bytes read of a task's note.
_MAX_OUTPUT, _MAX_NOTE = 2000, 1_000_000
#: Seconds that a worker has to write its stack trace.
_DUMP_S = 0.3
#: Seconds that a worker has to end by itself after all work, and that its supervisor has to kill everything.
_EXIT_S, _KILLING_S = 5.0, 2.0
#: Environment variable of a worker, which identifies its descendants even without their supervisor.
_MARK = "MARSYARD_WORKER"


class WatchedWorker:
    """One worker process, monitored, and replaced when it dies.

    Signals go only to the process that the executor started, the worker's supervisor; it ends after its descendants.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self._home = folder
        self._generation = 0
        self._start()

    def _start(self) -> None:
        """Prepare another process, with a folder of its own; loky starts it with the first batch."""
        self._generation += 1
        self._folder = self._home / str(self._generation)
        (self._folder / "tmp").mkdir(parents=True)
        self._board = StatusBoard.create(self._folder / "board")
        self._ended: tuple[int, CaseEndedError] | None = None
        self._checked_s = -math.inf
        self._process: Any = None
        self._executor: Any = ProcessPoolExecutor(
            max_workers=1,
            initializer=worker_process.start_worker,
            initargs=(os.getpid(), str(self._folder)),
            env={**WORKER_ENVIRONMENT, _MARK: str(self._folder), "TMPDIR": str(self._folder / "tmp")},
        )

    def submit(self, task: Callable[[int], Result], batch: Sequence[int]) -> Future[BatchResult[Result]]:
        """Submit a batch; start a fresh process where the last one died while idle."""
        try:
            future: Future[Any] = self._executor.submit(run_batch, task, batch)
        except BrokenProcessPool:
            self.replace()
            future = self._executor.submit(run_batch, task, batch)
        if self._process is None:
            self._process = next(iter(list(self._executor._processes.values())), None)
        return future

    def enforce_limits(self, limits: WorkLimits, memory_bytes: float) -> None:
        """End the process where its task exceeds a limit."""
        now = time.monotonic()
        if self._ended is not None or now - self._checked_s < POLL_INTERVAL_S:
            return
        self._checked_s = now
        if not self._alive():
            # loky waits for a pipe that any process that outlived its supervisor holds open
            kill(marked_processes(self._mark))
            return
        status = self._board.read()
        if status.item is None:
            return
        output = self._folder / "output"
        if now - status.since_s > limits.time_s:
            self._end(status.item, TIMED_OUT, f"took longer than its limit of {limits.time_s:g} s")
        elif used_memory(descendants(self._process.pid), memory_bytes) > memory_bytes:
            limit = "its share" if limits.memory_bytes is None else f"its limit of {memory_bytes / 1e9:g} GB"
            self._end(status.item, OUT_OF_MEMORY, f"took more memory than {limit}")
        elif output.exists() and output.stat().st_size > limits.output_bytes:
            self._end(status.item, TOO_MUCH_OUTPUT, f"wrote more than its limit of {limits.output_bytes / 1e6:g} MB")

    def _end(self, item: int, outcome: str, reason: str) -> None:
        """Have the process write its stack trace, and kill it."""
        trace = self._folder / "words"
        self._signal(DUMP_SIGNAL)
        deadline = time.monotonic() + _DUMP_S
        while not (trace.exists() and trace.stat().st_size > 0) and time.monotonic() < deadline:
            time.sleep(0.01)
        self._ended = (item, CaseEndedError(outcome, reason, self._last_trace(with_output=False)))
        self._kill()

    @property
    def _mark(self) -> str:
        return f"{_MARK}={self._folder}"

    def _alive(self) -> bool:
        return self._process is not None and self._process.is_alive()

    def _signal(self, number: int) -> None:
        """Signal the supervisor; its number cannot be reused before the executor's object has seen its end."""
        if self._alive():
            with suppress(ProcessLookupError):
                os.kill(self._process.pid, number)

    def _kill(self) -> None:
        """Kill the process and its descendants, and wait for their end."""
        self._signal(END_SIGNAL)
        if self._process is None or self._ends_within(_KILLING_S):
            return
        # the supervisor was stopped or is busy
        kill([*descendants(self._process.pid), self._process.pid, *marked_processes(self._mark)])

    def _ends_within(self, seconds: float) -> bool:
        deadline = time.monotonic() + seconds
        while self._alive() and time.monotonic() < deadline:
            time.sleep(0.005)
        return not self._alive()

    def handle_death(self, error: BaseException) -> tuple[int | None, CaseEndedError]:
        """Identify the task that the process died of (None if it had none) and the cause; prepare another process."""
        if self._ended is not None:
            item: int | None = self._ended[0]
            cause = self._ended[1]
        else:
            cause = CaseEndedError(CRASHED, _death_reason(error), self._last_trace(with_output=True))
            item = self._board.read().item
        self._kill()
        note = self._folder / "note"
        cause.note = note.read_bytes()[:_MAX_NOTE].decode(errors="replace") if note.exists() else ""
        self.replace()
        return item, cause

    def _last_trace(self, *, with_output: bool) -> str:
        """Fatal error, stack of the thread in which it happened, and last output of the process."""
        trace, output = (self._folder / name for name in ("words", "output"))
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
        """Kill the process, if it lives, and prepare another."""
        self._kill()
        self._executor.shutdown(wait=False)
        self._board.close()
        shutil.rmtree(self._folder, ignore_errors=True)
        self._start()

    def stop(self, *, kill: bool) -> None:
        """End the process, which has some seconds to do so by itself, and wait for its end."""
        manager = self._executor._executor_manager_thread
        if kill:
            self._kill()
        self._executor.shutdown(wait=False)
        if not self._ends_within(_EXIT_S):
            self._kill()
        if manager is not None:
            manager.join(_KILLING_S)
            if manager.is_alive():
                supervisor.kill(marked_processes(self._mark))
                manager.join(_KILLING_S)
        self._board.close()


def _death_reason(error: BaseException) -> str:
    """Cause of a worker's death from loky's message: ``the worker process died: SIGABRT (-6)``."""
    codes = re.findall(r"([A-Z]+)\((-?\d+)\)", str(error))
    status = ", ".join(f"{name} ({code})" for name, code in codes) or "exit status unknown"
    if status == f"EXIT ({FILES_CLOSED})":
        return "the case closed or replaced the worker's file descriptors"
    return f"the worker process died: {status}"
