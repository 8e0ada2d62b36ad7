"""Tests of the local executor: limits, worker crashes, batches of items and memory accounting."""

import ctypes
import gc
import mmap
import os
import re
import time
from collections.abc import Callable
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marsyard.algorithms.processes import used_memory
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.batches import MAX_BATCH, Batches
from marsyard.campaigns.execution.work import Work, WorkLimits
from marsyard.campaigns.execution.worker_process import run_batch
from marsyard.campaigns.execution.workers import LocalExecutor
from marsyard.campaigns.outcomes import CRASHED, OUT_OF_MEMORY, TIMED_OUT, TOO_MUCH_OUTPUT
from tests.campaigns.execution.items import get_process_id, list_results, read_exit, run_items, sleep_and_return


def abort_once(marker: str, item: int) -> int:
    if item == 1 and not Path(marker).exists():
        Path(marker).touch()
        os.abort()
    return item


def raise_or_exit(item: int) -> object:
    """Raise in item 0, exit in item 1, return a function in item 2."""
    if item == 0:
        raise LookupError("no such key")
    if item == 1:
        os._exit(3)
    return lambda: item


def test_task_of_killed_worker_is_repeated(tmp_path: Path) -> None:
    results = run_items(partial(abort_once, str(tmp_path / "marker")), range(6), jobs=2)
    assert list_results(results) == {item: item for item in range(6)}
    assert [results[item].attempts for item in range(6)] == [1, 2, 1, 1, 1, 1]


def test_errors_are_assigned_to_their_tasks() -> None:
    with LocalExecutor(2) as workers:
        results = {result.item: result for batch in workers.run(Work(raise_or_exit, range(3))) for result in batch}
        assert isinstance(results[0].error, LookupError)
        assert str(read_exit(results[1])) == "the worker process died: EXIT (3)"
        assert callable(results[2].result)
        # the executor still works
        (batch,) = workers.run(Work(partial(sleep_and_return, 0.0), [7]))
        assert batch[0].result == 7


def run_and_interrupt() -> None:
    with LocalExecutor(1) as workers:
        for _ in workers.run(Work(lambda item: sleep_and_return(60.0 * item, item), range(2))):
            raise KeyboardInterrupt


def test_interruption_does_not_wait_for_tasks() -> None:
    start_s = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run_and_interrupt()
    assert time.monotonic() - start_s < 20.0


def test_items_are_read_only_as_workers_need_them() -> None:
    n_items = 0

    def items() -> object:
        nonlocal n_items
        for item in range(1000):
            n_items += 1
            yield item

    with LocalExecutor(2) as workers:
        work = Work(partial(sleep_and_return, 0.0), items())  # type: ignore[arg-type]
        for number, _ in enumerate(chain.from_iterable(workers.run(work))):
            if number == 10:
                break
    # batches double: after 1, 2, 4 and 8, one of 16 and one of 32 may be running
    assert n_items < 200


def exceed_limit(folder: str, item: int) -> int:
    """Exceed one limit per item 1 to 4: time, memory, output, segmentation fault. Each start is recorded in a file."""
    with Path(folder, str(item)).open("a") as file:
        file.write(".")
    if item == 1:
        # backtracks 2^64 times in C without releasing the interpreter lock
        re.match("(a+)+$", "a" * 64 + "b")
    arrays = []
    while item == 2:
        arrays.append(np.ones(500_000))
    while item == 3:
        os.write(2, b"another line of text\n" * 100)
    if item == 4:
        ctypes.string_at(0)
    return item


@pytest.mark.slow
def test_only_tasks_that_exceed_a_limit_are_ended(tmp_path: Path) -> None:
    limits = WorkLimits(time_s=3.0, memory_bytes=0.2e9, output_bytes=1e5)
    # one worker runs the items in order; later batches contain several items
    results = run_items(partial(exceed_limit, str(tmp_path)), [0, 5, 6, 7, 1, 2, 3, 4, 8, 9], limits)
    assert list_results(results) == {item: item for item in (0, 5, 6, 7, 8, 9)}
    # each error contains the trace of the line that was running
    errors = [read_exit(results[item]) for item in (1, 2, 3, 4)]
    assert [(error.outcome, str(error), " in exceed_limit" in error.trace) for error in errors] == [
        (TIMED_OUT, "took longer than its limit of 3 s", True),
        (OUT_OF_MEMORY, "used more memory than its limit of 0.2 GB", True),
        (TOO_MUCH_OUTPUT, "wrote more than its limit of 0.1 MB", True),
        (CRASHED, "the worker process died: SIGSEGV (-11)", True),
    ]
    # a crash and missing memory may have another cause, so these tasks run twice; the time of a task in a batch of
    # several is measured in a second run
    starts = {item: len((tmp_path / str(item)).read_text()) for item in (1, 2, 3, 4)}
    assert starts == {1: 2, 2: 2, 3: 1, 4: 2}
    assert {item: results[item].attempts for item in starts} == starts


def leak_memory(item: int, arrays: list[object] = []) -> int:  # noqa: B006  (the list imitates a memory leak)
    arrays.append(np.ones(4_000_000))
    # long enough for the watcher to measure the memory
    time.sleep(0.1)
    return item


@pytest.mark.slow
def test_memory_leak_of_earlier_tasks_does_not_end_a_task() -> None:
    """Twelve tasks leak 32 MB each; the limit is 200 MB."""
    results = run_items(leak_memory, range(12), WorkLimits(memory_bytes=0.2e9))
    assert list_results(results) == {item: item for item in range(12)}


def exit_at_start(*_: object) -> None:
    os._exit(7)


def test_workers_that_die_at_start_raise_a_campaign_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("marsyard.campaigns.execution.workers._DEATH_PAUSE_S", 0.01)
    with LocalExecutor(2) as workers:
        monkeypatch.setattr("marsyard.campaigns.execution.monitoring.run_batch", exit_at_start)
        with pytest.raises(CampaignError, match="all worker processes die before they start a case"):
            list(workers.run(Work(get_process_id, range(9))))


def exit_while_marked(folder: str, task: Callable[[int], Any], items: Any) -> Any:
    """Die before a case while the folder contains a file, which is removed: a temporary lack of memory."""
    marker = next(iter(Path(folder).iterdir()), None)
    if marker is not None:
        marker.unlink()
        os._exit(7)
    return run_batch(task, items)


@pytest.mark.slow
def test_campaign_survives_several_deaths_at_start(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A worker dies three times, and pauses before each start."""
    monkeypatch.setattr("marsyard.campaigns.execution.workers._DEATH_PAUSE_S", 0.5)
    for number in range(3):
        (tmp_path / str(number)).touch()
    start_s = time.monotonic()
    with LocalExecutor(1) as workers:
        monkeypatch.setattr(
            "marsyard.campaigns.execution.monitoring.run_batch", partial(exit_while_marked, str(tmp_path))
        )
        results = {result.item: result for batch in workers.run(Work(get_process_id, range(4))) for result in batch}
    assert sorted(list_results(results)) == [0, 1, 2, 3]
    # pauses of 0.5, 1 and 2 s
    assert time.monotonic() - start_s >= 3.5


def test_used_memory_counts_only_private_pages(tmp_path: Path) -> None:
    size = 40_000_000
    # objects of earlier tests must not be released during the measurement
    gc.collect()
    initial_memory = used_memory([os.getpid()])
    mapped_file = np.memmap(tmp_path / "terrain", dtype=np.uint8, mode="w+", shape=size)
    mapped_file[:] = 1
    memory_with_map = used_memory([os.getpid()])
    assert memory_with_map - initial_memory < 0.5 * size
    # not an array: NumPy could reuse memory that is already counted
    private_pages = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE)
    np.frombuffer(private_pages, np.uint8)[:] = 1
    assert used_memory([os.getpid()]) - memory_with_map > 0.5 * size
    # no process has an id above 2^22
    assert used_memory([2**22 + 1]) == 0.0


def test_batches_last_about_one_second_and_shrink_at_the_end() -> None:
    # 400 items, whose number is known, for 2 workers
    batches = Batches(range(400), 400, 2)
    sizes = []
    while batch := batches.next():
        sizes.append(len(batch))
        batches.record_time(len(batch), 0.05 * len(batch))  # 20 cases per second
    assert sum(sizes) == 400
    assert sizes[:5] == [1, 2, 4, 8, 16]
    assert max(sizes) == 20
    assert sizes[-1] == 1
    # batches of cases without run time reach the maximum size (the total is unknown); slow cases run one by one
    instant_cases = Batches(range(10_000), None, 2)
    sizes = [len(instant_cases.next())]
    while batch := instant_cases.next():
        instant_cases.record_time(sizes[-1], 0.0)
        sizes.append(len(batch))
    assert max(sizes) == MAX_BATCH
    slow_cases = Batches(range(5), 5, 1)
    slow_cases.record_time(1, 30.0)
    assert [len(slow_cases.next()) for _ in range(5)] == [1] * 5
    assert slow_cases.next() == []


def get_worker_number(_: int) -> str:
    time.sleep(0.5)
    return os.environ["MARSYARD_WORKER_NUMBER"]


def test_workers_are_numbered() -> None:
    assert set(list_results(run_items(get_worker_number, range(4), jobs=2)).values()) == {"0", "1"}


@pytest.mark.slow
def test_number_of_worker_processes_is_respected() -> None:
    assert set(list_results(run_items(get_process_id, range(5))).values()) != {os.getpid()}
    assert len(set(list_results(run_items(get_process_id, range(20), jobs=2)).values())) == 2
