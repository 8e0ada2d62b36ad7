"""Tests of the isolation of cases: processes, threads and process state do not reach the next case."""

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

from marsyard.campaigns.errors import CRASHED, TIMED_OUT, WorkerExitError
from marsyard.campaigns.execution import worker_process
from marsyard.campaigns.execution.cases import make_unfinished_row
from marsyard.campaigns.execution.worker_process import TaskResult, Work, WorkLimits, request_fresh_worker
from marsyard.campaigns.execution.workers import LocalExecutor

pytestmark = pytest.mark.filterwarnings("ignore:Failed to kill subprocesses")

#: Maximum duration of runs that could wait forever, in seconds.
MAX_DURATION_S = 60.0

_held_objects: list[object] = []


def run_items(
    task: Callable[[int], Any], items: Iterable[int], limits: WorkLimits | None = None
) -> dict[int, TaskResult[Any]]:
    """Run items in one worker; return their results after the worker has ended."""
    with LocalExecutor(1) as workers:
        return {
            result.item: result
            for result in chain.from_iterable(workers.run(Work(task, items, limits or WorkLimits())))
        }


def is_gone(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except OSError:
        return True


def leave_running(kind: str, folder: str, item: int) -> int:
    """Start endless threads or processes in the first item and record the process ids."""
    processes = []
    if item == 0 and kind == "thread":
        threading.Thread(target=time.sleep, args=(3600,)).start()
    elif item == 0 and kind == "pool":
        pool = ProcessPoolExecutor(2, mp_context=get_context("fork"))
        processes = list(pool.map(get_process_id, range(2)))
        _held_objects.append(pool)
    elif item == 0 and kind == "fork":
        processes = [fork_sleeping_child()]
    elif item == 0 and kind == "session":
        child = subprocess.Popen(["sleep", "3600"], start_new_session=True, close_fds=False)
        processes = [child.pid]
        _held_objects.append(child)
    elif item == 0 and kind == "orphan":
        parent = os.fork()
        if parent == 0:
            Path(folder, "orphan").write_text(str(fork_sleeping_child()))
            os._exit(0)
        os.waitpid(parent, 0)
        processes = [int(Path(folder, "orphan").read_text())]
    if processes:
        Path(folder, "processes").write_text(" ".join(map(str, processes)))
    time.sleep(0.01)
    return os.getpid()


def get_process_id(_: int) -> int:
    time.sleep(0.1)
    return os.getpid()


def fork_sleeping_child() -> int:
    """Fork a child that keeps all open files, has its own session and sleeps."""
    child = os.fork()
    if child == 0:
        os.setsid()
        time.sleep(3600)
        os._exit(0)
    return child


@pytest.mark.parametrize("kind", ["thread", "pool", "fork", "session", "orphan"])
def test_processes_left_by_case_end_with_it(kind: str, tmp_path: Path) -> None:
    start_s = time.monotonic()
    results = run_items(partial(leave_running, kind, str(tmp_path)), range(3))
    assert time.monotonic() - start_s < MAX_DURATION_S
    started = tmp_path / "processes"
    processes = list(map(int, started.read_text().split())) if started.exists() else []
    assert len(processes) == {"thread": 0, "pool": 2}.get(kind, 1)
    assert all(map(is_gone, processes))
    # the next items run in another process
    assert results[1].result == results[2].result != results[0].result
    kind_of_task = "threads" if kind == "thread" else "child processes"
    assert f"{kind_of_task} that are still running" in results[0].changed[-1]
    assert results[1].changed == results[2].changed == ()


def wait_for_session(folder: str, item: int) -> int:
    if item == 1:
        child = subprocess.Popen(["sleep", "3600"], start_new_session=True, close_fds=False)
        Path(folder, "processes").write_text(str(child.pid))
        child.wait()
    return item


def test_child_in_own_session_respects_time_limit(tmp_path: Path) -> None:
    start_s = time.monotonic()
    results = run_items(partial(wait_for_session, str(tmp_path)), range(4), WorkLimits(time_s=2.0))
    assert time.monotonic() - start_s < MAX_DURATION_S
    error = results[1].error
    assert isinstance(error, WorkerExitError)
    assert error.outcome == TIMED_OUT
    assert " in wait_for_session" in error.trace
    assert {item: result.result for item, result in results.items() if item != 1} == {0: 0, 2: 2, 3: 3}
    assert is_gone(int((tmp_path / "processes").read_text()))


def signal_supervisor(kind: int, folder: str, item: int) -> int:
    if item == 1:
        Path(folder, "processes").write_text(str(fork_sleeping_child()))
        os.kill(os.getppid(), kind)
        time.sleep(3600)
    return item


@pytest.mark.parametrize("kind", [signal.SIGKILL, signal.SIGSTOP])
def test_signal_to_supervisor_ends_only_the_case(kind: int, tmp_path: Path) -> None:
    start_s = time.monotonic()
    results = run_items(partial(signal_supervisor, kind, str(tmp_path)), range(3), WorkLimits(time_s=2.0))
    assert time.monotonic() - start_s < MAX_DURATION_S
    error = results[1].error
    assert isinstance(error, WorkerExitError)
    assert error.outcome == (CRASHED if kind == signal.SIGKILL else TIMED_OUT)
    assert (results[0].result, results[2].result) == (0, 2)
    assert is_gone(int((tmp_path / "processes").read_text()))


def overwrite_board(item: int) -> int:
    """Write 1 into every field of the status board, including process ids."""
    assert worker_process._context is not None
    board = worker_process._context.board._bytes
    board[:] = struct.pack("=q", 1) * (len(board) // 8)
    time.sleep(3600)
    return item


def test_only_executor_processes_are_signalled(monkeypatch: pytest.MonkeyPatch) -> None:
    signalled = []
    kill = os.kill

    def record_and_kill(process: int, number: int) -> None:
        signalled.append(process)
        if process > 1:
            kill(process, number)

    monkeypatch.setattr("os.kill", record_and_kill)
    monkeypatch.setattr("os.killpg", lambda group, number: record_and_kill(group, number))
    with LocalExecutor(1) as workers:
        (batch,) = workers.run(Work(overwrite_board, [1], WorkLimits(time_s=3.0)))
        worker = workers._workers[0]
        assert isinstance(batch[0].error, WorkerExitError)
        assert batch[0].error.outcome == TIMED_OUT
    assert worker is not None
    assert signalled
    assert min(signalled) > 1


STATE_CHANGES = {
    "the working folder": lambda: os.chdir("/"),
    "environment variables": lambda: os.environ.update(LEFT_BEHIND="1"),
    "sys.path": lambda: sys.path.insert(0, "/nowhere"),
    "the warning filters": lambda: warnings.simplefilter("ignore"),
    "NumPy's error handling (numpy.seterr)": lambda: np.seterr(all="ignore"),
    "the file mode mask (umask)": lambda: os.umask(0o077),
    "the recursion limit": lambda: sys.setrecursionlimit(2345),
    "OpenCV's settings (optimised code, threads)": lambda: __import__("cv2").setUseOptimized(False),
    # 0x800 and 0x400 are upwards and downwards on x86; 0x400000 is on ARM
    "the floating-point rounding mode": lambda: [
        ctypes.CDLL("libm.so.6").fesetround(mode) for mode in (0x800, 0x400000)
    ],
    "handlers of signals, or timers": lambda: signal.signal(signal.SIGUSR1, signal.SIG_IGN),
}


def read_state() -> tuple[object, ...]:
    import cv2

    unity, little = float("1"), 2.0**-60
    return (
        Path.cwd(),
        dict(os.environ),
        list(sys.path),
        list(warnings.filters),
        np.geterr(),
        sys.getrecursionlimit(),
        cv2.useOptimized(),
        unity + little,
        signal.getsignal(signal.SIGUSR1),
        random.random(),  # noqa: S311
        np.random.random_sample(),  # noqa: NPY002
    )


def read_and_change_state(seconds: float, item: int) -> object:
    """Return the process state; odd items then change one part of it."""
    process_state = read_state()
    if item % 2:
        changes: list[Any] = list(STATE_CHANGES.values())
        changes[item // 2]()
    time.sleep(seconds)
    # values of environment variables depend on the worker's folder; compare their names
    return item, [part for part in process_state if not isinstance(part, dict)], sorted(set(process_state[1]))  # type: ignore[call-overload]


@pytest.mark.parametrize("seconds", [0.01, 0.0])
def test_process_state_does_not_reach_next_case(seconds: float) -> None:
    """The check also holds for short cases that run in one batch."""
    number = 2 * len(STATE_CHANGES)
    run_results = run_items(partial(read_and_change_state, seconds), range(number))
    results: list[Any] = [run_results[item].result for item in range(number)]
    # the last two entries are random numbers: they depend on the case, not on the worker
    assert len({str((result[1][:-2], result[2])) for result in results}) == 1
    assert len({str(result[1][-2:]) for result in results}) == number
    for position, name in enumerate(STATE_CHANGES):
        assert run_results[2 * position].changed == ()
        assert run_results[2 * position + 1].changed == (name,)
    single_result: Any = run_items(partial(read_and_change_state, 0.01), [5])[5].result
    assert results[5][1][-2:] == single_result[1][-2:]


def import_and_alter(folder: Path, item: int) -> tuple[str | None, ...]:
    """Return environment variables; the first case then changes them, directly and by importing a module."""
    variables = (os.environ.get("SET_BY_MODULE"), os.environ.get("LEFT_BEHIND"), os.environ.get("HOME"))
    if item == 0:
        os.environ["LEFT_BEHIND"] = "1"
        sys.path.append(str(folder))
        __import__("changes_environment")
        del os.environ["HOME"]
    return variables


def test_environment_is_restored_after_import_in_case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/somewhere")
    (tmp_path / "changes_environment.py").write_text("import os\nos.environ['SET_BY_MODULE'] = 'yes'\n")
    results = run_items(partial(import_and_alter, tmp_path), range(3))
    assert results[0].changed == ("environment variables", "sys.path")
    assert [results[item].result for item in (1, 2)] == [("yes", None, "/somewhere")] * 2


def crash_after_other_case(item: int) -> int:
    """Change state that is not compared between cases; the next case in this worker then crashes."""
    if item in _held_objects or item == 3:
        request_fresh_worker()
        return -1
    _held_objects.append(item + 1)
    time.sleep(0.01)
    return item


def test_crash_after_other_case_is_repeated_in_fresh_worker() -> None:
    _held_objects.clear()
    results = run_items(crash_after_other_case, range(5))
    assert {item: result.result for item, result in results.items()} == {0: 0, 1: 1, 2: 2, 3: -1, 4: 4}
    # crashed_only_after names the earlier case; case 3 crashes in a fresh worker too
    assert [results[item].crashed_only_after for item in range(5)] == [None, 0, 1, None, None]
    assert [results[item].crashed for item in range(5)] == [False, False, False, True, False]


def close_files(item: int) -> int:
    if item == 1:
        os.closerange(3, 1024)
    return item


def test_closing_worker_files_crashes_only_that_case() -> None:
    results = run_items(close_files, range(4))
    assert str(results[1].error) == "the case closed or replaced the worker's file descriptors"
    assert {item: result.result for item, result in results.items() if item != 1} == {0: 0, 2: 2, 3: 3}


def share_memory(item: int) -> int:
    """Allocate 100 MB and fork four children that share the pages without writing."""
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


def test_memory_shared_by_forked_children_counts_once() -> None:
    results = run_items(share_memory, [0], WorkLimits(memory_bytes=0.3e9))
    assert results[0].error is None
    assert results[0].result == 1


def test_long_error_texts_keep_both_ends() -> None:
    row = make_unfinished_row(0, CRASHED, "begin" + "x" * 200_000 + "end", "first" + "y" * 200_000 + "last")
    for column, head, tail in (("error", "begin", "end"), ("traceback", "first", "last")):
        text = str(row[column])
        assert len(text) < 8_100
        assert text.startswith(head)
        assert text.endswith(tail)
        assert "characters omitted" in text
    assert make_unfinished_row(0, CRASHED, "short", "")["error"] == "short"
