"""Tests of custom algorithms on the command line: conformance checks, exported cases and scores."""

import json
from pathlib import Path

import pytest

from tests.campaigns.fake_campaign import read_case_rows
from tests.command import run_command

#: Estimator that never returns for a saturated image (counts above 4000) and aborts for a dark image.
HOSTILE = """
import os, re
from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome

class Hostile:
    def estimate(self, measurements):
        level = int(measurements.images[0].counts.min())
        if level == measurements.images[0].counts.max():
            if level > 4000:
                re.match("(a+)+$", "a" * 64 + "b")
            if level < 100:
                os.abort()
        return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None)
"""
CAMPAIGN = """
name = "fake-velocity"
scenario = "tests.campaigns.fake_velocity:FakeVelocityScenario"
cases = 2
[[requirements]]
id = "v"
metric = "velocity_error_m_s"
bound = 5.0
probability = 0.2
confidence = 0.5
"""


@pytest.mark.slow
def test_conformance_survives_crashes_and_hangs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "hostile.py").write_text(HOSTILE)
    monkeypatch.chdir(tmp_path)
    status, output = run_command("conformance", "hostile:Hostile", "--time-limit", "1")
    assert status == 1
    assert "FAIL dark" in output
    assert "CRASHED: the worker process died: SIGABRT (-6)" in output
    assert "FAIL saturated" in output
    # a check may take 5 s plus two calls of 1 s
    assert "TIMED_OUT: took longer than its limit of 7 s" in output
    assert "to fix: it must return within the limits of time and memory" in output
    assert "8 of 10 checks passed" in output


#: Estimator that changes its working folder for uniform images, and starts a process and a thread for saturated ones.
STATE_CHANGING = """
import os, threading, time
from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome

class StateChanging:
    def estimate(self, measurements):
        level = int(measurements.images[0].counts.min())
        if level == measurements.images[0].counts.max():
            if level > 4000 and os.fork() == 0:
                os.setsid()
                time.sleep(3600)
            if level > 4000:
                threading.Thread(target=time.sleep, args=(3600,)).start()
            os.chdir("/")
        return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None)
"""


@pytest.mark.slow
def test_conformance_reports_changed_process_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "state_changing.py").write_text(STATE_CHANGING)
    monkeypatch.chdir(tmp_path)
    status, output = run_command("conformance", "state_changing:StateChanging")
    assert status == 1, output
    # three uniform images: featureless, dark and saturated
    assert output.count("it changed the state of its process: the working folder") == 3
    assert "child processes that are still running (python)" in output
    assert "threads that are still running (Thread-" in output
    assert "to fix: restore the state before returning" in output
    assert "7 of 10 checks passed" in output


def test_conformance_is_printed_as_json() -> None:
    status, output = run_command("conformance", "phase-correlation", "--json")
    assert status == 0
    report = json.loads(output)
    assert [report[key] for key in ("algorithm", "task", "passed")] == ["phase-correlation", "velocity", True]
    assert [bool(check["passed"] and check["requirement"]) for check in report["checks"]] == [True] * 9


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["vt"], "unknown algorithm 'vt'"),
        (["vtt", "--task", "flying"], "--task flying: unknown; allowed: velocity, tracking, landing"),
        (["dimes", "--task", "landing"], "unknown algorithm 'dimes'"),
        (["nowhere:Nothing"], "cannot import algorithm 'nowhere:Nothing'"),
        (["exec:./nothing"], "does not exist or is not executable"),
    ],
)
def test_unknown_algorithms_are_rejected(arguments: list[str], message: str) -> None:
    status, output = run_command("conformance", *arguments)
    assert (status, message in output) == (2, True), output


@pytest.mark.slow
def test_exported_cases_are_scored(tmp_path: Path) -> None:
    campaign, cases, table = tmp_path / "fake.toml", tmp_path / "cases", tmp_path / "answers.csv"
    campaign.write_text(CAMPAIGN)
    status, output = run_command("export", campaign, "--out", cases, "--jobs", 1)
    assert status == 0, output
    assert f"ground truth (do not distribute with the cases): {cases}-truth" in output
    assert len(list((cases / "cases").iterdir())) == 2
    table.write_text("case,velocity_east_m_s,velocity_north_m_s\n0,12.5,-7\n")
    status, output = run_command("score", cases, table)
    assert status == 2
    assert "no answer to 1 of 2 cases: 1" in output
    # the true velocity is 12 m/s east and 7 m/s south
    table.write_text("case,velocity_east_m_s,velocity_north_m_s\n0,12.5,-7\n1,12,-7\n")
    status, output = run_command("score", cases, table, "--out", tmp_path / "scored", "--jobs", 1)
    assert status == 0, output
    assert "verdict: PASS (exploration)" in output
    assert [row["velocity_error_m_s"] for row in read_case_rows(tmp_path / "scored")] == [0.5, 0.0]
    assert (tmp_path / "scored" / "report.html").exists()
