"""Tests of time limits: the parent measures them, and a suspended process is no case that takes too long."""

import os
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from marsyard.algorithms.processes import descendants
from marsyard.campaigns.execution import worker_process
from marsyard.campaigns.execution.monitoring import BatchClock
from marsyard.campaigns.execution.work import TaskResult, Work, WorkLimits
from marsyard.campaigns.execution.workers import LocalExecutor
from marsyard.campaigns.outcomes import TIMED_OUT, WorkerExitError
from tests.campaigns.execution.items import list_results, run_items


def is_timed_out(result: TaskResult[Any]) -> bool:
    return isinstance(result.error, WorkerExitError) and result.error.outcome == TIMED_OUT


def sleep_after_start(folder: str, seconds: float, item: int) -> int:
    """Append the process id to the file of the item, then sleep in steps, which do not pass in a stopped process."""
    with Path(folder, str(item)).open("a") as file:
        file.write(f"{os.getpid()}\n")
    for _ in range(round(seconds / 0.05)):
        time.sleep(0.05)
    return item


def read_starts(folder: Path, item: int) -> list[int]:
    """Return the process id of each start of an item."""
    path = folder / str(item)
    return [int(line) for line in path.read_text().splitlines()] if path.exists() else []


def wait_for_start(folder: Path, item: int, max_s: float = 60.0) -> int:
    """Wait until an item runs; return its process."""
    deadline_s = time.monotonic() + max_s
    while not (starts := read_starts(folder, item)) and time.monotonic() < deadline_s:
        time.sleep(0.02)
    return starts[0]


@contextmanager
def suspend_once(folder: Path, item: int, seconds: float) -> Iterator[None]:
    """Stop the process of an item for some seconds, once."""

    def suspend() -> None:
        process = wait_for_start(folder, item)
        os.kill(process, signal.SIGSTOP)
        time.sleep(seconds)
        try:
            os.kill(process, signal.SIGCONT)
        except ProcessLookupError:
            return  # the parent has replaced the worker

    thread = threading.Thread(target=suspend)
    thread.start()
    yield
    thread.join()


def test_suspended_worker_repeats_its_case(tmp_path: Path) -> None:
    """The worker is stopped for 3 s, longer than the limit of 1.5 s of a case that takes 0.5 s."""
    with suspend_once(tmp_path, 1, 3.0):
        results = run_items(partial(sleep_after_start, str(tmp_path), 0.5), range(3), WorkLimits(1.5))
    assert list_results(results) == {0: 0, 1: 1, 2: 2}
    first, second = read_starts(tmp_path, 1)
    assert first != second
    assert results[1].attempts == 2


def test_case_that_is_too_slow_without_suspension_runs_once(tmp_path: Path) -> None:
    results = run_items(partial(sleep_after_start, str(tmp_path), 3600.0), [1], WorkLimits(1.0))
    assert is_timed_out(results[1])
    assert len(read_starts(tmp_path, 1)) == 1


def stop_itself(folder: str, item: int) -> int:
    sleep_after_start(folder, 0.0, item)
    if item == 1:
        os.kill(os.getpid(), signal.SIGSTOP)
    return item


def test_case_that_stops_itself_is_timed_out(tmp_path: Path) -> None:
    start_s = time.monotonic()
    results = run_items(partial(stop_itself, str(tmp_path)), range(3), WorkLimits(1.0), total=3)
    assert is_timed_out(results[1])
    assert list_results(results) == {0: 0, 2: 2}
    assert len(read_starts(tmp_path, 1)) == 2
    # two attempts of 1 s, and the starts of three workers
    assert time.monotonic() - start_s < 30.0


PROGRAM = """
import sys
from functools import partial
from tests.campaigns.execution.test_limits import WorkLimits, run_items, sleep_after_start
results = run_items(partial(sleep_after_start, sys.argv[1], 1.0), range(3), WorkLimits(2.0))
print(*(f"{item}:{result.result}:{result.error}" for item, result in sorted(results.items())))
"""


@pytest.mark.slow
@pytest.mark.parametrize("with_workers", [True, False])
def test_suspended_parent_ends_no_case(tmp_path: Path, with_workers: bool) -> None:
    """The parent, alone or with its workers (a closed laptop), is stopped for 4 s; the limit of a case is 2 s."""
    process = subprocess.Popen([sys.executable, "-c", PROGRAM, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    wait_for_start(tmp_path, 1)
    stopped = [process.pid, *(descendants(process.pid) if with_workers else ())]
    for signal_number in (signal.SIGSTOP, signal.SIGCONT):
        for pid in stopped:
            os.kill(pid, signal_number)
        if signal_number == signal.SIGSTOP:
            time.sleep(4.0)
    output, _ = process.communicate(timeout=60)
    assert output.split() == ["0:0:None", "1:1:None", "2:2:None"]


def write_board(item: int | None) -> None:
    """Write an item, and in a layout with a start time one far in the future, to the status board."""
    board = worker_process._context.board._bytes
    board[:8] = struct.pack("=q", -1 if item is None else item)
    board[8:] = struct.pack("=d", time.monotonic() + 1e6)[: len(board) - 8]


def claim_items(claims: tuple[int | None, ...], hostile_item: int, seconds: float, item: int) -> int:
    """Run for some seconds in the hostile item, and claim on the status board to run other items."""
    time.sleep(0.01)
    if item == hostile_item:
        for claim in claims:
            write_board(claim)
            time.sleep(seconds / len(claims))
    return item


@pytest.mark.parametrize("claims", [(5,), (None,), (6,), (-7,), (5, None) * 10])
def test_case_cannot_write_its_start_time(claims: tuple[int | None, ...]) -> None:
    """A case of 4 s exceeds its limit of 1 s, although it writes start times, other cases or none to the board."""
    results = run_items(partial(claim_items, claims, 5, 4.0), [5], WorkLimits(1.0), total=1)
    assert is_timed_out(results[5])


def test_case_cannot_use_the_time_of_later_cases() -> None:
    """A case of 3 s in a batch of short cases claims each later case in turn; its limit is 1 s."""
    results = run_items(partial(claim_items, tuple(range(21, 31)), 20, 3.0), range(60), WorkLimits(1.0), total=60)
    assert is_timed_out(results[20])
    assert list_results(results) == {item: item for item in range(60) if item != 20}


@pytest.mark.slow
def test_several_short_cases_may_exceed_the_limit_of_one() -> None:
    """Cases of 0.01 s, then cases of 0.3 s: batches together exceed the limit of 1 s, but no case does."""
    assert list_results(run_items(sleep_longer_later, range(30), WorkLimits(1.0))) == {item: item for item in range(30)}


def sleep_longer_later(item: int) -> int:
    time.sleep(0.01 if item < 20 else 0.3)
    return item


@pytest.mark.slow
def test_time_of_the_caller_is_not_time_of_the_cases(tmp_path: Path) -> None:
    """The caller stores results for 1.5 s, longer than the limit of 1 s; each case runs once."""
    with LocalExecutor(1) as workers:
        for batch in workers.run(Work(partial(sleep_after_start, str(tmp_path), 0.05), range(12), WorkLimits(1.0))):
            assert all(result.error is None for result in batch)
            time.sleep(1.5)
    assert [len(read_starts(tmp_path, item)) for item in range(12)] == [1] * 12


@pytest.mark.slow
def test_loading_has_its_own_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Loading takes 2 s, longer than the limit of 1 s of a case. Then its limit is 4 s, longer than starting takes."""
    task, load = partial(sleep_after_start, str(tmp_path), 0.0), partial(time.sleep, 2.0)
    assert list_results(run_items(task, range(3), WorkLimits(1.0), load)) == {0: 0, 1: 1, 2: 2}
    monkeypatch.setattr("marsyard.campaigns.execution.monitoring._LOADING_S", 4.0)
    results = run_items(task, [7], WorkLimits(60.0), partial(time.sleep, 60.0))
    assert is_timed_out(results[7])
    assert str(results[7].error) == "loading took longer than its limit of 4 s"


def fail_to_load() -> None:
    raise ImportError("no such module")


def test_each_case_runs_after_a_failed_loading(tmp_path: Path) -> None:
    results = run_items(partial(sleep_after_start, str(tmp_path), 0.0), range(3), WorkLimits(60.0), fail_to_load)
    assert list_results(results) == {0: 0, 1: 1, 2: 2}


def test_present_item_of_a_batch_never_goes_back() -> None:
    clock = BatchClock([4, 5, 6], 100.0)
    assert (clock.item, clock.has_started) == (4, False)
    for report in (None, 9, 5, 4, None, 5):
        clock.update(report)
    assert (clock.item, clock.has_started) == (5, True)
