"""A Dask cluster runs cases as one machine does, and is as hard to bring down."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from fake_campaign import Silence

from campaigns.definition.loading import load_campaign
from campaigns.errors import CampaignError
from campaigns.execution.crew import Crew
from campaigns.running.engine import run_campaign
from campaigns.running.replay import differing_columns
from campaigns.store import record
from campaigns.store.table import read_rows

pytestmark = [
    pytest.mark.filterwarnings("ignore:Failed to kill subprocesses"),
    # Dask's own, in its own business.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


def test_a_cluster_gives_the_rows_of_one_machine(
    campaign_file: Callable[..., Path], tmp_path: Path, watch: Silence
) -> None:
    path = campaign_file(
        "raising_cases = [3]\naborting_cases = [5]\nlooping_cases = [8]", more="[limits]\ncase_time_s=3"
    )
    rows = {}
    for name, crew in (("cluster", Crew(cluster="local:2")), ("machine", Crew(1))):
        run_campaign(load_campaign(str(path)), tmp_path / name, crew, watch)
        rows[name] = read_rows(tmp_path / name / "cases.parquet")
    assert [differing_columns(*pair) for pair in zip(*rows.values(), strict=True)] == [()] * 12
    outcomes = {row["case"]: row["outcome"] for row in rows["cluster"] if not row["answered"]}
    assert outcomes == {3: "CRASHED", 5: "CRASHED", 8: "TIMED_OUT"}
    assert record.read(tmp_path / "cluster")["sessions"][0]["workers"] == "cluster local:2"
    assert watch.notes == []


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("local:0", "expected local:N, with N at least 1"),
        ("local:x", "expected local:N"),
        ("nowhere", "no scheduler answers"),
        ("tcp://127.0.0.1:1", "no scheduler answers"),
    ],
)
def test_clusters_that_are_none(
    campaign_file: Callable[..., Path],
    tmp_path: Path,
    watch: Silence,
    monkeypatch: pytest.MonkeyPatch,
    address: str,
    said: str,
) -> None:
    monkeypatch.setattr("campaigns.execution.cluster._REACH_S", 1)
    with pytest.raises(CampaignError, match=said):
        run_campaign(load_campaign(str(campaign_file())), tmp_path / "run", Crew(cluster=address), watch)
    assert record.read(tmp_path / "run")["state"] == "interrupted"
