"""Worker processes and their watching: whatever a case does, it takes nothing but itself with it.

Each worker is a loky executor (joblib's) of one process. With one process an executor that breaks says which batch
broke it, its board says which case, and the others go on undisturbed; `jobs=1` is the same set-up with one of them. The
parent looks at every worker some twenty times a second, and ends one whose case is over a limit.
"""

from __future__ import annotations

import math
import os
import re
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, Protocol, Self, TypeVar

from joblib.externals.loky import ProcessPoolExecutor
from joblib.externals.loky.process_executor import BrokenProcessPool

from campaigns.errors import CampaignError
from campaigns.execution import worker_process
from campaigns.execution.batches import Batches
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
_LOOK_S = 0.05

#: Times that a task is given to a worker before its death, or want of memory, is laid to the task: a worker may have
#: been damaged or filled by an earlier task, or killed from outside. The last time is in a fresh worker.
_ATTEMPTS = 2

#: Workers that may die one after another before they have begun a task.
_DEATHS_AT_START = 3

#: Part of the memory that is free when work begins that all workers may have together, where no limit is stated.
_SHARE_OF_MEMORY = 0.8

#: Characters kept of what a process wrote before it died.
_KEPT_OUTPUT = 2000

#: Seconds that a worker gets to write down where it stands.
_DUMP_S = 0.3


@dataclass(frozen=True)
class WorkLimits:
    """What one task may use.

    Attributes
    ----------
    time_s
        Wall-clock time.
    memory_bytes
        Memory that is its worker's alone, with what it started: neither mapped files nor shared libraries; None for
        an equal share of 80 % of what is free when work begins.
    output_bytes
        Written to standard output and standard error.
    """

    time_s: float = math.inf
    memory_bytes: float | None = None
    output_bytes: float = math.inf


#: Nothing is forbidden but to take all memory.
UNLIMITED = WorkLimits()


class Workers(Protocol):
    """Processes that run tasks, wherever they are."""

    def run(
        self,
        task: Callable[[int], Result],
        items: Iterable[int],
        limits: WorkLimits = UNLIMITED,
        total: int | None = None,
    ) -> Iterator[list[Done[Result]]]:
        """Runs a task on every item, and yields what ended since the last time, in no particular order.

        An error is what the task raised, or a `CaseEndedError`. `total` is the number of items, as far as known.
        """
        ...


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


class _Worker:
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
        if self._ended is not None or now - self._looked_s < _LOOK_S:
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
        self.replace()
        return item, found

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
        (self._folder / "words").unlink(missing_ok=True)
        (self._folder / "output").unlink(missing_ok=True)
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
        self._folder = TemporaryDirectory(prefix="marsyard-")
        self._workers = [_Worker(Path(self._folder.name) / str(number)) for number in range(jobs)]

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
        self._folder.cleanup()

    def run(
        self,
        task: Callable[[int], Result],
        items: Iterable[int],
        limits: WorkLimits = UNLIMITED,
        total: int | None = None,
    ) -> Iterator[list[Done[Result]]]:
        """See `Workers.run`."""
        batches = Batches(items, total, len(self._workers))
        memory_bytes = limits.memory_bytes or self._share_bytes
        yield from _Run(task, batches, limits, memory_bytes, self._workers).results()


class _Run:
    """One task being run on many items."""

    def __init__(
        self,
        task: Callable[[int], Any],
        batches: Batches,
        limits: WorkLimits,
        memory_bytes: float,
        workers: Sequence[_Worker],
    ) -> None:
        self._task = task
        self._batches = batches
        self._limits = limits
        self._memory_bytes = memory_bytes
        self._idle = deque(workers)
        self._again: deque[list[int]] = deque()
        self._attempts: dict[int, int] = {}
        self._running: dict[Future[Any], tuple[_Worker, Sequence[int]]] = {}
        self._deaths_at_start = 0

    def results(self) -> Iterator[list[Done[Any]]]:
        """See `Workers.run`."""
        while True:
            self._give()
            if not self._running:
                return
            ended, _ = wait(self._running, timeout=_LOOK_S, return_when=FIRST_COMPLETED)
            done = [one for future in ended for one in self._settled(future)]
            for worker, _ in self._running.values():
                worker.look(self._limits, self._memory_bytes)
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

    def _submit(self, worker: _Worker, batch: Sequence[int]) -> None:
        self._running[worker.submit(self._task, batch)] = (worker, batch)

    def _settled(self, future: Future[Any]) -> list[Done[Any]]:
        """What a batch that ended came to."""
        worker, batch = self._running.pop(future)
        error = future.exception()
        if isinstance(error, BrokenProcessPool):
            return self._bereaved(worker, batch, error)
        self._idle.append(worker)
        if error is None:
            self._deaths_at_start = 0
            seconds, done = future.result()
            self._batches.took(len(batch), seconds)
            return list(done)
        if len(batch) > 1:
            # something in it cannot be sent
            self._again.extend([item] for item in batch)
            return []
        return [Done(batch[0], None, error if isinstance(error, Exception) else RuntimeError(repr(error)))]

    def _bereaved(self, worker: _Worker, batch: Sequence[int], error: BaseException) -> list[Done[Any]]:
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
