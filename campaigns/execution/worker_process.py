"""Code inside a worker process: setup, batches of items, and status (tasks: `marsyard.campaigns.execution.work`)."""

from __future__ import annotations

import faulthandler
import gc
import mmap
import os
import signal
import struct
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Generic

from marsyard.campaigns.execution import process_state
from marsyard.campaigns.execution.supervisor import DUMP_SIGNAL, become_supervised
from marsyard.campaigns.execution.work import Result, TaskResult

#: Linux's `oom_score_adj` of a worker (at most 1000): if memory runs out, workers are killed before their parent.
_OOM_SCORE = 800
#: Exit status of a worker after an item closed file descriptors that the worker needs.
FILES_CLOSED = 97
#: Layout of the status board: item, or `_NO_ITEM` between items.
_BOARD_LAYOUT = struct.Struct("=q")
_NO_ITEM = -1


@dataclass(frozen=True)
class BatchResult(Generic[Result]):
    """Results of a batch.

    - seconds: duration; results: results of the finished items; not_started: items that were not started
    - must_replace: whether the process must be replaced before the next item
    """

    seconds: float
    results: list[TaskResult[Result]]
    not_started: Sequence[int] = ()
    must_replace: bool = False


class StatusBoard:
    """Shared memory with the status of a worker, which its parent can read even if the worker hangs or has died.

    The status is the item that the worker runs, None between items.
    """

    def __init__(self, path: Path) -> None:
        with path.open("r+b") as file:
            self._bytes = mmap.mmap(file.fileno(), _BOARD_LAYOUT.size)

    @staticmethod
    def create(path: Path) -> StatusBoard:
        """Create the board of an idle worker."""
        path.write_bytes(_BOARD_LAYOUT.pack(_NO_ITEM))
        return StatusBoard(path)

    def write(self, item: int | None) -> None:
        """Publish the worker's status."""
        self._bytes[:] = _BOARD_LAYOUT.pack(_NO_ITEM if item is None else item)

    def read(self) -> int | None:
        """Read the worker's status; read until two readings agree, because the worker may be writing."""
        first = bytes(self._bytes)
        while (second := bytes(self._bytes)) != first:
            first = second
        (item,) = _BOARD_LAYOUT.unpack(first)
        return None if item == _NO_ITEM else int(item)

    def close(self) -> None:
        """Release the memory."""
        self._bytes.close()


@dataclass
class _WorkerContext:
    """Context of this worker process: status board, files, current item, and reference process state.

    - trace: file of the stack trace
    - output: descriptor of the output file
    - item, crashed: latest item, and whether it requested a fresh worker
    - is_repeatable: whether an earlier item may have caused the crash
    - files: open descriptors that an item must not close, with their identities
    """

    board: StatusBoard
    trace: Path
    output: int
    files: Mapping[int, process_state.FileIdentity]
    item: int | None = None
    state: process_state.ProcessState = field(default_factory=process_state.ProcessState)
    crashed: bool = False
    is_repeatable: bool = False


_context: _WorkerContext | None = None


def start_worker(parent: int, folder: str, all_workers_folder: str) -> None:
    """Set up a fresh worker process.

    - parent: process id of the parent
    - folder: folder of the files of this process
    - all_workers_folder: folder of all workers of the parent, see `become_supervised`

    The worker leads a process group below a supervisor (`marsyard.campaigns.execution.supervisor`), which ends with the
    parent and kills the worker's descendants. The worker writes its output, and its stack trace on a fatal signal, to
    files in `folder`.
    """
    from joblib.externals.loky import process_executor

    global _context
    os.setpgid(0, 0)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    output = os.open(Path(folder, "output"), os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o600)
    for stream in (1, 2):
        os.dup2(output, stream)
    become_supervised(parent, Path(all_workers_folder))
    if sys.platform == "linux":
        # this process is the fork of the supervisor, which called `setpgid` above: each leads a group of its own
        os.setpgid(0, 0)
        Path("/proc/self/oom_score_adj").write_text(str(_OOM_SCORE))
    trace = Path(folder, "trace")
    trace_descriptor = os.open(trace, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o600)
    faulthandler.enable(trace_descriptor)
    faulthandler.register(DUMP_SIGNAL, trace_descriptor, all_threads=False, chain=False)
    # loky would end workers that grow by 300 MB; cached terrains need more memory, and the parent enforces the limits
    process_executor._USE_PSUTIL = False
    board = StatusBoard(Path(folder, "board"))
    _context = _WorkerContext(board, trace, output, process_state.list_open_files())
    _context.board.write(None)


def load_task(_task: Callable[[int], object], load: Callable[[], object] | None, item: int) -> None:
    """Load the code of a task in this worker; a death of the process is attributed to `item`, the first item.

    `_task` is not called here. It is an argument because Python imports its modules when it unpickles the arguments.
    """
    if load is None:
        return
    if _context is not None:
        _context.board.write(item)
    load()
    if _context is not None:
        _context.board.write(None)


def run_batch(task: Callable[[int], Result], items: Sequence[int]) -> BatchResult[Result]:
    """Run a task on each item, until all are finished or the process must be replaced.

    The process must be replaced if an item changed its state (`ProcessState`), or requested it.
    """
    start_s = time.perf_counter()
    results: list[TaskResult[Result]] = []
    for item in items:
        process_state.seed_generators(item)
        result = _run_item(task, item)
        changed = _list_changes()
        results.append(replace(result, changed=changed))
        if changed or result.crashed:
            not_started = items[len(results) :]
            return BatchResult(time.perf_counter() - start_s, results, not_started, must_replace=True)
    if _context is not None:
        _context.board.write(None)
    return BatchResult(time.perf_counter() - start_s, results)


def _list_changes() -> tuple[str, ...]:
    """List the changes of the process state by an item; end the process if the item closed the worker's files."""
    if _context is None:
        return ()
    if any(process_state.file_identity(number) != identity for number, identity in _context.files.items()):
        # results can no longer be sent; the parent identifies the item by the status board
        _context.trace.write_text("Fatal: the files that the worker process needs were closed\n")
        os._exit(FILES_CLOSED)
    return _context.state.list_changes()


def _run_item(task: Callable[[int], Result], item: int) -> TaskResult[Result]:
    """Run a task on one item; the output file is truncated first, so that its size is that of the item's output."""
    previous_item = None
    if _context is not None:
        for stream in (sys.stdout, sys.stderr):
            if stream is not None and not stream.closed:
                stream.flush()
        if os.fstat(_context.output).st_size > 0:
            os.ftruncate(_context.output, 0)
        previous_item, _context.item = _context.item, item
        _context.crashed = _context.is_repeatable = False
        _context.board.write(item)
    try:
        result = TaskResult(item, task(item), None)
    except Exception as error:
        result = TaskResult(item, None, error)
    if _context is None or not _context.crashed:
        return result
    return replace(result, crashed=True, previous_item=previous_item if _context.is_repeatable else None)


def request_fresh_worker(*, is_repeatable: bool) -> None:
    """Request a fresh process for the next item, because the current item crashed and may have damaged the process.

    is_repeatable: whether an earlier item of the process may have caused the crash; the item then runs again
    """
    if _context is not None:
        _context.crashed, _context.is_repeatable = True, is_repeatable


def accept_process_state() -> None:
    """Use the current process state as the reference that items must preserve.

    Loaded objects are excluded from garbage collection, which would take 5 % of the run time of short cases.
    """
    gc.collect()
    gc.freeze()
    if _context is not None:
        _context.state = process_state.ProcessState()


def limit_threads() -> None:
    """Limit the loaded numerical libraries to one thread; environment variables limit libraries loaded later."""
    from threadpoolctl import threadpool_limits

    threadpool_limits(1)
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(1)
    if "numba" in sys.modules:
        sys.modules["numba"].set_num_threads(1)
