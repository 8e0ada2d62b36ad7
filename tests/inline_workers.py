"""Run the cases of a campaign in the process of a test, for tests that do not examine worker processes.

The start of a worker process takes a second of processor time.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, suppress
from typing import Any, TypeVar

import pytest

from marsyard.campaigns.execution import cases
from marsyard.campaigns.execution.work import TaskResult, Work
from marsyard.campaigns.execution.worker_process import run_batch

Result = TypeVar("Result")
#: Names through which commands and studies create their executors.
EXECUTORS = (
    "running.engine.create_executor",
    "running.estimate.create_executor",
    "running.replay.LocalExecutor",
    "studies.runner.create_executor",
)


class InlineExecutor(AbstractContextManager["InlineExecutor"]):
    """An executor (`marsyard.campaigns.execution.work.Executor`) without processes; limits have no effect."""

    def __init__(self, _config: object = None) -> None: ...

    def __exit__(self, *_: object) -> None: ...

    def run(self, work: Work[Result]) -> Iterator[list[TaskResult[Result]]]:
        if work.load is not None:
            with suppress(Exception):
                work.load()
        for item in work.items:
            yield run_batch(work.task, [item]).results


def use_inline_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the worker processes of campaigns, replays and studies by `InlineExecutor`."""
    cases._load_campaign.cache_clear()
    # the objects of the tests stay subject to garbage collection
    monkeypatch.setattr("marsyard.campaigns.execution.worker_process.accept_process_state", lambda: None)
    for name in EXECUTORS:
        monkeypatch.setattr(f"marsyard.campaigns.{name}", InlineExecutor)


def inline_workers_fixture() -> Any:
    """Return a fixture that replaces the worker processes in all tests of a module: ``_inline = ...()``."""

    @pytest.fixture(autouse=True, scope="module")
    def inline_workers() -> Iterator[None]:
        with pytest.MonkeyPatch.context() as monkeypatch:
            use_inline_workers(monkeypatch)
            yield

    return inline_workers
