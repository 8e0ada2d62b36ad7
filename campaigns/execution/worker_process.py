"""What happens inside a worker process: it is set up, runs batches, and lets its watcher see where it stands."""

from __future__ import annotations

import ctypes
import faulthandler
import gc
import math
import mmap
import os
import signal
import struct
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

Result = TypeVar("Result")

#: Of Linux's `prctl`: the signal that a process gets when its parent dies.
_PR_SET_PDEATHSIG = 1

#: Makes a worker write down where it stands.
DUMP_SIGNAL = signal.SIGUSR2

#: What Linux adds to a worker's badness (of 1000) when memory runs out: workers go before their watcher.
_OOM_SCORE = 800

#: Time that loading a campaign's code may take beyond the case's own limit.
LOADING_S = 300.0

_LAYOUT = struct.Struct("=qqd")
_NOTHING = -1


@dataclass(frozen=True)
class Done(Generic[Result]):
    """A task that ended: its item, and its result or the error that kept it from one."""

    item: int
    result: Result | None
    error: Exception | None


@dataclass(frozen=True)
class Standing:
    """Where a worker stands: its process, the item it works on (None between items), and since when (monotonic)."""

    process: int
    item: int | None
    since_s: float


class Board:
    """A few bytes that a worker writes and its watcher reads, also when the worker is stuck or gone."""

    def __init__(self, path: Path) -> None:
        with path.open("r+b") as file:
            self._bytes = mmap.mmap(file.fileno(), _LAYOUT.size)

    @staticmethod
    def create(path: Path) -> Board:
        """A board on which nothing stands."""
        path.write_bytes(_LAYOUT.pack(0, _NOTHING, math.inf))
        return Board(path)

    def write(self, standing: Standing) -> None:
        """Shows where the worker stands."""
        item = _NOTHING if standing.item is None else standing.item
        self._bytes[:] = _LAYOUT.pack(standing.process, item, standing.since_s)

    def read(self) -> Standing:
        """Where the worker stands; read until two readings agree, as the worker may be writing."""
        seen = bytes(self._bytes)
        while (again := bytes(self._bytes)) != seen:
            seen = again
        process, item, since_s = _LAYOUT.unpack(seen)
        return Standing(process, None if item == _NOTHING else item, since_s)

    def close(self) -> None:
        """Leaves the board."""
        self._bytes.close()


@dataclass
class _Place:
    """The process's own board, and the file that its output goes to."""

    board: Board
    output: int
    note: Path
    descriptors: Mapping[int, tuple[int, int]]
    item: int | None = None


_place: _Place | None = None


def begin(parent: int, folder: str) -> None:
    """Sets a fresh worker process up.

    It leads a process group of its own, so that what it starts can be ended with it and Ctrl-C in a terminal is left to
    the parent; where the parent is killed it goes as well; a process that dies of a signal writes down where it stood;
    and what it prints goes to a file.
    """
    global _place
    os.setpgid(0, 0)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)
        Path("/proc/self/oom_score_adj").write_text(str(_OOM_SCORE))
    words = os.open(Path(folder, "words"), os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o600)
    faulthandler.enable(words)
    faulthandler.register(DUMP_SIGNAL, words, all_threads=False, chain=False)
    output = os.open(Path(folder, "output"), os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o600)
    for stream in (1, 2):
        os.dup2(output, stream)
    _leave_memory_to_the_watcher()
    _place = _Place(Board(Path(folder, "board")), output, Path(folder, "note"), _open_descriptors())
    _place.board.write(Standing(os.getpid(), None, math.inf))


def _leave_memory_to_the_watcher() -> None:
    """Keeps loky from ending workers that hold 300 MB more than at first: terrains are kept so, and limits are ours."""
    from joblib.externals.loky import process_executor

    process_executor._USE_PSUTIL = False


def run_batch(task: Callable[[int], Result], items: Sequence[int]) -> tuple[float, list[Done[Result]]]:
    """Runs a task on each item; returns the seconds that it took, and what became of each."""
    began = time.perf_counter()
    ended = [_attempt(task, item) for item in items]
    if _place is not None:
        _place.board.write(Standing(os.getpid(), None, math.inf))
    return time.perf_counter() - began, ended


def _attempt(task: Callable[[int], Result], item: int) -> Done[Result]:
    """Runs a task on one item."""
    if _place is not None:
        _forget_output(_place.output)
        _place.item = item
        start_clock()
    try:
        return Done(item, task(item), None)
    except Exception as error:
        return Done(item, None, error)


def _forget_output(output: int) -> None:
    """Empties the file of the output, so that its size is that of the item's own."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None and not stream.closed:
            stream.flush()
    if os.fstat(output).st_size > 0:
        os.ftruncate(output, 0)


def start_clock(grace_s: float = 0.0) -> None:
    """Lets the time limit of the item that is being worked on count from now, or from later."""
    if _place is not None:
        _place.board.write(Standing(os.getpid(), _place.item, time.monotonic() + grace_s))


def leave_note(text: str) -> None:
    """Leaves a text that the watcher finds where the task ends with its process; it replaces the one before."""
    if _place is not None:
        _place.note.write_text(text)


def lost_descriptors() -> list[int]:
    """The file descriptors of the worker's own that were closed or replaced since it was set up."""
    if _place is None:
        return []
    found = _open_descriptors()
    return sorted(number for number, file in _place.descriptors.items() if found.get(number) != file)


def _open_descriptors() -> dict[int, tuple[int, int]]:
    """Device and inode of each open file descriptor; none where the system does not list them."""
    found = {}
    for path in Path("/proc/self/fd").iterdir() if sys.platform == "linux" else ():
        with suppress(OSError):  # that of the listing itself is closed by now
            status = os.fstat(int(path.name))
            found[int(path.name)] = (status.st_dev, status.st_ino)
    return found


def settle() -> None:
    """Spares what is loaded by now from every later search for garbage, which would cost some 5 % of short cases."""
    gc.collect()
    gc.freeze()


def limit_threads() -> None:
    """Keeps the numerical libraries that are loaded by now to one thread; the environment does so for later ones."""
    from threadpoolctl import threadpool_limits

    threadpool_limits(1)
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(1)
    if "numba" in sys.modules:
        sys.modules["numba"].set_num_threads(1)
