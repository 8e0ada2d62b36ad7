"""Tests of the campaign engine: failing cases, stored rows and records, shared inputs and metrics."""

import re
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import DefinitionError, StoreError
from marsyard.campaigns.running.engine import check_metrics
from marsyard.campaigns.running.replay import differing_columns, replay
from marsyard.campaigns.store import record
from marsyard.campaigns.store.table import refresh_table
from tests.campaigns.fake_campaign import FAILING_CASES, CampaignFile, RecordingWatch, read_case_rows, run


def test_campaign_with_failing_cases_finishes(
    failing_campaign: Path, campaign_file: CampaignFile, tmp_path: Path, watch: RecordingWatch
) -> None:
    rows = read_case_rows(failing_campaign)
    assert [row["case"] for row in rows] == list(range(12))
    outcomes = [row["outcome"] for row in rows]
    assert [case for case, outcome in enumerate(outcomes) if outcome == "CRASHED"] == [3, 5]
    assert outcomes[2] == "SILENT"
    assert not rows[2]["answered"]
    assert rows[3]["error"] == "ZeroDivisionError: case 3 of <object object at 0x...>"
    assert "in run" in rows[3]["traceback"]
    assert rows[5]["error"] == "the worker process died: SIGABRT (-6)"
    assert "fake_scenario.py" in rows[5]["traceback"]
    # no column differs with one worker, without the failing cases, and for single replayed cases
    single_worker_rows = read_case_rows(run(campaign_file(FAILING_CASES), tmp_path / "single", watch))
    assert [differing_columns(*pair) for pair in zip(rows, single_worker_rows, strict=True)] == [()] * 12
    rows_without_faults = read_case_rows(run(campaign_file("unanswered_cases = [2]"), tmp_path / "no-faults", watch))
    for case in (0, 1, 2, 4, 6, 7, 8, 9, 10, 11):
        assert differing_columns(rows[case], rows_without_faults[case]) == ()
    for case in (3, 5, 7):
        replay_result = replay(failing_campaign, case)
        assert replay_result.stored is not None
        assert replay_result.differing == ()
    assert watch.notes == []


def test_record_describes_the_run(failing_campaign: Path) -> None:
    stored_record = record.read(failing_campaign)
    assert (stored_record["schema"], stored_record["state"], stored_record["exit_code"]) == (1, "finished", None)
    assert (stored_record["cases_finished"], stored_record["cases_crashed"], stored_record["seed"]) == (12, 2, 5)
    assert stored_record["definition"]["parameters"]["lowest_altitude_m"] == 0.0
    assert stored_record["definition"]["dispersions"]["wind.east_m_s"]["source"] == "test"
    assert stored_record["requirements"][0]["population"] == "all"
    assert stored_record["versions"]["numpy"] == np.__version__
    assert {"python", "platform", "processor", "processor_features"} <= set(stored_record["environment"])
    assert stored_record["started_utc"] <= stored_record["finished_utc"]
    files = ["campaign.json", "campaign.lock", "cases", "cases.parquet", "cases.sqlite"]
    assert sorted(path.name for path in failing_campaign.iterdir()) == files


def test_workers_have_one_thread_and_the_same_hash_seed(failing_campaign: Path) -> None:
    rows = [row for row in read_case_rows(failing_campaign) if row["outcome"] != "CRASHED"]
    assert {row["threads"] for row in rows} == {"1"}
    assert len({row["hash_of_text"] for row in rows}) == 1


@pytest.mark.usefixtures("inline_workers")
def test_shared_inputs_are_prepared_once(campaign_file: CampaignFile, tmp_path: Path, watch: RecordingWatch) -> None:
    parameters = f"shared = 3\ncache = '{tmp_path}'"
    run(campaign_file(parameters), tmp_path / "run", watch, "cases=1", "retain.showcase=none")
    assert len(list(tmp_path.glob("shared-*"))) == 3
    assert watch.steps == {"preparing": 3, "cases": 1}


@pytest.mark.usefixtures("inline_workers")
def test_failed_shared_inputs_are_noted(campaign_file: CampaignFile, tmp_path: Path, watch: RecordingWatch) -> None:
    run(campaign_file("shared = 1\nfail_prepare = true"), tmp_path / "run", watch, "cases=1", jobs=1)
    note = "shared input 0 could not be prepared: OSError: the disk is full"
    assert watch.notes == [note]


def test_used_folder_is_rejected(
    campaign_file: CampaignFile, failing_campaign: Path, tmp_path: Path, watch: RecordingWatch
) -> None:
    times_before = {path: path.stat().st_mtime_ns for path in failing_campaign.rglob("*")}
    with pytest.raises(StoreError, match="contains a campaign"):
        run(campaign_file(), failing_campaign, watch)
    assert {path: path.stat().st_mtime_ns for path in failing_campaign.rglob("*")} == times_before
    # either file shows that a folder contains results
    for name in ("report.html", "cases.sqlite"):
        (tmp_path / name).mkdir()
        (tmp_path / name / name).touch()
        with pytest.raises(StoreError, match=name):
            run(campaign_file(), tmp_path / name, watch)
    # the parent of this folder is a file
    with pytest.raises(StoreError, match="cannot be written"):
        run(campaign_file(), tmp_path / "fake.toml" / "run", watch)


@pytest.mark.usefixtures("inline_workers")
def test_unknown_metric_stops_the_campaign_after_one_case(
    campaign_file: CampaignFile, tmp_path: Path, watch: RecordingWatch
) -> None:
    requirement = "[[requirements]]\nid='a'\nmetric='velocity_eror_m_s'\nbound=1\nprobability=0.9\nconfidence=0.9"
    with pytest.raises(DefinitionError) as error:
        run(campaign_file(requirement=requirement), tmp_path / "run", watch, jobs=1)
    assert "unknown column of numbers 'velocity_eror_m_s' (did you mean 'velocity_error_m_s'?)" in str(error.value)
    assert record.read(tmp_path / "run")["state"] == "interrupted"
    refresh_table(tmp_path / "run")
    assert len(read_case_rows(tmp_path / "run")) == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("metric='velocity_error_m_s'", "[0].metric: unknown column of true and false 'velocity_error_m_s'"),
        ("metric='answered'\nbound=1", "[0].metric: unknown column of numbers 'answered'"),
        ("metric='velocity_error_m_s + speed_m_s'\nbound=1", "[0].metric: unknown column of numbers 'speed_m_s'"),
        ("metric='answered'\npopulation='valid and rom'", "[0].population: unknown column of true and false 'rom'"),
        ("metric='a_time_s + velocity_error_m_s'\nbound=1", ""),
    ],
)
def test_metrics_are_numbers_or_sums_or_true_or_false(campaign_file: CampaignFile, change: str, message: str) -> None:
    requirement = f"[[requirements]]\nid='a'\nprobability=0.9\nconfidence=0.9\n{change}"
    definition = load_campaign(str(campaign_file(requirement=requirement))).definition
    row = {"case": 0, "answered": True, "velocity_error_m_s": 1.0, "a_time_s": 0.1}
    with pytest.raises(DefinitionError, match=re.escape(message)) if message else nullcontext():
        check_metrics(definition, row, Path("runs"))


@pytest.mark.usefixtures("inline_workers")
def test_metric_exists_if_all_cases_crash(campaign_file: CampaignFile, tmp_path: Path, watch: RecordingWatch) -> None:
    directory = run(campaign_file("raising_cases = [0, 1]"), tmp_path / "run", watch, "cases=2", jobs=1)
    frame = pd.read_parquet(directory / "cases.parquet")
    assert frame["velocity_error_m_s"].isna().all()
    assert record.read(directory)["showcase"] is None
