"""Workers: what is lost with one is its task alone."""

from __future__ import annotations

import os
import time
from functools import partial
from pathlib import Path

import pytest

from campaigns.workers import WorkerDiedError, Workers

pytestmark = pytest.mark.filterwarnings("ignore:Failed to kill subprocesses")


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
    with Workers(1) as workers:
        assert {done.result for done in workers.run(process_number, range(5))} != {os.getpid()}
    with Workers(2) as workers:
        assert len({done.result for done in workers.run(process_number, range(20))}) == 2


def test_a_task_that_lost_its_worker_by_no_fault_of_its_own_is_run_again(tmp_path: Path) -> None:
    with Workers(2) as workers:
        done = list(workers.run(partial(abort_once, str(tmp_path / "marker")), range(6)))
    assert sorted(ended.item for ended in done if ended.result == ended.item) == list(range(6))
    assert all(ended.error is None for ended in done)


def test_errors_belong_to_their_tasks() -> None:
    with Workers(2) as workers:
        ended = {done.item: done for done in workers.run(misbehave, range(3))}
        assert isinstance(ended[0].error, LookupError)
        assert isinstance(ended[1].error, WorkerDiedError)
        assert str(ended[1].error) == "the worker process died: EXIT (3)"
        assert callable(ended[2].result)
        # The pool goes on working.
        assert [done.result for done in workers.run(partial(nap, 0.0), [7])] == [7]


def interrupted() -> None:
    with Workers(1) as workers:
        for _ in workers.run(lambda item: nap(60.0 * item, item), range(2)):
            raise KeyboardInterrupt


def test_leaving_by_an_exception_waits_for_nobody() -> None:
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert time.monotonic() - began < 20.0


def test_memory_of_what_is_to_do_is_flat() -> None:
    taken = 0

    def items() -> object:
        nonlocal taken
        for item in range(1000):
            taken += 1
            yield item

    with Workers(2) as workers:
        for number, _ in enumerate(workers.run(partial(nap, 0.0), items())):  # type: ignore[arg-type]
            if number == 10:
                break
    assert taken < 20
