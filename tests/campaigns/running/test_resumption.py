"""Cases are appended to a finished campaign, or run again; a changed program needs permission."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from marsyard.campaigns.definition.identity import read_versions
from marsyard.campaigns.errors import CampaignError, StoreError
from marsyard.campaigns.execution.workers import ExecutorConfig
from marsyard.campaigns.running.engine import append_cases, resume_campaign
from marsyard.campaigns.running.replay import differing_columns, replay
from marsyard.campaigns.store import record
from marsyard.campaigns.store.record import folder_lock
from tests.campaigns.fake_campaign import Silence, rows_of, run

CampaignFile = Callable[..., Path]


@pytest.fixture
def done(campaign_file: CampaignFile, tmp_path: Path, watch: Silence) -> Path:
    """A small finished campaign, to be spoilt."""
    return run(campaign_file("raising_cases = [2]"), tmp_path / "done", watch, "cases=4", jobs=1)


def test_appended_cases_follow_the_existing_ones(
    done: Path, campaign_file: CampaignFile, tmp_path: Path, watch: Silence
) -> None:
    before = [str(row) for row in rows_of(done)]
    append_cases(done, 3, ExecutorConfig(1), watch)
    append_cases(done, 1, ExecutorConfig(2), watch)
    rows = rows_of(done)
    assert [str(row) for row in rows[:4]] == before
    stored = record.read(done)
    assert (stored["cases"], stored["state"], stored["configuration"]["appended"]) == (8, "finished", [3, 1])
    # Independent draws: what is added is what a larger campaign has had from the start.
    whole = rows_of(run(campaign_file("raising_cases = [2]"), tmp_path / "whole", watch, "cases=8", jobs=1))
    assert [differing_columns(*pair) for pair in zip(rows, whole, strict=True)] == [()] * 8
    assert replay(done, 7).differing == ()
    with pytest.raises(CampaignError, match="0 cases cannot be added"):
        append_cases(done, 0, ExecutorConfig(1), watch)


def test_resume_of_a_finished_campaign_does_no_work(
    done: Path, watch: Silence, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {name: (done / name).stat().st_mtime_ns for name in ("campaign.json", "cases.parquet")}
    record_before = record.read(done)
    watch.steps.clear()

    def forbidden(*_: object) -> None:
        raise AssertionError("a worker is started")

    monkeypatch.setattr("marsyard.campaigns.running.engine.create_executor", forbidden)
    resume_campaign(done, ExecutorConfig(1), watch)
    assert watch.notes[-1] == "the campaign is finished: all 4 cases have rows; nothing is run"
    assert watch.steps == {}
    assert {name: (done / name).stat().st_mtime_ns for name in before} == before
    assert record.read(done) == record_before


def test_crashed_cases_are_run_again_on_request(done: Path, watch: Silence) -> None:
    times = {row["case"]: row["wall_time_s"] for row in rows_of(done)}
    resume_campaign(done, ExecutorConfig(1), watch)
    assert {row["case"]: row["wall_time_s"] for row in rows_of(done)} == times
    resume_campaign(done, ExecutorConfig(1), watch, retry=["crashed"])
    again = {row["case"]: row["wall_time_s"] for row in rows_of(done)}
    assert [case for case in times if again[case] != times[case]] == [2]


def test_changed_programs_resume_only_if_allowed(done: Path, watch: Silence, monkeypatch: pytest.MonkeyPatch) -> None:
    real = read_versions()
    monkeypatch.setattr("marsyard.campaigns.definition.identity.read_versions", lambda: {**real, "numpy": "0.9"})
    before = {path: path.read_bytes() for path in done.glob("c*.*")}
    message = rf"Changed:\n  numpy \({np.__version__}, now 0.9\)\nTo continue nevertheless.*--allow-changed"
    acts: tuple[Callable[[], None], ...] = (
        lambda: resume_campaign(done, ExecutorConfig(1), watch),
        lambda: append_cases(done, 2, ExecutorConfig(1), watch),
    )
    for act in acts:
        with pytest.raises(CampaignError, match=message):
            act()
    assert {path: path.read_bytes() for path in before} == {
        **before,
        done / "campaign.lock": before[done / "campaign.lock"],
    }
    append_cases(done, 2, ExecutorConfig(1), watch, allow_changed=True)
    (change,) = record.read(done)["changes"]
    assert (change["cases_before"], change["in"]) == (4, [f"numpy ({np.__version__}, now 0.9)"])
    assert record.read(done)["identity"]["versions"]["numpy"] == "0.9"


def test_a_changed_configuration_is_refused(done: Path, watch: Silence) -> None:
    text = (done / "campaign.json").read_text()
    (done / "campaign.json").write_text(text.replace('"altitude_m": 2000.0', '"altitude_m": 2001.0'))
    with pytest.raises(CampaignError, match="configuration \\("):
        resume_campaign(done, ExecutorConfig(1), watch)


def test_a_store_of_another_campaign_is_refused(
    done: Path, campaign_file: CampaignFile, tmp_path: Path, watch: Silence
) -> None:
    other = run(campaign_file(""), tmp_path / "other", watch, "cases=1", "seed=77", jobs=1)
    shutil.copy(other / "cases.sqlite", done / "cases.sqlite")
    with pytest.raises(StoreError, match="belong to different campaigns"):
        resume_campaign(done, ExecutorConfig(1), watch)


def test_two_runners_do_not_share_a_folder(done: Path, watch: Silence) -> None:
    with folder_lock(done):
        acts: tuple[Callable[[], None], ...] = (
            lambda: resume_campaign(done, ExecutorConfig(1), watch),
            lambda: append_cases(done, 2, ExecutorConfig(1), watch),
        )
        for act in acts:
            with pytest.raises(StoreError, match="is in use"):
                act()
