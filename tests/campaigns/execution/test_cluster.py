"""A Dask cluster runs cases as one machine does, and is as hard to bring down."""

from __future__ import annotations

import subprocess
import sys
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

ROOT = Path(__file__).parents[3]

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


@pytest.mark.parametrize("address", ["local:0", "local:x"])
def test_numbers_of_workers_that_are_none(
    campaign_file: Callable[..., Path], tmp_path: Path, watch: Silence, address: str
) -> None:
    with pytest.raises(CampaignError, match="expected local:N, with N at least 1"):
        run_campaign(load_campaign(str(campaign_file())), tmp_path / "run", Crew(cluster=address), watch)
    assert record.read(tmp_path / "run")["state"] == "interrupted"


#: In a process of its own: Dask's client starts a thread with a loop, which in one that has run other tests for minutes
#: did not always come up.
REACH = """
import sys
from campaigns.errors import CampaignError
from campaigns.execution import cluster
cluster._REACH_S = 1
try:
    cluster.ClusterWorkers(sys.argv[1])
except CampaignError as error:
    print(error)
"""


@pytest.mark.parametrize("address", ["nowhere", "tcp://127.0.0.1:1"])
def test_addresses_where_no_scheduler_answers(address: str) -> None:
    done = subprocess.run([sys.executable, "-c", REACH, address], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"--cluster {address}: no scheduler answers")
