"""Tests of the Dask cluster executor: same rows as on one machine, same isolation of cases.

The address `local:N` starts a cluster of N workers on this machine.
"""

import gc
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import distributed
import pytest

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.cluster import ClusterExecutor
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.running.engine import run_campaign
from marsyard.campaigns.running.replay import differing_columns
from marsyard.campaigns.store import record
from marsyard.campaigns.store.table import read_rows
from tests.campaigns.fake_campaign import TOP_LEVEL_KEYS, RecordingWatch, run

pytestmark = [
    # warnings of Dask itself
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture
def used_dask_port() -> Iterator[None]:
    """Use the default port of Dask's HTTP server, as a second local cluster on the machine does."""
    with socket.socket() as server:
        with suppress(OSError):  # another program already uses it
            server.bind(("", 8787))
        server.listen()
        yield


@pytest.mark.slow
@pytest.mark.usefixtures("used_dask_port")
def test_cluster_rows_equal_rows_of_one_machine(
    campaign_file: Callable[..., Path], tmp_path: Path, watch: RecordingWatch
) -> None:
    path = campaign_file("raising_cases = [3]\naborting_cases = [5]")
    rows = {}
    for name, executor in (("cluster", ExecutorConfig(cluster="local:2")), ("machine", ExecutorConfig(1))):
        run_campaign(load_campaign(str(path)), tmp_path / name, executor, watch)
        rows[name] = read_rows(tmp_path / name / "cases.parquet")
    # no column differs in any of the 12 cases
    assert [differing_columns(*pair) for pair in zip(*rows.values(), strict=True)] == [()] * 12
    outcomes = {row["case"]: row["outcome"] for row in rows["cluster"] if not row["answered"]}
    assert outcomes == {3: "CRASHED", 5: "CRASHED"}
    assert record.read(tmp_path / "cluster")["sessions"][0]["workers"] == "cluster local:2"
    assert watch.notes == []


@pytest.mark.parametrize("address", ["local:0", "local:x"])
def test_invalid_worker_numbers_are_rejected(
    campaign_file: Callable[..., Path], tmp_path: Path, watch: RecordingWatch, address: str
) -> None:
    with pytest.raises(CampaignError, match="expected local:N, with N at least 1"):
        run_campaign(load_campaign(str(campaign_file())), tmp_path / "run", ExecutorConfig(cluster=address), watch)
    assert record.read(tmp_path / "run")["state"] == "interrupted"


@pytest.mark.parametrize("address", ["nowhere", "tcp://127.0.0.1:1"])
def test_unreachable_scheduler_is_reported(monkeypatch: pytest.MonkeyPatch, address: str) -> None:
    monkeypatch.setattr("marsyard.campaigns.execution.cluster._TIMEOUT_S", 1)
    with pytest.raises(CampaignError, match=f"--cluster {address}: no scheduler responds"):
        ClusterExecutor(address)


@pytest.mark.slow
def test_invalid_address_does_not_delay_next_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    """The garbage collector may close the failed client while the event loop of the next client starts."""
    monkeypatch.setattr("marsyard.campaigns.execution.cluster._TIMEOUT_S", 1)
    with pytest.raises(CampaignError, match="missing port number"):
        ClusterExecutor("nowhere")
    get_loop_factory = distributed.utils.get_loop_factory

    def collect_and_get_loop_factory() -> Any:
        gc.collect()
        return get_loop_factory()

    monkeypatch.setattr("distributed.utils.get_loop_factory", collect_and_get_loop_factory)
    with pytest.raises(CampaignError, match="no scheduler responds"):
        ClusterExecutor("tcp://127.0.0.1:1")


class _Cluster:
    """A scheduler and workers as processes of their own, as a batch system starts them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
        self._scheduler = self._start("scheduler", "--host", self.address, "--no-dashboard")
        self._workers: list[subprocess.Popen[bytes]] = []

    def add_workers(self, number: int) -> None:
        options = ("--nthreads", "1", "--no-dashboard", "--memory-limit", "0", "--local-directory", str(self._folder))
        self._workers += [self._start("worker", self.address, *options) for _ in range(number)]

    def kill_workers(self, number: int) -> None:
        for process in self._workers[:number]:
            self._kill(process)
        del self._workers[:number]

    def restart_scheduler(self) -> None:
        self._kill(self._scheduler)
        self._scheduler = self._start("scheduler", "--host", self.address, "--no-dashboard")

    def close(self) -> None:
        for process in [self._scheduler, *self._workers]:
            self._kill(process)

    def _start(self, *arguments: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "distributed.cli.dask_" + arguments[0], *arguments[1:]]
        return subprocess.Popen(command, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    @staticmethod
    def _kill(process: subprocess.Popen[bytes]) -> None:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


class _ActionAtRows(RecordingWatch):
    """Runs actions in a thread of its own as soon as a number of rows is stored."""

    def __init__(self, actions: dict[int, Callable[[], None]]) -> None:
        super().__init__()
        self._actions = actions
        self.threads: list[threading.Thread] = []

    def step(self) -> None:
        super().step()
        for number in [number for number in self._actions if number <= self.steps["cases"]]:
            thread = threading.Thread(target=self._actions.pop(number))
            thread.start()
            self.threads.append(thread)


@pytest.mark.slow
def test_lost_workers_and_a_restarted_scheduler_lose_nothing(
    campaign_file: Callable[..., Path], tmp_path: Path
) -> None:
    """Three of eight workers are killed, then the scheduler; five workers join the new scheduler."""
    keys = TOP_LEVEL_KEYS.replace("cases = 12", "cases = 240")
    path, cluster = campaign_file("sleep_s = 0.2", top_level_keys=keys), _Cluster(tmp_path / "dask")

    def restart() -> None:
        cluster.restart_scheduler()
        cluster.kill_workers(5)  # Dask's workers end without their scheduler
        cluster.add_workers(5)

    watch = _ActionAtRows({30: lambda: cluster.kill_workers(3), 100: restart})
    try:
        cluster.add_workers(8)
        run_campaign(load_campaign(str(path)), tmp_path / "cluster", ExecutorConfig(cluster=cluster.address), watch)
        for thread in watch.threads:
            thread.join()
    finally:
        cluster.close()
    assert len(watch.threads) == 2
    run(path, tmp_path / "machine", RecordingWatch(), "sleep_s=0", jobs=1)
    rows = [read_rows(tmp_path / name / "cases.parquet") for name in ("cluster", "machine")]
    assert [len(table) for table in rows] == [240, 240]
    assert [differing_columns(*pair) for pair in zip(*rows, strict=True)] == [()] * 240


@pytest.mark.slow
def test_worker_with_other_code_stops_the_campaign(
    campaign_file: Callable[..., Path], tmp_path: Path, watch: RecordingWatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The client imitates another version; the rows of other workers are stored."""
    monkeypatch.setattr("marsyard.campaigns.execution.cluster.identify_code", lambda: ("another hash", ()))
    with pytest.raises(CampaignError, match="runs a different Marsyard source code"):
        run_campaign(load_campaign(str(campaign_file())), tmp_path / "run", ExecutorConfig(cluster="local:1"), watch)
