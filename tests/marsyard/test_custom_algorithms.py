"""Tests of custom algorithms on the command line: conformance checks, exported cases and scores."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from marsyard.cli.app import app
from tests.campaigns.fake_campaign import read_case_rows

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
    result = CliRunner().invoke(app, ["conformance", "hostile:Hostile", "--time-limit", "1"])
    assert result.exit_code == 1
    assert "FAIL dark" in result.output
    assert "CRASHED: the worker process died: SIGABRT (-6)" in result.output
    assert "FAIL saturated" in result.output
    # a check may take 5 s plus two calls of 1 s
    assert "TIMED_OUT: took longer than its limit of 7 s" in result.output
    assert "to fix: it must return within the limits of time and memory" in result.output
    assert "7 of 9 checks passed" in result.output


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
    result = CliRunner().invoke(app, ["conformance", "state_changing:StateChanging"])
    assert result.exit_code == 1, result.output
    # three uniform images: featureless, dark and saturated
    assert result.output.count("it changed the state of its process: the working folder") == 3
    assert "child processes that are still running (python)" in result.output
    assert "threads that are still running (Thread-" in result.output
    assert "to fix: restore the state before returning" in result.output
    assert "7 of 10 checks passed" in result.output


def test_conformance_is_printed_as_json() -> None:
    result = CliRunner().invoke(app, ["conformance", "phase-correlation", "--json"])
    assert result.exit_code == 0
    conformance_report = json.loads(result.output)
    assert (
        conformance_report["algorithm"],
        conformance_report["task"],
        conformance_report["passed"],
        len(conformance_report["checks"]),
    ) == ("phase-correlation", "velocity", True, 9)
    assert all(check["passed"] and check["requirement"] for check in conformance_report["checks"])


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
    result = CliRunner().invoke(app, ["conformance", *arguments])
    assert result.exit_code == 2
    assert message in result.output


@pytest.mark.slow
def test_exported_cases_are_scored(tmp_path: Path) -> None:
    campaign, cases, table = tmp_path / "fake.toml", tmp_path / "cases", tmp_path / "answers.csv"
    campaign.write_text(CAMPAIGN)
    result = CliRunner().invoke(app, ["export", str(campaign), "--out", str(cases), "--jobs", "1"])
    assert result.exit_code == 0, result.output
    assert f"ground truth (do not distribute with the cases): {cases}-truth" in result.output
    assert len(list((cases / "cases").iterdir())) == 2
    table.write_text("case,velocity_east_m_s,velocity_north_m_s\n0,12.5,-7\n")
    result = CliRunner().invoke(app, ["score", str(cases), str(table)])
    assert result.exit_code == 2
    assert "no answer to 1 of 2 cases: 1" in result.output
    # the true velocity is 12 m/s east and 7 m/s south
    table.write_text("case,velocity_east_m_s,velocity_north_m_s\n0,12.5,-7\n1,12,-7\n")
    result = CliRunner().invoke(
        app, ["score", str(cases), str(table), "--out", str(tmp_path / "scored"), "--jobs", "1"]
    )
    assert result.exit_code == 0, result.output
    assert "verdict: PASS (exploration)" in result.output
    assert [row["velocity_error_m_s"] for row in read_case_rows(tmp_path / "scored")] == [0.5, 0.0]
    assert (tmp_path / "scored" / "report.html").exists()
