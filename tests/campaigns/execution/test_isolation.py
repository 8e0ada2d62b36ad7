"""Tests of the isolation of cases: processes, threads and changed process state do not affect the next case."""

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
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marsyard.campaigns.execution import worker_process
from marsyard.campaigns.execution.case_rows import make_unfinished_row
from marsyard.campaigns.execution.work import Work, WorkLimits
from marsyard.campaigns.execution.worker_process import request_fresh_worker
from marsyard.campaigns.execution.workers import LocalExecutor
from marsyard.campaigns.outcomes import CRASHED, TIMED_OUT
from tests.campaigns.execution.items import (
    MAX_DURATION_S,
    get_process_id,
    has_ended,
    list_results,
    read_exit,
    run_items,
)

#: State that remains in the worker process after an item, such as references to running processes.
_worker_state: list[object] = []


def start_endless_tasks(kind: str, folder: str, item: int) -> int:
    """In item 0, start endless threads or processes and write their process ids to a file; return this process's id.

    Kinds: a thread; a pool of two processes; a forked child; a child in a separate session; an orphan, which is a
    child whose parent has ended.
    """
    processes = []
    if item == 0 and kind == "thread":
        threading.Thread(target=time.sleep, args=(3600,)).start()
    elif item == 0 and kind == "pool":
        pool = ProcessPoolExecutor(2, mp_context=get_context("fork"))
        processes = list(pool.map(get_process_id, range(2)))
        _worker_state.append(pool)
    elif item == 0 and kind == "fork":
        processes = [fork_sleeping_child()]
    elif item == 0 and kind == "session":
        child = subprocess.Popen(["sleep", "3600"], start_new_session=True, close_fds=False)
        processes = [child.pid]
        _worker_state.append(child)
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


def fork_sleeping_child() -> int:
    """Fork a child that keeps all open files, has its own session and sleeps."""
    child = os.fork()
    if child == 0:
        os.setsid()
        time.sleep(3600)
        os._exit(0)
    return child


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["thread", "pool", "fork", "session", "orphan"])
def test_processes_started_by_a_case_end_with_the_case(kind: str, tmp_path: Path) -> None:
    start_s = time.monotonic()
    results = run_items(partial(start_endless_tasks, kind, str(tmp_path)), range(3))
    assert time.monotonic() - start_s < MAX_DURATION_S
    id_file = tmp_path / "processes"
    processes = list(map(int, id_file.read_text().split())) if id_file.exists() else []
    assert len(processes) == {"thread": 0, "pool": 2}.get(kind, 1)
    assert all(map(has_ended, processes))
    # the next items run in another process
    assert results[1].result == results[2].result != results[0].result
    leftovers = "threads" if kind == "thread" else "child processes"
    assert f"{leftovers} that are still running" in results[0].changed[-1]
    assert results[1].changed == results[2].changed == ()


def wait_for_child_in_new_session(folder: str, item: int) -> int:
    if item == 1:
        child = subprocess.Popen(["sleep", "3600"], start_new_session=True, close_fds=False)
        Path(folder, "processes").write_text(str(child.pid))
        child.wait()
    return item


def test_time_limit_ends_child_in_separate_session(tmp_path: Path) -> None:
    start_s = time.monotonic()
    results = run_items(partial(wait_for_child_in_new_session, str(tmp_path)), range(4), WorkLimits(time_s=2.0))
    assert time.monotonic() - start_s < MAX_DURATION_S
    error = read_exit(results[1])
    assert (error.outcome, " in wait_for_child_in_new_session" in error.trace) == (TIMED_OUT, True)
    assert list_results(results) == {0: 0, 2: 2, 3: 3}
    assert has_ended(int((tmp_path / "processes").read_text()))


def signal_supervisor(signal_number: int, folder: str, item: int) -> int:
    """Fork a child and send a signal to the parent of the worker process in item 1."""
    if item == 1:
        Path(folder, "processes").write_text(str(fork_sleeping_child()))
        os.kill(os.getppid(), signal_number)
        time.sleep(3600)
    return item


@pytest.mark.slow
@pytest.mark.parametrize("signal_number", [signal.SIGKILL, signal.SIGSTOP])
def test_signal_to_supervisor_ends_only_the_case(signal_number: int, tmp_path: Path) -> None:
    start_s = time.monotonic()
    results = run_items(partial(signal_supervisor, signal_number, str(tmp_path)), range(3), WorkLimits(time_s=2.0))
    assert time.monotonic() - start_s < MAX_DURATION_S
    assert read_exit(results[1]).outcome == (CRASHED if signal_number == signal.SIGKILL else TIMED_OUT)
    assert list_results(results) == {0: 0, 2: 2}
    assert has_ended(int((tmp_path / "processes").read_text()))


def overwrite_board(item: int) -> int:
    """Write the integer 1 into all fields of the status board (shared memory: item of the worker)."""
    board = worker_process._context.board._bytes
    board[:] = struct.pack("=q", 1) * (len(board) // 8)
    time.sleep(3600)
    return item


@pytest.mark.slow
def test_status_board_written_by_a_case_is_not_used_as_process_ids(monkeypatch: pytest.MonkeyPatch) -> None:
    signalled_processes = []
    kill = os.kill

    def record_and_kill(process: int, signal_number: int) -> None:
        signalled_processes.append(process)
        if process > 1:
            kill(process, signal_number)

    monkeypatch.setattr("os.kill", record_and_kill)
    monkeypatch.setattr("os.killpg", lambda group, signal_number: record_and_kill(group, signal_number))
    with LocalExecutor(1) as workers:
        (batch,) = workers.run(Work(overwrite_board, [1], WorkLimits(time_s=3.0)))
        worker = workers._workers[0]
        assert read_exit(batch[0]).outcome == TIMED_OUT
    assert worker is not None
    assert signalled_processes
    assert min(signalled_processes) > 1  # the value on the board is not signalled


#: Changes of the process state, by their description in the notes of a campaign.
STATE_CHANGES = {
    "the working folder": lambda: os.chdir("/"),
    "environment variables": lambda: os.environ.update(SET_BY_CASE="1"),
    "sys.path": lambda: sys.path.insert(0, "/nowhere"),
    "the warning filters": lambda: warnings.simplefilter("ignore"),
    "NumPy's error handling (numpy.seterr)": lambda: np.seterr(all="ignore"),
    "the recursion limit": lambda: sys.setrecursionlimit(2345),
    "OpenCV's state (optimised code, threads)": lambda: __import__("cv2").setUseOptimized(False),
    # 0x800 and 0x400 are upwards and downwards on x86; 0x400000 is on ARM
    "the floating-point rounding mode": lambda: [
        ctypes.CDLL("libm.so.6").fesetround(mode) for mode in (0x800, 0x400000)
    ],
    "handlers of signals, or timers": lambda: signal.signal(signal.SIGUSR1, signal.SIG_IGN),
}


def read_state() -> tuple[object, ...]:
    """Return the parts of the process state that a case can change, and two random numbers."""
    import cv2

    # the rounding mode decides whether this sum is 1; float("1") prevents evaluation at compile time
    rounded_sum = float("1") + 2.0**-60
    return (
        Path.cwd(),
        dict(os.environ),
        list(sys.path),
        list(warnings.filters),
        np.geterr(),
        sys.getrecursionlimit(),
        cv2.useOptimized(),
        rounded_sum,
        signal.getsignal(signal.SIGUSR1),
        random.random(),  # noqa: S311
        np.random.random_sample(),  # noqa: NPY002
    )


def read_and_change_state(item: int) -> object:
    """Return the process state; odd items then change one part of it."""
    process_state = read_state()
    if item % 2:
        changes: list[Any] = list(STATE_CHANGES.values())
        changes[item // 2]()
    # values of environment variables depend on the worker's folder; compare their names
    return item, [part for part in process_state if not isinstance(part, dict)], sorted(set(process_state[1]))  # type: ignore[call-overload]


@pytest.mark.slow
def test_next_case_has_the_state_of_a_fresh_worker() -> None:
    n_items = 2 * len(STATE_CHANGES)
    run_results = run_items(read_and_change_state, range(n_items))
    results: list[Any] = [run_results[item].result for item in range(n_items)]
    # the last two entries are random numbers: they depend on the case, not on the worker
    assert len({str((result[1][:-2], result[2])) for result in results}) == 1
    assert len({str(result[1][-2:]) for result in results}) == n_items
    for position, name in enumerate(STATE_CHANGES):
        assert run_results[2 * position].changed == ()
        assert run_results[2 * position + 1].changed == (name,)
    single_result: Any = run_items(read_and_change_state, [5])[5].result
    assert results[5][1][-2:] == single_result[1][-2:]


def change_environment(folder: Path, item: int) -> tuple[str | None, ...]:
    """Return environment variables; item 0 then imports a module that sets one, and item 1 changes two."""
    variables = (os.environ.get("SET_BY_MODULE"), os.environ.get("SET_BY_CASE"), os.environ.get("HOME"))
    if item == 0:
        sys.path.insert(0, str(folder))
        __import__("changes_environment")
        sys.path.remove(str(folder))
    elif item == 1:
        os.environ["SET_BY_CASE"] = "1"
        del os.environ["HOME"]
    return variables


def test_import_in_a_case_is_no_change_by_the_case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/somewhere")
    (tmp_path / "changes_environment.py").write_text("import os\nos.environ['SET_BY_MODULE'] = 'yes'\n")
    results = run_items(partial(change_environment, tmp_path), range(3))
    assert [results[item].changed for item in range(3)] == [(), ("environment variables",), ()]
    # item 1 runs in the worker of item 0, and item 2 in a fresh one, which has not imported the module
    assert [results[item].result for item in (1, 2)] == [("yes", None, "/somewhere"), (None, None, "/somewhere")]


def crash_after_other_case(is_repeatable: bool, item: int) -> int:
    """Report a crash if the previous item ran in this process, or in item 3. `_worker_state` is not restored."""
    if item in _worker_state or item == 3:
        request_fresh_worker(is_repeatable=is_repeatable)  # marks the item as crashed
        return -1
    _worker_state.append(item + 1)
    time.sleep(0.01)
    return item


@pytest.mark.slow
def test_crash_after_other_case_is_repeated_in_fresh_worker() -> None:
    _worker_state.clear()
    results = run_items(partial(crash_after_other_case, True), range(5))
    assert list_results(results) == {0: 0, 1: 1, 2: 2, 3: -1, 4: 4}
    assert [results[item].attempts for item in range(5)] == [1, 2, 2, 2, 1]
    # crashed_only_after names the earlier case; case 3 crashes in a fresh worker too
    assert [results[item].crashed_only_after for item in range(5)] == [None, 0, 1, None, None]
    assert [results[item].crashed for item in range(5)] == [False, False, False, True, False]


def test_crash_of_the_algorithm_is_final() -> None:
    _worker_state.clear()
    results = run_items(partial(crash_after_other_case, False), range(5))
    # the worker is replaced after each crash
    assert list_results(results) == {0: 0, 1: -1, 2: 2, 3: -1, 4: 4}
    assert {(result.attempts, result.crashed_only_after) for result in results.values()} == {(1, None)}


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


@pytest.mark.slow
def test_memory_shared_by_forked_children_is_counted_once() -> None:
    # five processes with 100 MB each would exceed 0.3 GB if shared pages counted five times
    results = run_items(share_memory, [0], WorkLimits(memory_bytes=0.3e9))
    assert list_results(results) == {0: 1}


def test_long_error_texts_are_shortened_in_the_middle() -> None:
    row = make_unfinished_row(0, CRASHED, "begin" + "x" * 200_000 + "end", "first" + "y" * 200_000 + "last")
    for column, first_text, last_text in (("error", "begin", "end"), ("traceback", "first", "last")):
        text = str(row[column])
        # 8000 characters of text, and a line with the number of omitted characters
        assert len(text) < 8_100
        assert text.startswith(first_text)
        assert text.endswith(last_text)
        assert "characters omitted" in text
    assert make_unfinished_row(0, CRASHED, "short", "")["error"] == "short"
