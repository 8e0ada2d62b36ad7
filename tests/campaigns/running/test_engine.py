"""Campaigns run to their end whatever their cases do, and give the same rows however they are run."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from fake_campaign import Silence, write_campaign

from campaigns.definition.identity import package_versions
from campaigns.definition.loading import load_campaign
from campaigns.errors import CampaignError, ConfigurationError, StoreError
from campaigns.execution.crew import Crew
from campaigns.running.engine import append_cases, check_metrics, resume_campaign, run_campaign
from campaigns.running.estimate import estimate
from campaigns.running.replay import differing_columns, replay
from campaigns.store import record
from campaigns.store.lock import folder_lock
from campaigns.store.products import load_products
from campaigns.store.rows import RowStore, create_store
from campaigns.store.table import read_rows, refresh_table, write_table
from campaigns.store.worst import showcase_case, worst_cases

CampaignFile = Callable[..., Path]
TROUBLE = "raising_cases = [3]\naborting_cases = [5, 6]\nsilent_cases = [2]"
FILES = ["campaign.json", "campaign.lock", "cases", "cases.parquet", "cases.sqlite"]

pytestmark = pytest.mark.filterwarnings("ignore:Failed to kill subprocesses")


def rows_of(directory: Path) -> list[Mapping[str, Any]]:
    return read_rows(directory / "cases.parquet")


def run(path: Path, directory: Path, watch: Silence, *overrides: str, jobs: int = 2) -> Path:
    run_campaign(load_campaign(str(path), overrides), directory, Crew(jobs), watch)
    return directory


@pytest.fixture(scope="module")
def troubled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A campaign in which one case raises, two abort their process and one has no answer; to be left as it is."""
    folder = tmp_path_factory.mktemp("campaign")
    return run(write_campaign(folder, TROUBLE), folder / "troubled", Silence())


def test_a_troubled_campaign_comes_to_its_end(
    troubled: Path, campaign_file: CampaignFile, tmp_path: Path, watch: Silence
) -> None:
    rows = rows_of(troubled)
    assert [row["case"] for row in rows] == list(range(12))
    outcomes = [row["outcome"] for row in rows]
    assert [case for case, outcome in enumerate(outcomes) if outcome == "CRASHED"] == [3, 5, 6]
    assert outcomes[2] == "SILENT"
    assert not rows[2]["answered"]
    assert rows[3]["error"] == "ZeroDivisionError: case 3 of <object object at 0x...>"
    assert "in run" in rows[3]["traceback"]
    assert rows[5]["error"] == "the worker process died: SIGABRT (-6)"
    assert "fake_scenario.py" in rows[5]["traceback"]
    # One worker, and a rerun of any case alone, give the same rows; healthy cases do not notice the others.
    single = rows_of(run(campaign_file(TROUBLE), tmp_path / "single", watch, jobs=1))
    assert [differing_columns(row, other) for row, other in zip(rows, single, strict=True)] == [()] * 12
    healthy = rows_of(run(campaign_file("silent_cases = [2]"), tmp_path / "healthy", watch))
    for case in (0, 1, 2, 4, 7, 8, 9, 10, 11):
        assert differing_columns(rows[case], healthy[case]) == ()
    for case in (3, 5, 7):
        replayed = replay(troubled, case)
        assert replayed.stored is not None
        assert replayed.differing == ()
    assert watch.notes == []


def test_the_table_keeps_types_and_nan(troubled: Path) -> None:
    schema = pq.read_schema(troubled / "cases.parquet")
    kinds = {name: str(schema.field(name).type) for name in schema.names}
    assert list(kinds)[:3] == ["case", "outcome", "answered"]
    assert list(kinds)[-4:] == ["wall_time_s", "cpu_time_s", "error", "traceback"]
    expected = {"case": "int64", "answered": "bool", "velocity_error_m_s": "double", "terrain": "int64"}
    assert expected.items() <= kinds.items()
    assert (kinds["kind"], kinds["clear"], kinds["wall_time_s"]) == ("string", "bool", "double")
    frame = pd.read_parquet(troubled / "cases.parquet")
    assert frame["velocity_error_m_s"].isna().tolist() == [case in (2, 3, 5, 6) for case in range(12)]
    assert pq.read_table(troubled / "cases.parquet")["velocity_error_m_s"].null_count == 0
    assert frame["error"][0] == ""


def test_the_record_says_what_was_run(troubled: Path) -> None:
    stored = record.read(troubled)
    assert (stored["schema"], stored["state"], stored["exit_code"]) == (1, "finished", None)
    assert (stored["cases_finished"], stored["cases_crashed"], stored["seed"]) == (12, 3, 5)
    assert stored["configuration"]["parameters"]["lowest_altitude_m"] == 0.0
    assert stored["configuration"]["dispersions"]["wind.east_m_s"]["source"] == "test"
    assert stored["requirements"][0]["population"] == "all"
    assert stored["versions"]["numpy"] == np.__version__
    assert {"python", "platform", "processor", "processor_features"} <= set(stored["environment"])
    assert stored["started_utc"] <= stored["finished_utc"]
    assert sorted(path.name for path in troubled.iterdir()) == FILES


def test_the_worst_answered_case_is_kept_for_show(troubled: Path) -> None:
    rows = rows_of(troubled)
    worst = max((row for row in rows if row["answered"]), key=lambda row: row["velocity_error_m_s"])["case"]
    assert record.read(troubled)["showcase"] == worst
    kept = troubled / "cases" / str(worst)
    assert differing_columns(json.loads((kept / "row.json").read_text()), rows[worst]) == ()
    products = load_products(kept)
    assert products["picture"].dtype == np.uint16
    assert products["picture"].tolist() == [[0, 1, 2], [3, 4, 5]]
    assert np.array_equal(products["nested"][0]["x"], np.eye(2))
    assert products["title"] == "a"


def test_which_case_is_shown(campaign_file: CampaignFile, tmp_path: Path) -> None:
    rows: list[dict[str, Any]] = [
        {"case": 0, "outcome": "CRASHED", "answered": False},
        {"case": 1, "outcome": "SILENT", "answered": False, "velocity_error_m_s": math.nan},
        {"case": 2, "outcome": "VALID", "answered": True, "velocity_error_m_s": 1.0},
        {"case": 3, "outcome": "VALID", "answered": True, "velocity_error_m_s": -2.0},
    ]
    create_store(tmp_path / "cases.sqlite", {})
    with RowStore(tmp_path / "cases.sqlite") as store:
        table = tmp_path / "cases.parquet"
        store.add(rows[:1])
        write_table(table, store, ["velocity_error_m_s"])
        worst = load_campaign(str(campaign_file()), ["retain.worst=9"]).configuration
        first = load_campaign(str(campaign_file()), ["retain.showcase=first"]).configuration
        none = load_campaign(str(campaign_file()), ["retain.showcase=none"]).configuration
        unasked = load_campaign(str(campaign_file(requirement=""))).configuration
        assert showcase_case(worst, table, store) is None
        store.add(rows[1:2])
        write_table(table, store)
        assert showcase_case(worst, table, store) == 1
        store.add(rows[2:])
        write_table(table, store)
        assert [showcase_case(asked, table, store) for asked in (worst, first, none, unasked)] == [3, 1, None, 1]
    assert [worst_cases(asked, table) for asked in (worst, unasked)] == [[3, 2], []]


def test_products_that_cannot_be_kept_stop_nothing(campaign_file: CampaignFile, tmp_path: Path, watch: Silence) -> None:
    directory = run(campaign_file(), tmp_path / "run", watch, "products=bad", "cases=2", jobs=1)
    assert record.read(directory)["state"] == "finished"
    assert "products.thing is a object; allowed" in watch.notes[0]


def test_threads_and_hashes_are_pinned_in_workers(troubled: Path) -> None:
    rows = [row for row in rows_of(troubled) if row["outcome"] != "CRASHED"]
    assert {row["threads"] for row in rows} == {"1"}
    assert len({row["hash_of_text"] for row in rows}) == 1


def test_shared_inputs_are_prepared_once(campaign_file: CampaignFile, tmp_path: Path, watch: Silence) -> None:
    stated = f"shared = 3\ncache = '{tmp_path}'"
    run(campaign_file(stated), tmp_path / "run", watch, "cases=1", "retain.showcase=none")
    assert len(list(tmp_path.glob("shared-*"))) == 3
    assert watch.steps == {"preparing": 3, "cases": 1}


def test_shared_inputs_that_fail_are_noted(campaign_file: CampaignFile, tmp_path: Path, watch: Silence) -> None:
    run(campaign_file("shared = 1\nfail_prepare = true"), tmp_path / "run", watch, "cases=1", jobs=1)
    note = "shared input 0 could not be prepared: OSError: no room for the terrain"
    assert watch.notes == [note]


def test_a_folder_with_a_campaign_is_refused(
    campaign_file: CampaignFile, troubled: Path, tmp_path: Path, watch: Silence
) -> None:
    before = {path: path.stat().st_mtime_ns for path in troubled.rglob("*")}
    with pytest.raises(StoreError, match="already holds a campaign"):
        run(campaign_file(), troubled, watch)
    assert {path: path.stat().st_mtime_ns for path in troubled.rglob("*")} == before
    for name in ("report.html", "cases.sqlite"):
        (tmp_path / name).mkdir()
        (tmp_path / name / name).touch()
        with pytest.raises(StoreError, match=name):
            run(campaign_file(), tmp_path / name, watch)
    with pytest.raises(StoreError, match="cannot be written"):
        run(campaign_file(), tmp_path / "fake.toml" / "run", watch)


def test_a_metric_that_no_case_has_stops_the_campaign_early(
    campaign_file: CampaignFile, tmp_path: Path, watch: Silence
) -> None:
    requirement = "[[requirements]]\nid='a'\nmetric='velocity_eror_m_s'\nbound=1\nprobability=0.9\nconfidence=0.9"
    with pytest.raises(ConfigurationError) as caught:
        run(campaign_file(requirement=requirement), tmp_path / "run", watch, jobs=1)
    assert "unknown column of numbers 'velocity_eror_m_s' (did you mean 'velocity_error_m_s'?)" in str(caught.value)
    assert record.read(tmp_path / "run")["state"] == "interrupted"
    refresh_table(tmp_path / "run")
    assert len(rows_of(tmp_path / "run")) == 1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("metric='velocity_error_m_s'", "[0].metric: unknown column of true and false 'velocity_error_m_s'"),
        ("metric='answered'\nbound=1", "[0].metric: unknown column of numbers 'answered'"),
        ("metric='answered'\npopulation='valid and rom'", "[0].population: unknown column of true and false 'rom'"),
    ],
)
def test_requirements_ask_for_columns_of_their_kind(campaign_file: CampaignFile, change: str, said: str) -> None:
    requirement = f"[[requirements]]\nid='a'\nprobability=0.9\nconfidence=0.9\n{change}"
    configuration = load_campaign(str(campaign_file(requirement=requirement))).configuration
    row = {"case": 0, "answered": True, "velocity_error_m_s": 1.0}
    with pytest.raises(ConfigurationError, match=re.escape(said)):
        check_metrics(configuration, row, Path("runs"))


def test_where_every_case_crashes_the_metric_still_has_its_column(
    campaign_file: CampaignFile, tmp_path: Path, watch: Silence
) -> None:
    directory = run(campaign_file("raising_cases = [0, 1]"), tmp_path / "run", watch, "cases=2", jobs=1)
    frame = pd.read_parquet(directory / "cases.parquet")
    assert frame["velocity_error_m_s"].isna().all()
    assert record.read(directory)["showcase"] is None


def test_replay_says_what_differs(troubled: Path, tmp_path: Path) -> None:
    troubled = shutil.copytree(troubled, tmp_path / "copy")
    frame = pd.read_parquet(troubled / "cases.parquet")
    frame.loc[4, "altitude_m"] = np.nextafter(frame.loc[4, "altitude_m"], np.inf)
    frame.to_parquet(troubled / "cases.parquet")
    (troubled / "cases.sqlite").unlink()
    assert replay(troubled, 4).differing == ("altitude_m",)
    with pytest.raises(CampaignError, match="has no case 12; allowed: 0 to 11"):
        replay(troubled, 12)
    with pytest.raises(StoreError, match="does not hold a campaign"):
        replay(troubled / "cases", 0)


def _started(path: Path, directory: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "marsyard", "run", str(path), "--jobs", "2", "--out", str(directory)]
    process = subprocess.Popen(
        [*command, "--set", "sleep_s=0.2", "-n", "500"],
        stderr=subprocess.PIPE,
        # what a script starts in the background ignores Ctrl-C, and so would its children
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 180.0
    # The write-ahead log has two pages (of 4 KiB and a header) for the empty table, and more with the first rows.
    log = directory / "cases.sqlite-wal"
    while not (log.exists() and log.stat().st_size > 4 * 4200) and time.monotonic() < deadline:
        time.sleep(0.05)
    return process


def _children(process: subprocess.Popen[bytes]) -> list[int]:
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    return [int(child) for child in children if "loky_posix" in Path(f"/proc/{child}/cmdline").read_text()]


def _gone(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except OSError:
        return True


@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_campaign_keeps_its_rows(campaign_file: CampaignFile, tmp_path: Path, kind: int) -> None:
    process = _started(campaign_file(dispersions=""), tmp_path / "run")
    workers = _children(process)
    process.send_signal(kind)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130
    assert re.search(rb"interrupted; the rows so far are in \S+ \(\d+ of 500\)\. To go on: marsyard resume ", errors)
    assert b"Traceback" not in errors
    stored = record.read(tmp_path / "run")
    assert stored["state"] == "interrupted"
    refresh_table(tmp_path / "run")
    assert 0 < stored["cases_finished"] == len(rows_of(tmp_path / "run")) < 500
    assert (tmp_path / "run" / "cases.sqlite").exists()
    assert len(workers) == 2
    assert all(map(_gone, workers))


def test_workers_go_with_a_killed_parent(campaign_file: CampaignFile, tmp_path: Path) -> None:
    process = _started(campaign_file(dispersions=""), tmp_path / "run")
    workers = _children(process)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    deadline = time.monotonic() + 10.0
    while not all(map(_gone, workers)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert len(workers) == 2
    assert all(map(_gone, workers))


def test_hostile_cases_come_to_the_right_outcomes_and_touch_no_other(
    troubled: Path, campaign_file: CampaignFile, tmp_path: Path, watch: Silence
) -> None:
    hostile = {
        "raising_cases": (0, "CRASHED"),
        "aborting_cases": (1, "CRASHED"),
        "leaving_cases": (4, "CRASHED"),
        "looping_cases": (7, "TIMED_OUT"),
        "swelling_cases": (8, "OUT_OF_MEMORY"),
        "chatting_cases": (9, "TOO_MUCH_OUTPUT"),
    }
    stated = "\n".join(f"{name} = [{case}]" for name, (case, _) in hostile.items())
    limits = "[limits]\ncase_time_s = 4\nmemory_gb = 0.25\noutput_mb = 0.1"
    path = campaign_file(f"{stated}\nsilent_cases = [2]", more=limits)
    rows = rows_of(run(path, tmp_path / "hostile", watch, "retain.showcase=none"))
    expected = dict(hostile.values())
    ended = {row["case"]: row["outcome"] for row in rows if row["outcome"] not in ("VALID", "SILENT")}
    assert ended == expected
    for row, other in zip(rows, rows_of(troubled), strict=True):
        assert row["case"] in (*expected, 3, 5, 6) or differing_columns(row, other) == ()
    stored = record.read(tmp_path / "hostile")
    assert (stored["state"], stored["cases_finished"], stored["cases_crashed"]) == ("finished", 12, 6)
    # Each says what happened and where it stood.
    assert all(rows[case]["error"] and "fake_scenario.py" in rows[case]["traceback"] for case in expected if case != 4)
    # With more time the slow ones are run again, and the others stay as they are.
    before = rows_of(tmp_path / "hostile")
    resume_campaign(tmp_path / "hostile", Crew(1), watch, retry=["timed-out"], case_time_s=1.0)
    assert rows_of(tmp_path / "hostile")[7]["error"] == "took longer than its limit of 1 s"
    for row, other in zip(before, rows_of(tmp_path / "hostile"), strict=True):
        assert row["case"] == 7 or str(row) == str(other)
    assert [session["command"] for session in record.read(tmp_path / "hostile")["sessions"]] == ["run", "resume"]


def _killed_and_resumed(path: Path, directory: Path, cases: int, kills: int, rng: np.random.Generator) -> int:
    """Runs a campaign whose runner is killed at random moments; returns how often that came before its end."""
    program = [sys.executable, "-m", "marsyard"]
    command = [*program, "run", str(path), "--jobs", "2", "-n", str(cases), "--out", str(directory)]
    command += ["--set", "retain.showcase=none"]
    killed = 0
    for _ in range(kills):
        process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL)
        while process.poll() is None and not (directory / "campaign.json").exists():
            time.sleep(0.02)
        time.sleep(rng.uniform(0.3, 3.0))
        killed += process.poll() is None
        process.kill()
        process.communicate()
        command = [*program, "resume", str(directory), "--jobs", "2", "--allow-changed"]
    ended = subprocess.run(command, capture_output=True, text=True)
    assert ended.returncode in (0, 3), ended.stderr
    return killed


def test_a_killed_campaign_is_resumed_to_the_same_rows(
    campaign_file: CampaignFile, tmp_path: Path, watch: Silence
) -> None:
    path = campaign_file("sleep_s = 0.02", requirement="")
    assert _killed_and_resumed(path, tmp_path / "killed", 150, 2, np.random.default_rng(8)) >= 1
    undisturbed = rows_of(run(path, tmp_path / "run", watch, "cases=150", "retain.showcase=none"))
    resumed = rows_of(tmp_path / "killed")
    assert [differing_columns(*pair) for pair in zip(resumed, undisturbed, strict=True)] == [()] * 150
    first, *later = record.read(tmp_path / "killed")["sessions"]
    assert first["command"] == "run"
    assert {session["command"] for session in later} == {"resume"}


@pytest.fixture
def done(campaign_file: CampaignFile, tmp_path: Path, watch: Silence) -> Path:
    """A small finished campaign, to be spoilt."""
    return run(campaign_file("raising_cases = [2]"), tmp_path / "done", watch, "cases=4", jobs=1)


def test_cases_are_added_behind_those_there_are(
    done: Path, campaign_file: CampaignFile, tmp_path: Path, watch: Silence
) -> None:
    before = [str(row) for row in rows_of(done)]
    append_cases(done, 3, Crew(1), watch)
    append_cases(done, 1, Crew(2), watch)
    rows = rows_of(done)
    assert [str(row) for row in rows[:4]] == before
    stored = record.read(done)
    assert (stored["cases"], stored["state"], stored["configuration"]["appended"]) == (8, "finished", [3, 1])
    # Independent draws: what is added is what a larger campaign has had from the start.
    whole = rows_of(run(campaign_file("raising_cases = [2]"), tmp_path / "whole", watch, "cases=8", jobs=1))
    assert [differing_columns(*pair) for pair in zip(rows, whole, strict=True)] == [()] * 8
    assert replay(done, 7).differing == ()
    with pytest.raises(CampaignError, match="0 cases cannot be added"):
        append_cases(done, 0, Crew(1), watch)


def test_crashed_cases_are_run_again_on_request(done: Path, watch: Silence) -> None:
    times = {row["case"]: row["wall_time_s"] for row in rows_of(done)}
    resume_campaign(done, Crew(1), watch)
    assert {row["case"]: row["wall_time_s"] for row in rows_of(done)} == times
    resume_campaign(done, Crew(1), watch, retry=["crashed"])
    again = {row["case"]: row["wall_time_s"] for row in rows_of(done)}
    assert [case for case in times if again[case] != times[case]] == [2]


def test_other_programs_do_not_go_on_unasked(done: Path, watch: Silence, monkeypatch: pytest.MonkeyPatch) -> None:
    real = package_versions()
    monkeypatch.setattr("campaigns.definition.identity.package_versions", lambda: {**real, "numpy": "0.9"})
    before = {path: path.read_bytes() for path in done.glob("c*.*")}
    said = rf"Changed:\n  numpy \({np.__version__}, now 0.9\)\nTo go on nevertheless.*--allow-changed"
    for act in (lambda: resume_campaign(done, Crew(1), watch), lambda: append_cases(done, 2, Crew(1), watch)):
        with pytest.raises(CampaignError, match=said):
            act()
    assert {path: path.read_bytes() for path in before} == {
        **before,
        done / "campaign.lock": before[done / "campaign.lock"],
    }
    append_cases(done, 2, Crew(1), watch, allow_changed=True)
    (change,) = record.read(done)["changes"]
    assert (change["cases_before"], change["in"]) == (4, [f"numpy ({np.__version__}, now 0.9)"])
    assert record.read(done)["identity"]["versions"]["numpy"] == "0.9"


def test_a_changed_configuration_is_no_longer_the_campaigns(done: Path, watch: Silence) -> None:
    text = (done / "campaign.json").read_text()
    (done / "campaign.json").write_text(text.replace('"altitude_m": 2000.0', '"altitude_m": 2001.0'))
    with pytest.raises(CampaignError, match="configuration \\("):
        resume_campaign(done, Crew(1), watch)


def test_a_store_of_another_campaign_is_refused(
    done: Path, campaign_file: CampaignFile, tmp_path: Path, watch: Silence
) -> None:
    other = run(campaign_file(""), tmp_path / "other", watch, "cases=1", "seed=77", jobs=1)
    shutil.copy(other / "cases.sqlite", done / "cases.sqlite")
    with pytest.raises(StoreError, match="belong to different campaigns"):
        resume_campaign(done, Crew(1), watch)


def test_two_runners_do_not_share_a_folder(done: Path, watch: Silence) -> None:
    with folder_lock(done):
        for act in (lambda: resume_campaign(done, Crew(1), watch), lambda: append_cases(done, 2, Crew(1), watch)):
            with pytest.raises(StoreError, match="is in use"):
                act()


@pytest.mark.parametrize(
    ("kept", "cases"),
    [
        (["retain.products=all"], [0, 1, 3, 4, 5]),
        (["retain.products=every", "retain.every=3"], [0, 3]),
        (["retain.products=failed"], [1]),
        (["retain.products=worst", "retain.worst=2"], None),
        (["retain.products=all", "retain.budget_gb=1e-6"], [0]),
    ],
)
def test_products_are_kept_as_asked(
    campaign_file: CampaignFile, tmp_path: Path, watch: Silence, kept: list[str], cases: list[int] | None
) -> None:
    path = campaign_file("silent_cases = [1]\nraising_cases = [2]")
    directory = run(path, tmp_path / "run", watch, "cases=6", "retain.showcase=none", *kept, jobs=1)
    rows = rows_of(directory)
    if cases is None:
        answered = [row for row in rows if row["answered"]]
        cases = sorted(row["case"] for row in sorted(answered, key=lambda row: -row["velocity_error_m_s"])[:2])
    found = sorted(int(path.name) for path in (directory / "cases").iterdir())
    assert found == cases
    for case in found:
        assert load_products(directory / "cases" / str(case))["title"] == "a"
        kept_row = json.loads((directory / "cases" / str(case) / "row.json").read_text())
        assert differing_columns(kept_row, rows[case]) == ()
    assert [note for note in watch.notes if "budget" in note] == (
        ["the budget for kept products (retain.budget_gb) is used up: none is kept from case 1 on"]
        if "retain.budget_gb=1e-6" in kept
        else []
    )


def test_a_trial_says_what_a_campaign_would_take(campaign_file: CampaignFile) -> None:
    campaign = load_campaign(str(campaign_file("sleep_s = 0.05")), ["cases=1000", "retain.products=all"])
    found = estimate(campaign, jobs=2)
    assert (found.trials, found.unfinished) == (9, 0)
    assert 0.05 <= found.case_s < 0.5
    assert found.time_s == pytest.approx(1000 * found.case_s / 2)
    # a row of some 15 columns, products of some kilobytes
    assert 1e5 < found.rows_bytes < 1e6
    assert 5e5 < found.products_bytes < 5e6
