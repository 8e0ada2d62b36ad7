"""What happens inside a worker process: it is set up, runs batches, and lets its watcher see where it stands."""

from __future__ import annotations

import faulthandler
import gc
import math
import mmap
import os
import signal
import struct
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Generic, TypeVar

from marsyard.campaigns.execution.process_state import (
    Differences,
    OpenFiles,
    ProcessState,
    generators_were_used,
    seed_generators,
)
from marsyard.campaigns.execution.supervisor import DUMP_SIGNAL, become_supervised

Result = TypeVar("Result")

#: What Linux adds to a worker's badness (of 1000) when memory runs out: workers go before their watcher.
_OOM_SCORE = 800

#: Time that loading a campaign's code may take beyond the case's own limit.
LOADING_S = 300.0

#: Time of items that are checked together for what they changed in their process: a check takes some 0.1 ms.
_CHECKED_TOGETHER_S = 0.005

#: Exit status of a worker whose files an item has closed.
FILES_CLOSED = 97

_LAYOUT = struct.Struct("=qd")
_NOTHING = -1


@dataclass(frozen=True)
class Done(Generic[Result]):
    """A task that ended: its item, and its result or the error that kept it from one.

    Attributes
    ----------
    item, result, error
        One of the latter two is None.
    changed
        What the task changed in the state of its process, by name.
    crashed
        Whether the task asked for a fresh worker (`request_fresh_worker`).
    before
        The item that ran before it in the same process; None where it was the first.
    spoiled_by
        The item after which it crashed, where it did not crash in a fresh process: its result is from there.
    """

    item: int
    result: Result | None
    error: Exception | None
    changed: tuple[str, ...] = ()
    crashed: bool = False
    before: int | None = None
    spoiled_by: int | None = None


@dataclass(frozen=True)
class BatchEnd(Generic[Result]):
    """What became of a batch.

    Attributes
    ----------
    seconds
        How long it ran.
    done
        Items that ended.
    alone
        Items to be run again one by one: they were checked together, and one of them changed their process.
    rest
        Items that were not begun.
    spent
        Whether the process must run no further item.
    """

    seconds: float
    done: list[Done[Result]]
    alone: Sequence[int] = ()
    rest: Sequence[int] = ()
    spent: bool = False


@dataclass(frozen=True)
class Standing:
    """Where a worker stands: the item it works on (None between items), and since when (monotonic)."""

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
        path.write_bytes(_LAYOUT.pack(_NOTHING, math.inf))
        return Board(path)

    def write(self, standing: Standing) -> None:
        """Shows where the worker stands."""
        item = _NOTHING if standing.item is None else standing.item
        self._bytes[:] = _LAYOUT.pack(item, standing.since_s)

    def read(self) -> Standing:
        """Where the worker stands; read until two readings agree, as the worker may be writing."""
        seen = bytes(self._bytes)
        while (again := bytes(self._bytes)) != seen:
            seen = again
        item, since_s = _LAYOUT.unpack(seen)
        return Standing(None if item == _NOTHING else item, since_s)

    def close(self) -> None:
        """Leaves the board."""
        self._bytes.close()


@dataclass
class _Place:
    """The process's own board, the file that its output goes to, and the state that items are to leave as it was."""

    board: Board
    words: Path
    output: int
    note: Path
    files: OpenFiles
    item: int | None = None
    state: ProcessState = field(default_factory=ProcessState)
    checks_each: bool = False
    crashed: bool = False


_place: _Place | None = None


def begin(parent: int, folder: str) -> None:
    """Sets a fresh worker process up.

    It leads a process group of its own, below a supervisor that ends with the parent and leaves nothing of what the
    worker started (`marsyard.campaigns.execution.supervisor`); a process that dies of a signal writes down where it
    stood; and what it prints goes to a file.
    """
    global _place
    os.setpgid(0, 0)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    output = os.open(Path(folder, "output"), os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o600)
    for stream in (1, 2):
        os.dup2(output, stream)
    become_supervised(parent, Path(folder).parent.parent)
    if sys.platform == "linux":
        os.setpgid(0, 0)
        Path("/proc/self/oom_score_adj").write_text(str(_OOM_SCORE))
    words = Path(folder, "words")
    written = os.open(words, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o600)
    faulthandler.enable(written)
    faulthandler.register(DUMP_SIGNAL, written, all_threads=False, chain=False)
    _leave_memory_to_the_watcher()
    _place = _Place(Board(Path(folder, "board")), words, output, Path(folder, "note"), OpenFiles())
    _place.board.write(Standing(None, math.inf))


def _leave_memory_to_the_watcher() -> None:
    """Keeps loky from ending workers that hold 300 MB more than at first: terrains are kept so, and limits are ours."""
    from joblib.externals.loky import process_executor

    process_executor._USE_PSUTIL = False


def run_batch(task: Callable[[int], Result], items: Sequence[int]) -> BatchEnd[Result]:
    """Runs a task on each item, until they end or the process is spent.

    After each item the state of the process is compared with what it was; items of less than some milliseconds are
    checked together, and are run again one by one where that shows a difference.
    """
    began = checked = time.perf_counter()
    done: list[Done[Result]] = []
    group: list[Done[Result]] = []
    for place, item in enumerate(items):
        if not group:
            seed_generators(item)
        group.append(_attempt(task, item))
        ends = place + 1 == len(items) or _must_check() or time.perf_counter() - checked > _CHECKED_TOGETHER_S
        if not ends:
            continue
        spent, found = _checked([one.item for one in group])
        rest = items[place + 1 :] if spent else ()
        if found is None:
            alone = [one.item for one in group]
            return BatchEnd(time.perf_counter() - began, done, alone, items[place + 1 :], spent)
        done += [replace(group[0], changed=found)] if found else group
        if spent:
            return BatchEnd(time.perf_counter() - began, done, (), rest, spent)
        group, checked = [], time.perf_counter()
    if _place is not None:
        _place.board.write(Standing(None, math.inf))
    return BatchEnd(time.perf_counter() - began, done)


def _must_check() -> bool:
    return _place is not None and (_place.checks_each or _place.crashed)


def _checked(group: Sequence[int]) -> tuple[bool, tuple[str, ...] | None]:
    """Whether the process is spent after some items, and what was changed; None where it is open which item did so."""
    if _place is None:
        return False, ()
    if not _place.files.intact():
        # nothing can be delivered any more: the board says of which item the process ends
        _place.words.write_text("Fatal: the files that the worker process needs were closed\n")
        os._exit(FILES_CLOSED)
    found: Differences = _place.state.differences()
    spent = bool(found.lasting) or _place.crashed
    if len(group) > 1 and (found.names or generators_were_used(group[0])):
        _place.checks_each = True
        return spent, None
    return spent, found.names


def _attempt(task: Callable[[int], Result], item: int) -> Done[Result]:
    """Runs a task on one item."""
    if _place is None:
        return _outcome(task, item)
    _forget_output(_place.output)
    before, _place.item, _place.crashed = _place.item, item, False
    start_clock()
    done = _outcome(task, item)
    return replace(done, crashed=True, before=before) if _place.crashed else done


def _outcome(task: Callable[[int], Result], item: int) -> Done[Result]:
    try:
        return Done(item, task(item), None)
    except Exception as error:
        return Done(item, None, error)


def request_fresh_worker() -> None:
    """Has no further item run in this process: the one that is worked on crashed, and nobody knows what it left."""
    if _place is not None:
        _place.crashed = True


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
        _place.board.write(Standing(_place.item, time.monotonic() + grace_s))


def leave_note(text: str) -> None:
    """Leaves a text that the watcher finds where the task ends with its process; it replaces the one before."""
    if _place is not None:
        _place.note.write_text(text)


def settle() -> None:
    """Takes what is loaded by now for the state that items leave as it is.

    It is spared from every later search for garbage, which would cost some 5 % of short cases.
    """
    gc.collect()
    gc.freeze()
    if _place is not None:
        _place.state = ProcessState()


def limit_threads() -> None:
    """Keeps the numerical libraries that are loaded by now to one thread; the environment does so for later ones."""
    from threadpoolctl import threadpool_limits

    threadpool_limits(1)
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(1)
    if "numba" in sys.modules:
        sys.modules["numba"].set_num_threads(1)
