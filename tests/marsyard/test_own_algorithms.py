"""Algorithms of one's own on the command line: the protocol's suite, cases to be answered elsewhere, their scores."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from marsyard.cli.app import app
from tests.campaigns.fake_campaign import rows_of

pytestmark = [
    pytest.mark.filterwarnings("ignore:Failed to kill subprocesses"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning:matplotlib"),
]

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


def test_the_suite_outlives_what_it_examines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "hostile_here.py").write_text(HOSTILE)
    monkeypatch.chdir(tmp_path)
    ended = CliRunner().invoke(app, ["conformance", "hostile_here:Hostile", "--time-limit", "3"])
    assert ended.exit_code == 1
    assert "FAIL dark" in ended.output
    assert "CRASHED: the worker process died: SIGABRT (-6)" in ended.output
    assert "FAIL saturated" in ended.output
    assert "TIMED_OUT: took longer than its limit of 11 s" in ended.output
    assert "next: no picture may make it hang" in ended.output
    assert "7 of 9 checks passed" in ended.output


LEAVING = """
import os, threading, time
from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome

class Leaving:
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


def test_the_suite_ends_and_finds_what_an_algorithm_changes_in_its_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "leaving_here.py").write_text(LEAVING)
    monkeypatch.chdir(tmp_path)
    ended = CliRunner().invoke(app, ["conformance", "leaving_here:Leaving"])
    assert ended.exit_code == 1, ended.output
    assert ended.output.count("it changed the state of its process: the working folder") == 3
    assert "child processes that it left running (python)" in ended.output
    assert "threads that it left running (Thread-" in ended.output
    assert "next: set it back before returning" in ended.output
    assert "6 of 9 checks passed" in ended.output


def test_the_suite_for_programs() -> None:
    ended = CliRunner().invoke(app, ["conformance", "phase-correlation", "--json"])
    assert ended.exit_code == 0
    reported = json.loads(ended.output)
    assert (reported["algorithm"], reported["task"], reported["passed"], len(reported["checks"])) == (
        "phase-correlation",
        "velocity",
        True,
        9,
    )
    assert all(check["passed"] and check["asked"] for check in reported["checks"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["vt"], "unknown algorithm 'vt'"),
        (["vtt", "--task", "flying"], "--task flying: unknown; allowed: velocity, tracking, landing"),
        (["dimes", "--task", "landing"], "unknown algorithm 'dimes'"),
        (["nowhere:Nothing"], "no algorithm at 'nowhere:Nothing'"),
        (["exec:./nothing"], "is not there, or may not be run"),
    ],
)
def test_what_is_no_algorithm_is_reported(arguments: list[str], message: str) -> None:
    ended = CliRunner().invoke(app, ["conformance", *arguments])
    assert ended.exit_code == 2
    assert message in ended.output


def test_cases_are_exported_answered_and_scored(tmp_path: Path) -> None:
    campaign, cases, table = tmp_path / "fake.toml", tmp_path / "cases", tmp_path / "answers.csv"
    campaign.write_text(CAMPAIGN)
    ended = CliRunner().invoke(app, ["export", str(campaign), "--out", str(cases), "--jobs", "1"])
    assert ended.exit_code == 0, ended.output
    assert f"their truth, not to be handed away: {cases}-truth" in ended.output
    assert len(list((cases / "cases").iterdir())) == 2
    table.write_text("case,velocity_east_m_s,velocity_north_m_s\n0,12.5,-7\n")
    ended = CliRunner().invoke(app, ["score", str(cases), str(table)])
    assert ended.exit_code == 2
    assert "no answer to 1 of 2 cases: 1" in ended.output
    table.write_text("case,velocity_east_m_s,velocity_north_m_s\n0,12.5,-7\n1,12,-7\n")
    ended = CliRunner().invoke(app, ["score", str(cases), str(table), "--out", str(tmp_path / "scored"), "--jobs", "1"])
    assert ended.exit_code == 0, ended.output
    assert "verdict: PASS" in ended.output
    assert [row["velocity_error_m_s"] for row in rows_of(tmp_path / "scored")] == [0.5, 0.0]
    assert (tmp_path / "scored" / "report.html").exists()
