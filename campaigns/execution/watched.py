"""A worker process that is watched: ended where its task is over a limit, replaced where it died."""

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
from marsyard.campaigns.execution import worker_process
from marsyard.campaigns.execution.process_tree import kill, marked_processes
from marsyard.campaigns.execution.supervisor import DUMP_SIGNAL, END_SIGNAL
from marsyard.campaigns.execution.work import WorkLimits
from marsyard.campaigns.execution.worker_process import FILES_CLOSED, BatchEnd, Board, run_batch
from marsyard.campaigns.outcomes import CRASHED, OUT_OF_MEMORY, TIMED_OUT, TOO_MUCH_OUTPUT, CaseEndedError

Result = TypeVar("Result")

#: Set before a worker loads any library: one thread each, an order of sets that does not change from run to run, and
#: assertions kept.
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
    # pyrender makes calls of GL inside assertions, which `python -O` leaves out.
    "PYTHONOPTIMIZE": "",
}

#: Seconds between two looks at a worker.
LOOK_S = 0.05

#: Characters kept of what a process wrote before it died.
_KEPT_OUTPUT = 2000

#: Bytes read of the note that a task left.
_MAX_NOTE = 1_000_000

#: Seconds that a worker gets to write down where it stands.
_DUMP_S = 0.3

#: Seconds that a worker gets to end by itself where all work is done, and that its supervisor gets to kill everything.
_LEAVING_S, _KILLING_S = 5.0, 2.0

#: Seconds between two looks at a process that is to end.
_PAUSE_S = 0.005

#: Variable in the environment of a worker, by which what it started is found even without its supervisor.
_MARK = "MARSYARD_WORKER"


class WatchedWorker:
    """One process, watched, and replaced when it dies.

    Signals go to the process that the executor started, the supervisor of the worker, and to nothing that a case could
    name; the supervisor ends after all that is below it.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self._home = folder
        self._generation = 0
        self._start()

    def _start(self) -> None:
        """Makes ready for another process, in a folder of its own; loky starts it with the first batch."""
        self._generation += 1
        self._folder = self._home / str(self._generation)
        (self._folder / "tmp").mkdir(parents=True)
        self._board = Board.create(self._folder / "board")
        self._ended: tuple[int, CaseEndedError] | None = None
        self._looked_s = -math.inf
        self._process: Any = None
        self._executor: Any = ProcessPoolExecutor(
            max_workers=1,
            initializer=worker_process.begin,
            initargs=(os.getpid(), str(self._folder)),
            env={**WORKER_ENVIRONMENT, _MARK: str(self._folder), "TMPDIR": str(self._folder / "tmp")},
        )

    def submit(self, task: Callable[[int], Result], batch: Sequence[int]) -> Future[BatchEnd[Result]]:
        """Gives the worker a batch; in a fresh process where the last one died while idle."""
        try:
            future: Future[Any] = self._executor.submit(run_batch, task, batch)
        except BrokenProcessPool:
            self.replace()
            future = self._executor.submit(run_batch, task, batch)
        if self._process is None:
            self._process = next(iter(list(self._executor._processes.values())), None)
        return future

    def look(self, limits: WorkLimits, memory_bytes: float) -> None:
        """Ends the process where its task is over a limit."""
        now = time.monotonic()
        if self._ended is not None or now - self._looked_s < LOOK_S:
            return
        self._looked_s = now
        if not self._alive():
            # loky waits for a pipe that whatever outlived its supervisor holds open
            kill(marked_processes(self._mark))
            return
        stands = self._board.read()
        if stands.item is None:
            return
        if now - stands.since_s > limits.time_s:
            self._end(stands.item, TIMED_OUT, f"took longer than its limit of {limits.time_s:g} s")
        elif self._uses_more(memory_bytes):
            limit = "its share" if limits.memory_bytes is None else f"its limit of {memory_bytes / 1e9:g} GB"
            self._end(stands.item, OUT_OF_MEMORY, f"took more memory than {limit}")
        elif self._output_size() > limits.output_bytes:
            self._end(stands.item, TOO_MUCH_OUTPUT, f"wrote more than its limit of {limits.output_bytes / 1e6:g} MB")

    def _uses_more(self, memory_bytes: float) -> bool:
        return used_memory(descendants(self._process.pid), memory_bytes) > memory_bytes

    def _output_size(self) -> int:
        output = self._folder / "output"
        return output.stat().st_size if output.exists() else 0

    def _end(self, item: int, outcome: str, reason: str) -> None:
        """Has the process say where it stands, and kills it."""
        words = self._folder / "words"
        self._signal(DUMP_SIGNAL)
        deadline = time.monotonic() + _DUMP_S
        while not self._has_words(words) and time.monotonic() < deadline:
            time.sleep(0.01)
        self._ended = (item, CaseEndedError(outcome, reason, self._last_words(with_output=False)))
        self._kill()

    def _has_words(self, words: Path) -> bool:
        return words.exists() and words.stat().st_size > 0

    @property
    def _mark(self) -> str:
        return f"{_MARK}={self._folder}"

    def _alive(self) -> bool:
        return self._process is not None and self._process.is_alive()

    def _signal(self, number: int) -> None:
        """Signals the supervisor, whose number stays its own until the executor's object knows of its end."""
        if self._alive():
            with suppress(ProcessLookupError):
                os.kill(self._process.pid, number)

    def _kill(self) -> None:
        """Kills the process and what it started, and waits until that is done."""
        self._signal(END_SIGNAL)
        if self._process is None or self._ends_within(_KILLING_S):
            return
        # its supervisor was stopped or is busy
        kill([*descendants(self._process.pid), self._process.pid, *marked_processes(self._mark)])

    def _ends_within(self, seconds: float) -> bool:
        deadline = time.monotonic() + seconds
        while self._alive() and time.monotonic() < deadline:
            time.sleep(_PAUSE_S)
        return not self._alive()

    def death(self, error: BaseException) -> tuple[int | None, CaseEndedError]:
        """Which task the process died of, None if it had none, and how; leaves another process in its place."""
        died = self._ended
        if died is None:
            reason = _reason(error)
            found = CaseEndedError(CRASHED, reason, self._last_words(with_output=True))
            item = self._board.read().item
        else:
            item, found = died
        self._kill()
        found.note = self._note()
        self.replace()
        return item, found

    def _note(self) -> str:
        """The note that the task left; empty where there is none."""
        note = self._folder / "note"
        return note.read_bytes()[:_MAX_NOTE].decode(errors="replace") if note.exists() else ""

    def _last_words(self, *, with_output: bool) -> str:
        """What the process wrote of where it stood: the reason, the thread in which it happened, and its output."""
        words, output = (self._folder / name for name in ("words", "output"))
        text = words.read_text(errors="replace") if words.exists() else ""
        parts = [part.strip() for part in text.split("\n\n") if part.strip()]
        current = [part for part in parts if "(most recent call first)" in part.partition("\n")[0]]
        current.sort(key=lambda part: not part.startswith("Current thread"))
        reason = [parts[0]] if parts and parts[0].startswith("Fatal") else []
        said = []
        if with_output and output.exists():
            tail = output.read_bytes()[-_KEPT_OUTPUT:].decode(errors="replace").strip()
            said = [f"Its output:\n{tail}"] if tail else []
        return "\n".join([*reason, *current[:1], *said])

    def replace(self) -> None:
        """Kills the process, if it lives, and makes ready for another."""
        self._kill()
        self._executor.shutdown(wait=False)
        self._board.close()
        shutil.rmtree(self._folder, ignore_errors=True)
        self._start()

    def stop(self, *, kill: bool) -> None:
        """Ends the process, by itself if it does so within seconds, and waits until it is gone."""
        manager = self._executor._executor_manager_thread
        if kill:
            self._kill()
        self._executor.shutdown(wait=False)
        if not self._ends_within(_LEAVING_S):
            self._kill()
        if manager is not None:
            manager.join(_KILLING_S)
            if manager.is_alive():
                _kill_all(marked_processes(self._mark))
                manager.join(_KILLING_S)
        self._board.close()


#: The function, where a parameter has its name.
_kill_all = kill


def _reason(error: BaseException) -> str:
    """How a worker ended, in words."""
    status = _exit_status(error)
    if status == f"EXIT ({FILES_CLOSED})":
        return "the case closed or replaced the worker's file descriptors"
    return f"the worker process died: {status}"


def _exit_status(error: BaseException) -> str:
    """How a worker ended, from loky's account of it: ``SIGABRT (-6)``."""
    codes = re.findall(r"([A-Z]+)\((-?\d+)\)", str(error))
    return ", ".join(f"{name} ({code})" for name, code in codes) or "exit status unknown"
