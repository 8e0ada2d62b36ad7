"""Executor: what is lost with one is its task alone."""

from __future__ import annotations

import ctypes
import gc
import mmap
import os
import re
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marsyard.algorithms.processes import used_memory
from marsyard.campaigns.errors import CRASHED, OUT_OF_MEMORY, TIMED_OUT, TOO_MUCH_OUTPUT, CampaignError, CaseEndedError
from marsyard.campaigns.execution.worker_process import StatusBoard, TaskResult, Work, WorkLimits
from marsyard.campaigns.execution.workers import MAX_BATCH, Batches, LocalExecutor

pytestmark = pytest.mark.filterwarnings("ignore:Failed to kill subprocesses")


def run(
    workers: LocalExecutor, task: Callable[[int], Any], items: Iterable[int], limits: WorkLimits | None = None
) -> Iterator[TaskResult[Any]]:
    return chain.from_iterable(workers.run(Work(task, items, limits or WorkLimits())))


def process_number(_: int) -> int:
    return os.getpid()


def abort_once(marker: str, item: int) -> int:
    if item == 1 and not Path(marker).exists():
        Path(marker).touch()
        os.abort()
    return item


def misbehave(item: int) -> object:
    if item == 0:
        raise LookupError("nothing there")
    if item == 1:
        os._exit(3)
    return lambda: None if item == 2 else item


def nap(seconds: float, item: int) -> int:
    time.sleep(seconds)
    return item


def test_tasks_run_in_as_many_processes_as_asked_for() -> None:
    with LocalExecutor(1) as workers:
        assert {done.result for done in run(workers, process_number, range(5))} != {os.getpid()}
    with LocalExecutor(2) as workers:
        assert len({done.result for done in run(workers, process_number, range(20))}) == 2


def test_a_task_whose_worker_was_killed_is_run_again(tmp_path: Path) -> None:
    with LocalExecutor(2) as workers:
        done = list(run(workers, partial(abort_once, str(tmp_path / "marker")), range(6)))
    assert sorted(ended.item for ended in done if ended.result == ended.item) == list(range(6))
    assert all(ended.error is None for ended in done)


def test_errors_belong_to_their_tasks() -> None:
    with LocalExecutor(2) as workers:
        ended = {done.item: done for done in run(workers, misbehave, range(3))}
        assert isinstance(ended[0].error, LookupError)
        assert isinstance(ended[1].error, CaseEndedError)
        assert str(ended[1].error) == "the worker process died: EXIT (3)"
        assert callable(ended[2].result)
        # The pool goes on working.
        assert [done.result for done in run(workers, partial(nap, 0.0), [7])] == [7]


def interrupted() -> None:
    with LocalExecutor(1) as workers:
        for _ in run(workers, lambda item: nap(60.0 * item, item), range(2)):
            raise KeyboardInterrupt


def test_exit_by_an_exception_does_not_wait() -> None:
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert time.monotonic() - began < 20.0


def test_memory_of_pending_items_is_constant() -> None:
    taken = 0

    def items() -> object:
        nonlocal taken
        for item in range(1000):
            taken += 1
            yield item

    with LocalExecutor(2) as workers:
        for number, _ in enumerate(run(workers, partial(nap, 0.0), items())):  # type: ignore[arg-type]
            if number == 10:
                break
    # batches double as they end: after 1, 2, 4 and 8 there may be one of 16 and one of 32 under way, hardly more
    assert taken < 200


def hurt(folder: str, item: int) -> int:
    """Does something different to its worker for each of the first items; all note that they began."""
    with Path(folder, str(item)).open("a") as file:
        file.write(".")
    if item == 1:
        # in C, without letting go of the interpreter: two to the power of 64 ways to share the letters out
        re.match("(a+)+$", "a" * 64 + "b")
    hoard = []
    while item == 2:
        hoard.append(np.ones(500_000))
    while item == 3:
        os.write(2, b"and another thing\n" * 100)
    if item == 4:
        ctypes.string_at(0)
    return item


def test_only_tasks_over_a_limit_are_ended(tmp_path: Path) -> None:
    limits = WorkLimits(time_s=3.0, memory_bytes=0.2e9, output_bytes=1e5)
    # With one worker the items run in their order; the first batches are small, the later ones hold several.
    with LocalExecutor(1) as workers:
        ended = {
            done.item: done
            for done in run(workers, partial(hurt, str(tmp_path)), [0, 5, 6, 7, 1, 2, 3, 4, 8, 9], limits)
        }
    errors = {item: done.error for item, done in ended.items() if done.error is not None}
    assert all(isinstance(error, CaseEndedError) for error in errors.values())
    assert {item: error.outcome for item, error in errors.items()} == {  # type: ignore[attr-defined]
        1: TIMED_OUT,
        2: OUT_OF_MEMORY,
        3: TOO_MUCH_OUTPUT,
        4: CRASHED,
    }
    assert [str(errors[item]) for item in (1, 2, 3, 4)] == [
        "took longer than its limit of 3 s",
        "took more memory than its limit of 0.2 GB",
        "wrote more than its limit of 0.1 MB",
        "the worker process died: SIGSEGV (-11)",
    ]
    # Each says where it stood, down to the line.
    for error in errors.values():
        assert isinstance(error, CaseEndedError)
        assert " in hurt" in error.trace
    assert {item: done.result for item, done in ended.items() if done.error is None} == {
        n: n for n in (0, 5, 6, 7, 8, 9)
    }
    # What is surely the task's own fault is not tried again; a death and want of memory are, once.
    began = {item: len((tmp_path / str(item)).read_text()) for item in (1, 2, 3, 4)}
    assert began == {1: 1, 2: 2, 3: 1, 4: 2}


def fill(item: int, kept: list[object] = []) -> int:  # noqa: B006  (kept on purpose, as a leak is)
    kept.append(np.ones(4_000_000))
    return item


def test_a_leak_is_not_attributed_to_the_task_that_reaches_the_limit() -> None:
    limits = WorkLimits(memory_bytes=0.2e9)
    with LocalExecutor(1) as workers:
        ended = list(run(workers, slow_fill, range(12), limits))
    assert sorted(done.item for done in ended if done.error is None) == list(range(12))


def slow_fill(item: int) -> int:
    fill(item)
    # so that the watcher looks in between
    time.sleep(0.1)
    return item


def spawn(item: int) -> int:
    subprocess.Popen(["sleep", "3600"])
    time.sleep(3600)
    return item


def test_processes_started_by_a_task_end_with_it() -> None:
    with LocalExecutor(1) as workers:
        (done,) = run(workers, spawn, [0], WorkLimits(time_s=1.0))
        assert isinstance(done.error, CaseEndedError)
        found = subprocess.run(["ps", "-eo", "ppid,args"], capture_output=True, text=True, check=True).stdout
    # orphans would have been taken in by the first process
    assert not [line for line in found.splitlines() if line.split()[1:] == ["sleep", "3600"] and line.split()[0] == "1"]


def leave(*_: object) -> None:
    os._exit(7)


def test_a_worker_that_cannot_begin_is_an_error_of_the_campaign(monkeypatch: pytest.MonkeyPatch) -> None:
    with LocalExecutor(1) as workers:
        monkeypatch.setattr("marsyard.campaigns.execution.workers.run_batch", leave)
        with pytest.raises(CampaignError, match="worker processes die before they begin a case"):
            list(workers.run(Work(process_number, range(3))))


def test_memory_counts_private_pages(tmp_path: Path) -> None:
    size = 40_000_000
    # what earlier tests have left in this process may be released meanwhile
    gc.collect()
    before = used_memory([os.getpid()])
    mapped = np.memmap(tmp_path / "terrain", dtype=np.uint8, mode="w+", shape=size)
    mapped[:] = 1
    with_map = used_memory([os.getpid()])
    assert with_map - before < 0.5 * size
    # not an array: NumPy would take its memory from what earlier tests have left, which counts already
    own = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE)
    np.frombuffer(own, np.uint8)[:] = 1
    assert used_memory([os.getpid()]) - with_map > 0.5 * size
    assert used_memory([2**22 + 1]) == 0.0


def test_batches_grow_to_a_second_and_shrink_to_the_end() -> None:
    batches = Batches(range(400), 400, 2)
    sizes = []
    while batch := batches.next():
        sizes.append(len(batch))
        batches.record_time(len(batch), 0.05 * len(batch))
    assert sum(sizes) == 400
    assert sizes[:5] == [1, 2, 4, 8, 16]
    assert max(sizes) == 20
    assert sizes[-1] == 1
    # Empty cases go a thousand at a time, unknown numbers of them as well; slow ones alone.
    empty = Batches(range(10_000), None, 2)
    sizes = [len(empty.next())]
    while batch := empty.next():
        empty.record_time(sizes[-1], 0.0)
        sizes.append(len(batch))
    assert max(sizes) == MAX_BATCH
    slow = Batches(range(5), 5, 1)
    slow.record_time(1, 30.0)
    assert [len(slow.next()) for _ in range(5)] == [1] * 5
    assert slow.next() == []


def test_the_status_board_shows_item_and_start(tmp_path: Path) -> None:
    board = StatusBoard.create(tmp_path / "board")
    assert board.read()[0] is None
    StatusBoard(tmp_path / "board").write(2**40, 1.5)
    assert board.read() == (2**40, 1.5)
    board.close()
