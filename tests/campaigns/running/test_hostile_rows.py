"""Tests that cases with invalid rows or closed files are recorded as crashed, with reason and conditions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from marsyard.reports.campaign import write_report
from marsyard.reports.stored import read_run
from marsyard.reports.verdicts import Status, evaluate_requirements
from tests.campaigns.fake_campaign import RecordingWatch, read_case_rows, run, write_campaign
from tests.campaigns.hostile_scenario import FAULTS

pytestmark = pytest.mark.filterwarnings("ignore:Failed to kill subprocesses")

HEAD = """
name = "hostile"
scenario = "tests.campaigns.hostile_scenario:HostileScenario"
cases = 24
"""
REQUIREMENTS = """
[[requirements]]
id = "error"
metric = "velocity_error_m_s"
bound = 5.0
probability = 0.9
confidence = 0.9
population = "near"
"""
#: Recorded error of each fault; other cases are valid.
REASONS = {
    "text in a metric": "column velocity_error_m_s contains 'small'; error needs a number",
    "text in a population": "column near contains 'yes'; error needs true or false",
    "int of 400 digits": "column number contains an integer of 1329 bits",
    "int of 5000 digits": "column velocity_error_m_s contains an integer of 16610 bits",
    "closes files": "the case closed or replaced the worker's file descriptors",
    "error without a message": "SilentError (its message cannot be formatted)",
    "raises": "ValueError: the algorithm raised",
    "exits": "the worker process died: EXIT (3)",
    "list in a column": "column text contains a list",
}


@pytest.fixture(scope="module")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run a campaign with two cases per fault on two workers."""
    folder = tmp_path_factory.mktemp("hostile")
    path = write_campaign(folder, head=HEAD, dispersions="", requirement=REQUIREMENTS)
    return run(path, folder / "hostile", RecordingWatch())


@pytest.fixture(scope="module")
def rows(hostile: Path) -> list[Any]:
    return list(read_case_rows(hostile))


def test_campaign_continues_and_reports_the_reason(rows: list[Any]) -> None:
    assert len(rows) == 2 * len(FAULTS)
    for row in rows:
        reason = REASONS.get(FAULTS[row["case"] % len(FAULTS)])
        assert row["outcome"] == ("CRASHED" if reason else row["outcome"]), row
        assert (reason or "") in row["error"], row
        assert reason is not None or (row["outcome"].startswith("VALID") and row["error"] == ""), row


def test_conditions_of_crashed_cases_are_kept(rows: list[Any]) -> None:
    """Conditions are also stored for cases whose process died."""
    assert [(row["near"], row["height_m"]) for row in rows] == [(True, 10.0 + row["case"]) for row in rows]


def test_crashed_cases_stay_in_their_populations(hostile: Path) -> None:
    stored = read_run(hostile)
    (verdict,) = evaluate_requirements(stored.frame, stored.requirements)
    assert (verdict.status, verdict.n, verdict.failures) == (Status.FAIL, 24, 2 * len(REASONS))


def test_report_of_hostile_campaign_is_written(hostile: Path) -> None:
    write_report(hostile)
    assert "the algorithm raised" in (hostile / "report.html").read_text(encoding="utf-8")
