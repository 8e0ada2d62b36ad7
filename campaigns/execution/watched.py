"""A worker process that is watched: ended where its task is over a limit, replaced where it died."""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from joblib.externals.loky import ProcessPoolExecutor
from joblib.externals.loky.process_executor import BrokenProcessPool

from campaigns.execution import worker_process
from campaigns.execution.work import WorkLimits
from campaigns.execution.worker_process import Board, Done, run_batch
from campaigns.outcomes import CRASHED, OUT_OF_MEMORY, TIMED_OUT, TOO_MUCH_OUTPUT, CaseEndedError

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


class WatchedWorker:
    """One process, watched, and replaced when it dies."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self._folder = folder
        self._board = Board.create(folder / "board")
        self._ended: tuple[int, CaseEndedError] | None = None
        self._looked_s = 0.0
        self._executor = self._start()

    def _start(self) -> Any:
        return ProcessPoolExecutor(
            max_workers=1,
            initializer=worker_process.begin,
            initargs=(os.getpid(), str(self._folder)),
            env=dict(WORKER_ENVIRONMENT),
        )

    def submit(self, task: Callable[[int], Result], batch: Sequence[int]) -> Future[tuple[float, list[Done[Result]]]]:
        """Gives the worker a batch; in a fresh process where the last one died while idle."""
        try:
            future: Future[Any] = self._executor.submit(run_batch, task, batch)
        except BrokenProcessPool:
            self.replace()
            future = self._executor.submit(run_batch, task, batch)
        return future

    def look(self, limits: WorkLimits, memory_bytes: float) -> None:
        """Ends the process where its task is over a limit."""
        now = time.monotonic()
        if self._ended is not None or now - self._looked_s < LOOK_S:
            return
        self._looked_s = now
        stands = self._board.read()
        if stands.item is None:
            return
        if now - stands.since_s > limits.time_s:
            self._end(stands.item, TIMED_OUT, f"took longer than its limit of {limits.time_s:g} s")
        elif used_memory(stands.process) > memory_bytes:
            limit = "its share" if limits.memory_bytes is None else f"its limit of {memory_bytes / 1e9:g} GB"
            self._end(stands.item, OUT_OF_MEMORY, f"took more memory than {limit}")
        elif self._output_size() > limits.output_bytes:
            self._end(stands.item, TOO_MUCH_OUTPUT, f"wrote more than its limit of {limits.output_bytes / 1e6:g} MB")

    def _output_size(self) -> int:
        output = self._folder / "output"
        return output.stat().st_size if output.exists() else 0

    def _end(self, item: int, outcome: str, reason: str) -> None:
        """Has the process say where it stands, and kills it."""
        process = self._board.read().process
        words = self._folder / "words"
        with suppress(OSError):
            os.kill(process, worker_process.DUMP_SIGNAL)
            deadline = time.monotonic() + _DUMP_S
            while words.stat().st_size == 0 and time.monotonic() < deadline:
                time.sleep(0.01)
        self._ended = (item, CaseEndedError(outcome, reason, self._last_words(with_output=False)))
        self._kill()

    def _kill(self) -> None:
        """Kills the process and what it started."""
        process = self._board.read().process
        if process:
            with suppress(ProcessLookupError):
                os.killpg(process, signal.SIGKILL)

    def death(self, error: BaseException) -> tuple[int | None, CaseEndedError]:
        """Which task the process died of, None if it had none, and how; leaves another process in its place."""
        died = self._ended
        if died is None:
            reason = f"the worker process died: {_exit_status(error)}"
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
        """Leaves the dead process and starts another."""
        self._executor.shutdown(wait=False)
        self._ended = None
        self._board.close()
        self._board = Board.create(self._folder / "board")
        for name in ("words", "output", "note"):
            (self._folder / name).unlink(missing_ok=True)
        self._executor = self._start()

    def stop(self, *, kill: bool) -> None:
        """Ends the process and waits until it is gone."""
        begun = self._board.read().process != 0
        if kill and begun:
            self._kill()
        # a process that has begun is dead by now: having loky kill it as well, beside tasks that wait, would raise in
        # loky's thread (KeyError in `add_call_item_to_queue`)
        self._executor.shutdown(wait=True, kill_workers=kill and not begun)
        self._board.close()


def used_memory(process: int) -> float:
    """Bytes that a process and what it started have to themselves; 0 for one that is gone.

    Pages of mapped files are not among them: workers share those of a terrain, and Linux takes them back as needed.
    """
    try:
        text = Path(f"/proc/{process}/status").read_text()
        children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    except OSError:
        return 0.0
    own = sum(float(size) for size in re.findall(r"^Rss(?:Anon|Shmem):\s+(\d+) kB", text, re.MULTILINE)) * 1024.0
    return own + sum(used_memory(int(child)) for child in children)


def _exit_status(error: BaseException) -> str:
    """How a worker ended, from loky's account of it: ``SIGABRT (-6)``."""
    codes = re.findall(r"([A-Z]+)\((-?\d+)\)", str(error))
    return ", ".join(f"{name} ({code})" for name, code in codes) or "exit status unknown"
