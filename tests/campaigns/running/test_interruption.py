"""Tests of interrupted campaigns and of failing cases: no row is lost, and the rows of other cases are unchanged."""

import os
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.execution.workers import LocalExecutor
from marsyard.campaigns.running.engine import resume_campaign
from marsyard.campaigns.running.replay import differing_columns
from marsyard.campaigns.store import record
from marsyard.campaigns.store.table import refresh_table
from tests.campaigns.execution.items import has_ended
from tests.campaigns.fake_campaign import CampaignFile, RecordingWatch, read_case_rows, run
from tests.campaigns.killing import kill_and_resume, start_program


def _start_campaign(path: Path, directory: Path, **environment: str) -> subprocess.Popen[bytes]:
    """Run a campaign of 500 cases in a process; return the process as soon as rows are stored."""
    return start_program(
        ["run", path, "--jobs", "2", "--set", "sleep_s=0.2", "-n", "500"],
        directory,
        env={**os.environ, **environment},
        # processes started in the background ignore SIGINT by default
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def _find_workers(process: subprocess.Popen[bytes]) -> list[int]:
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    return [int(child) for child in children if "loky_posix" in Path(f"/proc/{child}/cmdline").read_text()]


@pytest.mark.slow
@pytest.mark.parametrize("signal_number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_interrupted_campaign_keeps_its_rows(campaign_file: CampaignFile, tmp_path: Path, signal_number: int) -> None:
    process = _start_campaign(campaign_file(dispersions=""), tmp_path / "run")
    workers = _find_workers(process)
    process.send_signal(signal_number)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130
    assert re.search(rb"interrupted; the rows so far are in \S+ \(\d+ of 500\)\. To continue: marsyard resume ", errors)
    assert b"Traceback" not in errors
    stored_record = record.read(tmp_path / "run")
    assert stored_record["state"] == "interrupted"
    refresh_table(tmp_path / "run")
    assert 0 < stored_record["cases_finished"] == len(read_case_rows(tmp_path / "run")) < 500
    assert (tmp_path / "run" / "cases.sqlite").exists()
    assert len(workers) == 2
    assert all(map(has_ended, workers))


def _find_marked_processes(mark: str) -> list[int]:
    """Return the ids of running processes whose environment contains the text `mark`."""
    processes = []
    for process in Path("/proc").glob("[1-9]*"):
        with suppress(OSError):
            if mark.encode() in (process / "environ").read_bytes() and not has_ended(int(process.name)):
                processes.append(int(process.name))
    return processes


@pytest.mark.parametrize(
    ("signal_number", "parameters"),
    [
        pytest.param(signal.SIGINT, "", marks=pytest.mark.slow),
        pytest.param(signal.SIGTERM, "", marks=pytest.mark.slow),
        pytest.param(signal.SIGKILL, "", marks=pytest.mark.slow),
        (signal.SIGKILL, "stopping_cases = [0, 1, 2, 3, 4, 5]"),
    ],
)
def test_all_processes_end_with_the_campaign(
    campaign_file: CampaignFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, signal_number: int, parameters: str
) -> None:
    """Processes in separate sessions also end, and temporary files are removed.

    After SIGKILL, the next executor removes the temporary folder.
    """
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    path = campaign_file(f"forking_cases = [0, 1, 2, 3, 4, 5]\n{parameters}", dispersions="")
    process = _start_campaign(path, tmp_path / "run", TMPDIR=str(temporary), MARSYARD_TEST_RUN=str(tmp_path))
    process.send_signal(signal_number)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == (-9 if signal_number == signal.SIGKILL else 130)
    assert (b"interrupted; the rows so far" in errors) == (signal_number != signal.SIGKILL)
    deadline = time.monotonic() + 10.0
    while _find_marked_processes(str(tmp_path)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert _find_marked_processes(str(tmp_path)) == []
    if signal_number == signal.SIGKILL:
        monkeypatch.setattr("tempfile.tempdir", str(temporary))
        with LocalExecutor(1):
            assert len(list(temporary.iterdir())) == 1
    assert list(temporary.iterdir()) == []


def test_second_interruption_ends_the_program() -> None:
    program = """
import signal, sys, time
from marsyard.cli.execution import stop_on_signals
with stop_on_signals():
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
    for word in (b"ready", b"stopping"):
        assert process.stdout.readline().strip() == word
        process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert (process.returncode, errors) == (130, b"killed\n")


@pytest.mark.slow
def test_changes_of_the_worker_process_are_reported(
    failing_campaign: Path, campaign_file: CampaignFile, tmp_path: Path, watch: RecordingWatch
) -> None:
    path = campaign_file("state_changing_cases = [1, 7]\nforking_cases = [4]\nunanswered_cases = [2]")
    rows = read_case_rows(run(path, tmp_path / "run", watch, "retain.showcase=none", jobs=2))
    assert sorted(watch.notes) == [
        "case 1 changed its worker process: the working folder",
        "case 4 changed its worker process: child processes that are still running (python)",
        "case 7 changed its worker process: the working folder",
    ]
    # cases 3 and 5 of `failing_campaign` crash
    for row, expected_row in zip(rows, read_case_rows(failing_campaign), strict=True):
        assert row["case"] in (3, 5) or differing_columns(row, expected_row) == ()


@pytest.mark.slow
def test_failing_cases_do_not_affect_other_cases(
    failing_campaign: Path, campaign_file: CampaignFile, tmp_path: Path, watch: RecordingWatch
) -> None:
    faults = {
        "raising_cases": (0, "CRASHED"),
        "aborting_cases": (1, "CRASHED"),
        "exiting_cases": (4, "CRASHED"),
        "looping_cases": (7, "TIMED_OUT"),
        "allocating_cases": (8, "OUT_OF_MEMORY"),
        "flooding_cases": (9, "TOO_MUCH_OUTPUT"),
    }
    parameters = "\n".join(f"{name} = [{case}]" for name, (case, _) in faults.items())
    limits = "[limits]\ncase_time_s = 4\nmemory_gb = 0.25\noutput_mb = 0.1"
    path = campaign_file(f"{parameters}\nunanswered_cases = [2]", extra_tables=limits)
    rows = read_case_rows(run(path, tmp_path / "hostile", watch, "retain.showcase=none", jobs=2))
    expected = dict(faults.values())
    outcomes = {row["case"]: row["outcome"] for row in rows if row["outcome"] not in ("VALID", "SILENT")}
    assert outcomes == expected
    # the other cases have the rows of `failing_campaign`, whose cases 3 and 5 crash
    for row, expected_row in zip(rows, read_case_rows(failing_campaign), strict=True):
        assert row["case"] in (*expected, 3, 5) or differing_columns(row, expected_row) == ()
    stored_record = record.read(tmp_path / "hostile")
    assert stored_record["state"] == "finished"
    assert (stored_record["cases_finished"], stored_record["cases_crashed"]) == (12, 6)
    # each failed case has an error and a trace; case 4 exits without a trace
    assert all(rows[case]["error"] and "fake_scenario.py" in rows[case]["traceback"] for case in expected if case != 4)
    # only the case that timed out runs again
    rows_before = read_case_rows(tmp_path / "hostile")
    resume_campaign(tmp_path / "hostile", ExecutorConfig(1), watch, retry=["timed-out"], case_time_s=1.0)
    assert read_case_rows(tmp_path / "hostile")[7]["error"] == "took longer than its limit of 1 s"
    for row_before, row in zip(rows_before, read_case_rows(tmp_path / "hostile"), strict=True):
        assert row["case"] == 7 or str(row) == str(row_before)
    assert [session["command"] for session in record.read(tmp_path / "hostile")["sessions"]] == ["run", "resume"]


@pytest.mark.slow
def test_resumed_campaign_has_the_same_rows(campaign_file: CampaignFile, tmp_path: Path, watch: RecordingWatch) -> None:
    path = campaign_file("sleep_s = 0.02", requirement="")
    arguments = ["run", path, "-n", "150", "--set", "retain.showcase=none"]
    result = kill_and_resume(arguments, tmp_path / "killed", log_bytes=17_000)
    # exit code 3: no verdict on requirements
    assert result.returncode in (0, 3), result.stderr
    expected_rows = read_case_rows(run(path, tmp_path / "run", watch, "cases=150", "retain.showcase=none", jobs=2))
    resumed_rows = read_case_rows(tmp_path / "killed")
    assert [differing_columns(*pair) for pair in zip(resumed_rows, expected_rows, strict=True)] == [()] * 150
    first, *later = record.read(tmp_path / "killed")["sessions"]
    assert first["command"] == "run"
    assert {session["command"] for session in later} == {"resume"}
