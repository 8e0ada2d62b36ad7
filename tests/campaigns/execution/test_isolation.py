"""A case leaves nothing behind: no process, no thread, no changed state of the process that the next one runs in."""

from __future__ import annotations

import ctypes
import os
import random
import signal
import struct
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import chain
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marsyard.campaigns.errors import CRASHED, TIMED_OUT, CaseEndedError
from marsyard.campaigns.execution import worker_process
from marsyard.campaigns.execution.cases import make_unfinished_row
from marsyard.campaigns.execution.worker_process import TaskResult, Work, WorkLimits, request_fresh_worker
from marsyard.campaigns.execution.workers import LocalExecutor

pytestmark = pytest.mark.filterwarnings("ignore:Failed to kill subprocesses")

#: Seconds within which everything ends that once waited for ever.
GUARD_S = 60.0

_kept: list[object] = []


def run(
    task: Callable[[int], Any], items: Iterable[int], limits: WorkLimits | None = None
) -> dict[int, TaskResult[Any]]:
    """What became of items in one worker, which has ended by the time of the return."""
    with LocalExecutor(1) as workers:
        return {done.item: done for done in chain.from_iterable(workers.run(Work(task, items, limits or WorkLimits())))}


def is_gone(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except OSError:
        return True


def leave_running(kind: str, folder: str, item: int) -> int:
    """Starts something in the first item that would never end, and notes its processes."""
    processes = []
    if item == 0 and kind == "thread":
        threading.Thread(target=time.sleep, args=(3600,)).start()
    elif item == 0 and kind == "pool":
        pool = ProcessPoolExecutor(2, mp_context=get_context("fork"))
        processes = list(pool.map(process_number, range(2)))
        _kept.append(pool)
    elif item == 0 and kind == "fork":
        processes = [forked()]
    elif item == 0 and kind == "session":
        child = subprocess.Popen(["sleep", "3600"], start_new_session=True, close_fds=False)
        processes = [child.pid]
        _kept.append(child)
    elif item == 0 and kind == "orphan":
        middle = os.fork()
        if middle == 0:
            Path(folder, "orphan").write_text(str(forked()))
            os._exit(0)
        os.waitpid(middle, 0)
        processes = [int(Path(folder, "orphan").read_text())]
    if processes:
        Path(folder, "processes").write_text(" ".join(map(str, processes)))
    time.sleep(0.01)
    return os.getpid()


def process_number(_: int) -> int:
    time.sleep(0.1)
    return os.getpid()


def forked() -> int:
    """A child that holds all files of this process, leads a session of its own and sleeps."""
    child = os.fork()
    if child == 0:
        os.setsid()
        time.sleep(3600)
        os._exit(0)
    return child


@pytest.mark.parametrize("kind", ["thread", "pool", "fork", "session", "orphan"])
def test_processes_left_by_a_case_neither_delay_its_end_nor_outlive_it(kind: str, tmp_path: Path) -> None:
    began = time.monotonic()
    done = run(partial(leave_running, kind, str(tmp_path)), range(3))
    assert time.monotonic() - began < GUARD_S
    started = tmp_path / "processes"
    processes = list(map(int, started.read_text().split())) if started.exists() else []
    assert len(processes) == {"thread": 0, "pool": 2}.get(kind, 1)
    assert all(map(is_gone, processes))
    # the next items run in another process
    assert done[1].result == done[2].result != done[0].result
    what = "threads" if kind == "thread" else "child processes"
    assert f"{what} that it left running" in done[0].changed[-1]
    assert done[1].changed == done[2].changed == ()


def wait_for_session(folder: str, item: int) -> int:
    if item == 1:
        child = subprocess.Popen(["sleep", "3600"], start_new_session=True, close_fds=False)
        Path(folder, "processes").write_text(str(child.pid))
        child.wait()
    return item


def test_a_child_in_a_session_of_its_own_does_not_defeat_the_time_limit(tmp_path: Path) -> None:
    began = time.monotonic()
    done = run(partial(wait_for_session, str(tmp_path)), range(4), WorkLimits(time_s=2.0))
    assert time.monotonic() - began < GUARD_S
    error = done[1].error
    assert isinstance(error, CaseEndedError)
    assert error.outcome == TIMED_OUT
    assert " in wait_for_session" in error.trace
    assert {item: one.result for item, one in done.items() if item != 1} == {0: 0, 2: 2, 3: 3}
    assert is_gone(int((tmp_path / "processes").read_text()))


def harm_supervisor(kind: int, folder: str, item: int) -> int:
    if item == 1:
        Path(folder, "processes").write_text(str(forked()))
        os.kill(os.getppid(), kind)
        time.sleep(3600)
    return item


@pytest.mark.parametrize("kind", [signal.SIGKILL, signal.SIGSTOP])
def test_a_case_that_kills_or_stops_its_parent_ends_alone(kind: int, tmp_path: Path) -> None:
    began = time.monotonic()
    done = run(partial(harm_supervisor, kind, str(tmp_path)), range(3), WorkLimits(time_s=2.0))
    assert time.monotonic() - began < GUARD_S
    error = done[1].error
    assert isinstance(error, CaseEndedError)
    assert error.outcome == (CRASHED if kind == signal.SIGKILL else TIMED_OUT)
    assert (done[0].result, done[2].result) == (0, 2)
    assert is_gone(int((tmp_path / "processes").read_text()))


def scribble(item: int) -> int:
    """Writes a one into every field of what the worker shows its watcher, a process id where there is one."""
    assert worker_process._context is not None
    board = worker_process._context.board._bytes
    board[:] = struct.pack("=q", 1) * (len(board) // 8)
    time.sleep(3600)
    return item


def test_only_processes_of_the_executor_are_signalled(monkeypatch: pytest.MonkeyPatch) -> None:
    signalled = []
    kill = os.kill

    def note(process: int, number: int) -> None:
        signalled.append(process)
        if process > 1:
            kill(process, number)

    monkeypatch.setattr("os.kill", note)
    monkeypatch.setattr("os.killpg", lambda group, number: note(group, number))
    with LocalExecutor(1) as workers:
        (batch,) = workers.run(Work(scribble, [1], WorkLimits(time_s=3.0)))
        known = workers._workers[0]
        assert isinstance(batch[0].error, CaseEndedError)
        assert batch[0].error.outcome == TIMED_OUT
    assert known is not None
    assert signalled
    assert min(signalled) > 1


STATE = {
    "the working folder": lambda: os.chdir("/"),
    "environment variables": lambda: os.environ.update(LEFT_BEHIND="1"),
    "sys.path": lambda: sys.path.insert(0, "/nowhere"),
    "the filters of warnings": lambda: warnings.simplefilter("ignore"),
    "NumPy's handling of errors (numpy.seterr)": lambda: np.seterr(all="ignore"),
    "the mask of new files (umask)": lambda: os.umask(0o077),
    "the limit of recursion": lambda: sys.setrecursionlimit(2345),
    "OpenCV's settings (optimised code, threads)": lambda: __import__("cv2").setUseOptimized(False),
    # 0x800 and 0x400 are upwards and downwards on x86; 0x400000 is on ARM
    "the arithmetic of floating-point numbers (rounding)": lambda: [
        ctypes.CDLL("libm.so.6").fesetround(mode) for mode in (0x800, 0x400000)
    ],
    "handlers of signals, or timers": lambda: signal.signal(signal.SIGUSR1, signal.SIG_IGN),
}


def state() -> tuple[object, ...]:
    import cv2

    one, little = float("1"), 2.0**-60
    return (
        Path.cwd(),
        dict(os.environ),
        list(sys.path),
        list(warnings.filters),
        np.geterr(),
        sys.getrecursionlimit(),
        cv2.useOptimized(),
        one + little,
        signal.getsignal(signal.SIGUSR1),
        random.random(),  # noqa: S311
        np.random.random_sample(),  # noqa: NPY002
    )


def alter(seconds: float, item: int) -> object:
    """What the process is like; then changes one part of it, in every second item."""
    seen = state()
    if item % 2:
        changes: list[Any] = list(STATE.values())
        changes[item // 2]()
    time.sleep(seconds)
    # the environment differs by the worker's folder
    return item, [part for part in seen if not isinstance(part, dict)], sorted(set(seen[1]))  # type: ignore[call-overload]


@pytest.mark.parametrize("seconds", [0.01, 0.0])
def test_state_of_the_process_does_not_reach_the_next_case(seconds: float) -> None:
    """Also where cases are so short that several are checked at once."""
    number = 2 * len(STATE)
    done = run(partial(alter, seconds), range(number))
    results: list[Any] = [done[item].result for item in range(number)]
    # the last two are random numbers, which a case draws alike wherever it runs, and not as another case does
    assert len({str((one[1][:-2], one[2])) for one in results}) == 1
    assert len({str(one[1][-2:]) for one in results}) == number
    for place, name in enumerate(STATE):
        assert done[2 * place].changed == ()
        assert done[2 * place + 1].changed == (name,)
    alone: Any = run(partial(alter, 0.01), [5])[5].result
    assert results[5][1][-2:] == alone[1][-2:]


def import_and_alter(folder: Path, item: int) -> tuple[str | None, ...]:
    """The environment as the case finds it; the first case imports a module that changes it, and changes it itself."""
    found = (os.environ.get("SET_BY_MODULE"), os.environ.get("LEFT_BEHIND"), os.environ.get("HOME"))
    if item == 0:
        os.environ["LEFT_BEHIND"] = "1"
        sys.path.append(str(folder))
        __import__("changes_environment")
        del os.environ["HOME"]
    return found


def test_a_case_that_also_imports_a_module_does_not_reach_the_next_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", "/somewhere")
    (tmp_path / "changes_environment.py").write_text("import os\nos.environ['SET_BY_MODULE'] = 'yes'\n")
    done = run(partial(import_and_alter, tmp_path), range(3))
    assert done[0].changed == ("environment variables", "sys.path")
    assert [done[item].result for item in (1, 2)] == [("yes", None, "/somewhere")] * 2


def crash_where_spoiled(item: int) -> int:
    """What a case alters that nobody compares makes the next one fail."""
    if item in _kept or item == 3:
        request_fresh_worker()
        return -1
    _kept.append(item + 1)
    time.sleep(0.01)
    return item


def test_a_case_that_crashes_after_another_is_run_again_in_a_fresh_worker() -> None:
    _kept.clear()
    done = run(crash_where_spoiled, range(5))
    assert {item: one.result for item, one in done.items()} == {0: 0, 1: 1, 2: 2, 3: -1, 4: 4}
    # those whose crash was another's doing say whose; the one that crashes by itself does so
    assert [done[item].spoiled_by for item in range(5)] == [None, 0, 1, None, None]
    assert [done[item].crashed for item in range(5)] == [False, False, False, True, False]


def close_files(item: int) -> int:
    if item == 1:
        os.closerange(3, 1024)
    return item


def test_a_case_that_closes_the_files_of_its_worker_crashes_alone() -> None:
    done = run(close_files, range(4))
    assert str(done[1].error) == "the case closed or replaced the worker's file descriptors"
    assert {item: one.result for item, one in done.items() if item != 1} == {0: 0, 2: 2, 3: 3}


def share_memory(item: int) -> int:
    """100 MB, of which four children have their copies, never written to."""
    block = np.ones(100_000_000, dtype=np.uint8)
    children = []
    for _ in range(4):
        if (child := os.fork()) == 0:
            time.sleep(1.5)
            os._exit(0)
        children.append(child)
    for child in children:
        os.waitpid(child, 0)
    return int(block[item])


def test_memory_that_forked_children_share_counts_once() -> None:
    done = run(share_memory, [0], WorkLimits(memory_bytes=0.3e9))
    assert done[0].error is None
    assert done[0].result == 1


def test_long_texts_of_errors_keep_their_beginning_and_their_end() -> None:
    row = make_unfinished_row(0, CRASHED, "begin" + "x" * 200_000 + "end", "first" + "y" * 200_000 + "last")
    for column, head, tail in (("error", "begin", "end"), ("traceback", "first", "last")):
        text = str(row[column])
        assert len(text) < 8_100
        assert text.startswith(head)
        assert text.endswith(tail)
        assert "characters left out" in text
    assert make_unfinished_row(0, CRASHED, "short", "")["error"] == "short"
