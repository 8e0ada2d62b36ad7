"""Worker processes, each running one task at a time, so that one that dies takes nothing but its own task with it.

Each worker is a loky executor (joblib's) of one process. With one process an executor that breaks says which task broke
it, and the others go on undisturbed; `jobs=1` is the same set-up with one of them.
"""

from __future__ import annotations

import ctypes
import faulthandler
import os
import re
import signal
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, Generic, Self, TypeVar

from joblib.externals.loky import ProcessPoolExecutor
from joblib.externals.loky.process_executor import BrokenProcessPool

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

#: Of Linux's `prctl`: the signal that a process gets when its parent dies.
_PR_SET_PDEATHSIG = 1

#: Times that a task is given to a fresh worker before its death is laid to the task.
_ATTEMPTS = 2


class WorkerDiedError(Exception):
    """A task took its worker process down, and again in a fresh one.

    `trace` is where in Python the process stood, if it had the time to tell.
    """

    def __init__(self, reason: str, trace: str) -> None:
        super().__init__(f"the worker process died: {reason}")
        self.trace = trace


@dataclass(frozen=True)
class Done(Generic[Result]):
    """A task that ended: its item, and its result or the error that kept it from one."""

    item: int
    result: Result | None
    error: Exception | None


def available_cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def limit_threads() -> None:
    """Keeps the numerical libraries that are loaded by now to one thread; the environment does so for later ones."""
    from threadpoolctl import threadpool_limits

    threadpool_limits(1)
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(1)
    if "numba" in sys.modules:
        sys.modules["numba"].set_num_threads(1)


def _begin_worker(parent: int, last_words: str) -> None:
    """Sets a fresh worker process up.

    Ctrl-C, which reaches every process of a terminal, is left to the parent; where the parent is killed the worker goes
    with it; a process that dies of a signal writes down where it stood.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)
    faulthandler.enable(os.open(last_words, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600))


class _Worker:
    """One process, replaced when it dies."""

    def __init__(self, last_words: Path) -> None:
        self._last_words = last_words
        self._executor = self._start()

    def _start(self) -> Any:
        return ProcessPoolExecutor(
            max_workers=1,
            initializer=_begin_worker,
            initargs=(os.getpid(), str(self._last_words)),
            env=dict(WORKER_ENVIRONMENT),
        )

    def submit(self, task: Callable[[int], Result], item: int) -> Future[Result]:
        """Gives the worker a task; in a fresh process where the last one died while idle."""
        try:
            future: Future[Result] = self._executor.submit(task, item)
        except BrokenProcessPool:
            self.replace()
            future = self._executor.submit(task, item)
        return future

    def last_words(self) -> str:
        """What the process that died wrote of where it stood: the reason, and the thread in which it happened."""
        text = self._last_words.read_text(errors="replace") if self._last_words.exists() else ""
        reason, _, threads = text.partition("\n\n")
        current = next((part for part in threads.split("\n\n") if part.startswith("Current thread")), "")
        return f"{reason}\n{current}".strip()

    def replace(self) -> None:
        """Leaves the dead process and starts another."""
        self._executor.shutdown(wait=False)
        self._executor = self._start()

    def stop(self, *, kill: bool) -> None:
        """Ends the process and waits until it is gone."""
        self._executor.shutdown(wait=True, kill_workers=kill)


class Workers:
    """A number of worker processes, as a context: left normally they end, left by an exception they are killed."""

    def __init__(self, jobs: int) -> None:
        self._folder = TemporaryDirectory(prefix="marsyard-")
        self._workers = [_Worker(Path(self._folder.name) / str(number)) for number in range(jobs)]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        kill = kind is not None
        with ThreadPoolExecutor(len(self._workers)) as pool:
            list(pool.map(lambda worker: worker.stop(kill=kill), self._workers))
        self._folder.cleanup()

    def run(self, task: Callable[[int], Result], items: Iterable[int]) -> Iterator[Done[Result]]:
        """Runs a task on every item, and yields each as it ends, in no particular order."""
        idle = deque(self._workers)
        waiting: deque[tuple[int, int]] = deque()
        source = iter(items)
        running: dict[Future[Result], tuple[_Worker, int, int]] = {}
        while True:
            while idle:
                if not waiting and (item := next(source, None)) is not None:
                    waiting.append((item, 1))
                if not waiting:
                    break
                item, attempt = waiting.popleft()
                worker = idle.popleft()
                running[worker.submit(task, item)] = (worker, item, attempt)
            if not running:
                return
            ended, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in ended:
                worker, item, attempt = running.pop(future)
                idle.append(worker)
                error = future.exception()
                if isinstance(error, BrokenProcessPool):
                    death = WorkerDiedError(_exit_status(error), worker.last_words())
                    worker.replace()
                    if attempt < _ATTEMPTS:
                        waiting.append((item, attempt + 1))
                    else:
                        yield Done(item, None, death)
                elif error is not None:
                    yield Done(item, None, error if isinstance(error, Exception) else RuntimeError(repr(error)))
                else:
                    yield Done(item, future.result(), None)


def _exit_status(error: BaseException) -> str:
    """How a worker ended, from loky's account of it: ``SIGABRT (-6)``."""
    codes = re.findall(r"([A-Z]+)\((-?\d+)\)", str(error))
    return ", ".join(f"{name} ({code})" for name, code in codes) or "exit status unknown"
