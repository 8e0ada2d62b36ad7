"""Tests of the Dask cluster executor: same rows as on one machine, same isolation of cases.

The address `local:N` starts a cluster of N workers on this machine.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import distributed
import pytest

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.cluster import ClusterExecutor
from marsyard.campaigns.execution.workers import ExecutorConfig
from marsyard.campaigns.running.engine import run_campaign
from marsyard.campaigns.running.replay import differing_columns
from marsyard.campaigns.store import record
from marsyard.campaigns.store.table import read_rows
from tests.campaigns.fake_campaign import RecordingWatch

pytestmark = [
    pytest.mark.filterwarnings("ignore:Failed to kill subprocesses"),
    # warnings of Dask itself
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.mark.slow
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
