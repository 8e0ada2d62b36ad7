"""Tests of `resume`, `append` and `replay`: added and repeated cases, changed programs and definitions."""

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from marsyard.campaigns.definition.identity import read_versions
from marsyard.campaigns.errors import CampaignError, StoreError
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.running.engine import append_cases, resume_campaign
from marsyard.campaigns.running.replay import differing_columns, replay
from marsyard.campaigns.store import record
from marsyard.campaigns.store.lock import folder_lock
from marsyard.campaigns.store.origin import check_rows
from tests.campaigns.fake_campaign import (
    CampaignFile,
    RecordingWatch,
    continuing_commands,
    read_case_rows,
    run,
    sign_folder,
    write_campaign,
)


@pytest.fixture(scope="module")
def _finished_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run a campaign of four cases."""
    folder = tmp_path_factory.mktemp("finished")
    return run(write_campaign(folder, "raising_cases = [2]"), folder / "done", RecordingWatch(), "cases=4", jobs=1)


@pytest.fixture
def finished_campaign(_finished_run: Path, tmp_path: Path) -> Path:
    """Copy the folder of a finished campaign of four cases; tests may change it."""
    return Path(shutil.copytree(_finished_run, tmp_path / "done"))


@pytest.mark.slow
def test_appended_cases_follow_existing_cases(
    finished_campaign: Path, campaign_file: CampaignFile, tmp_path: Path, watch: RecordingWatch
) -> None:
    rows_before = [str(row) for row in read_case_rows(finished_campaign)]
    append_cases(finished_campaign, 3, ExecutorConfig(1), watch)
    append_cases(finished_campaign, 1, ExecutorConfig(2), watch)
    rows = read_case_rows(finished_campaign)
    assert [str(row) for row in rows[:4]] == rows_before
    stored_record = record.read(finished_campaign)
    assert (stored_record["cases"], stored_record["state"]) == (8, "finished")
    assert stored_record["definition"]["appended"] == [3, 1]
    # independent draws: appended cases equal the cases of a larger campaign
    larger_run = run(campaign_file("raising_cases = [2]"), tmp_path / "larger", watch, "cases=8", jobs=1)
    larger_rows = read_case_rows(larger_run)
    assert [differing_columns(*pair) for pair in zip(rows, larger_rows, strict=True)] == [()] * 8
    assert replay(finished_campaign, 7).differing == ()
    with pytest.raises(CampaignError, match="0 cases cannot be added"):
        append_cases(finished_campaign, 0, ExecutorConfig(1), watch)


def test_resume_of_finished_campaign_runs_nothing(
    finished_campaign: Path, watch: RecordingWatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    times_before = {name: (finished_campaign / name).stat().st_mtime_ns for name in ("campaign.json", "cases.parquet")}
    record_before = record.read(finished_campaign)
    watch.steps.clear()

    def reject_executor(*_: object) -> None:
        raise AssertionError("a worker is started")

    monkeypatch.setattr("marsyard.campaigns.running.engine.create_executor", reject_executor)
    resume_campaign(finished_campaign, ExecutorConfig(1), watch)
    assert watch.notes[-1] == "the campaign is finished: all 4 cases have rows; nothing is run"
    assert watch.steps == {}
    assert {name: (finished_campaign / name).stat().st_mtime_ns for name in times_before} == times_before
    assert record.read(finished_campaign) == record_before


def test_crashed_cases_are_repeated_on_request(finished_campaign: Path, watch: RecordingWatch) -> None:
    times = {row["case"]: row["wall_time_s"] for row in read_case_rows(finished_campaign)}
    resume_campaign(finished_campaign, ExecutorConfig(1), watch)
    assert {row["case"]: row["wall_time_s"] for row in read_case_rows(finished_campaign)} == times
    resume_campaign(finished_campaign, ExecutorConfig(1), watch, retry=["crashed"])
    times_after_retry = {row["case"]: row["wall_time_s"] for row in read_case_rows(finished_campaign)}
    assert [case for case in times if times_after_retry[case] != times[case]] == [2]
    # the first run repeats the exception of the scenario in a fresh worker, the second run has only this case
    assert [row["case_attempts"] for row in read_case_rows(finished_campaign)] == [1, 1, 3, 1]


@pytest.mark.usefixtures("inline_workers")
def test_changed_versions_are_rejected_without_allow_changed(
    finished_campaign: Path, watch: RecordingWatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    versions = read_versions()
    monkeypatch.setattr("marsyard.campaigns.definition.identity.read_versions", lambda: {**versions, "numpy": "0.9"})
    contents_before = {path: path.read_bytes() for path in finished_campaign.glob("c*.*")}
    message = rf"Changed:\n  numpy \({np.__version__}, now 0.9\)\nTo continue nevertheless.*--allow-changed"
    for command in continuing_commands(finished_campaign, watch):
        with pytest.raises(CampaignError, match=message):
            command()
    assert {path: path.read_bytes() for path in contents_before} == contents_before
    append_cases(finished_campaign, 2, ExecutorConfig(1), watch, allow_changed=True)
    (change,) = record.read(finished_campaign)["changes"]
    assert (change["cases_before"], change["in"]) == (4, [f"numpy ({np.__version__}, now 0.9)"])
    assert record.read(finished_campaign)["identity"]["versions"]["numpy"] == "0.9"


def test_changed_definition_is_rejected(finished_campaign: Path, watch: RecordingWatch) -> None:
    text = (finished_campaign / "campaign.json").read_text()
    (finished_campaign / "campaign.json").write_text(text.replace('"altitude_m": 2000.0', '"altitude_m": 2001.0'))
    sign_folder(finished_campaign)
    with pytest.raises(CampaignError, match="definition \\("):
        resume_campaign(finished_campaign, ExecutorConfig(1), watch)
    # a report would state other parameters than those of the rows
    with pytest.raises(StoreError, match="the definition is not the one with which the rows were stored"):
        check_rows(finished_campaign)


@pytest.mark.usefixtures("inline_workers")
def test_store_of_another_campaign_is_rejected(
    finished_campaign: Path, campaign_file: CampaignFile, tmp_path: Path, watch: RecordingWatch
) -> None:
    other = run(campaign_file(""), tmp_path / "other", watch, "cases=1", "seed=77", jobs=1)
    shutil.copy(other / "cases.sqlite", finished_campaign / "cases.sqlite")
    with pytest.raises(StoreError, match="the definition is not the one"):
        resume_campaign(finished_campaign, ExecutorConfig(1), watch)


def test_locked_folder_is_rejected(finished_campaign: Path, watch: RecordingWatch) -> None:
    with folder_lock(finished_campaign):
        for command in continuing_commands(finished_campaign, watch):
            with pytest.raises(StoreError, match="is in use"):
                command()


def test_replay_reports_differing_columns(failing_campaign: Path, tmp_path: Path) -> None:
    directory = shutil.copytree(failing_campaign, tmp_path / "copy")
    frame = pd.read_parquet(directory / "cases.parquet")
    altitudes = frame["altitude_m"].to_numpy(copy=True)
    altitudes[4] = np.nextafter(altitudes[4], np.inf)
    frame["altitude_m"] = altitudes
    frame.to_parquet(directory / "cases.parquet")
    # without the database, `replay` reads the rows from the table
    (directory / "cases.sqlite").unlink()
    assert replay(directory, 4).differing == ("altitude_m",)
    with pytest.raises(CampaignError, match="has no case 12; allowed: 0 to 11"):
        replay(directory, 12)
    with pytest.raises(StoreError, match="does not contain a campaign"):
        replay(directory / "cases", 0)
