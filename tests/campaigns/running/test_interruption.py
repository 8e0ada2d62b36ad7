"""Interrupted and killed runners, and hostile cases, lose no rows and affect no other case."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from marsyard.campaigns.execution.workers import ExecutorConfig, LocalExecutor
from marsyard.campaigns.running.engine import resume_campaign
from marsyard.campaigns.running.replay import differing_columns
from marsyard.campaigns.store import record
from marsyard.campaigns.store.table import refresh_table
from tests.campaigns.fake_campaign import Silence, rows_of, run

CampaignFile = Callable[..., Path]

pytestmark = pytest.mark.filterwarnings("ignore:Failed to kill subprocesses")


def _started(path: Path, directory: Path, **environment: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "marsyard", "run", str(path), "--jobs", "2", "--out", str(directory)]
    process = subprocess.Popen(
        [*command, "--set", "sleep_s=0.2", "-n", "500"],
        stderr=subprocess.PIPE,
        env={**os.environ, **environment},
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
    assert re.search(rb"interrupted; the rows so far are in \S+ \(\d+ of 500\)\. To continue: marsyard resume ", errors)
    assert b"Traceback" not in errors
    stored = record.read(tmp_path / "run")
    assert stored["state"] == "interrupted"
    refresh_table(tmp_path / "run")
    assert 0 < stored["cases_finished"] == len(rows_of(tmp_path / "run")) < 500
    assert (tmp_path / "run" / "cases.sqlite").exists()
    assert len(workers) == 2
    assert all(map(_gone, workers))


def test_workers_end_with_a_killed_parent(campaign_file: CampaignFile, tmp_path: Path) -> None:
    process = _started(campaign_file(dispersions=""), tmp_path / "run")
    workers = _children(process)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    deadline = time.monotonic() + 10.0
    while not all(map(_gone, workers)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert len(workers) == 2
    assert all(map(_gone, workers))


def _marked(mark: str) -> list[int]:
    """Processes that were started with a variable in their environment."""
    found = []
    for process in Path("/proc").glob("[1-9]*"):
        with suppress(OSError):
            if mark.encode() in (process / "environ").read_bytes() and not _gone(int(process.name)):
                found.append(int(process.name))
    return found


@pytest.mark.parametrize(
    ("kind", "also"),
    [
        (signal.SIGINT, ""),
        (signal.SIGTERM, ""),
        (signal.SIGKILL, ""),
        (signal.SIGKILL, "stopping_cases = [0, 1, 2, 3, 4, 5]"),
    ],
)
def test_no_process_outlives_a_killed_or_interrupted_runner(
    campaign_file: CampaignFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: int, also: str
) -> None:
    """Neither processes in sessions of their own that hold the worker's files, nor temporary files.

    The folder of a runner that was killed is gone at the latest when the next one begins.
    """
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    path = campaign_file(f"forking_cases = [0, 1, 2, 3, 4, 5]\n{also}", dispersions="")
    process = _started(path, tmp_path / "run", TMPDIR=str(temporary), MARSYARD_TEST_RUN=str(tmp_path))
    process.send_signal(kind)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == (-9 if kind == signal.SIGKILL else 130)
    assert (b"interrupted; the rows so far" in errors) == (kind != signal.SIGKILL)
    deadline = time.monotonic() + 10.0
    while _marked(str(tmp_path)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert _marked(str(tmp_path)) == []
    if kind == signal.SIGKILL:
        monkeypatch.setattr("tempfile.tempdir", str(temporary))
        with LocalExecutor(1):
            assert len(list(temporary.iterdir())) == 1
    assert list(temporary.iterdir()) == []


def test_a_second_interruption_ends_the_program_at_once() -> None:
    program = """
import signal, sys, time
from marsyard.cli.campaign import stopped_by_signals
with stopped_by_signals():
    try:
        print("ready", flush=True)
        time.sleep(3600)
    except KeyboardInterrupt:
        print("stopping", flush=True)
        time.sleep(3600)
"""
    process = subprocess.Popen(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert process.stdout is not None
    for word in (b"ready", b"stopping"):
        assert process.stdout.readline().strip() == word
        process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert (process.returncode, errors) == (130, b"killed\n")


def test_a_case_that_changes_its_process_is_named_and_changes_no_other(
    troubled: Path, campaign_file: CampaignFile, tmp_path: Path, watch: Silence
) -> None:
    path = campaign_file("altering_cases = [1, 7]\nforking_cases = [4]\nsilent_cases = [2]")
    rows = rows_of(run(path, tmp_path / "run", watch, "retain.showcase=none"))
    assert sorted(watch.notes) == [
        "case 1 changed its worker process: the working folder",
        "case 4 changed its worker process: child processes that it left running (python)",
        "case 7 changed its worker process: the working folder",
    ]
    for row, other in zip(rows, rows_of(troubled), strict=True):
        assert row["case"] in (3, 5, 6) or differing_columns(row, other) == ()


def test_hostile_cases_have_the_right_outcomes_and_affect_no_other(
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
    resume_campaign(tmp_path / "hostile", ExecutorConfig(1), watch, retry=["timed-out"], case_time_s=1.0)
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
