"""Tests of cases with invalid rows or closed files: they are recorded as crashed, with reason and conditions."""

from pathlib import Path
from typing import Any

import pytest

from marsyard.reports.campaign import write_report
from marsyard.reports.decision import evaluate_requirements
from marsyard.reports.stored import read_run
from marsyard.reports.verdicts import Status
from tests.campaigns.fake_campaign import RecordingWatch, read_case_rows, run, write_campaign
from tests.campaigns.hostile_scenario import FAULTS

pytestmark = pytest.mark.slow

TOP_LEVEL_KEYS = """
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
population = "is_low"
"""
#: Recorded error of each fault; cases with other faults have valid rows.
REASONS = {
    "text in a metric": "column velocity_error_m_s contains 'small'; error needs a number",
    "text in a population": "column is_low contains 'yes'; error needs true or false",
    "int of 400 digits": "column number contains an integer of 1329 bits",
    "int of 5000 digits": "column velocity_error_m_s contains an integer of 16610 bits",
    "closes files": "the case closed or replaced the worker's file descriptors",
    "error without a message": "SilentError (its message cannot be formatted)",
    "raises": "ValueError: the algorithm raised",
    "exits": "the worker process died: EXIT (3)",
    "list in a column": "column text contains a list",
}


@pytest.fixture(scope="module")
def hostile_campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run a campaign with two cases per fault on two workers."""
    folder = tmp_path_factory.mktemp("hostile")
    path = write_campaign(folder, top_level_keys=TOP_LEVEL_KEYS, dispersions="", requirement=REQUIREMENTS)
    return run(path, folder / "hostile", RecordingWatch())


@pytest.fixture(scope="module")
def rows(hostile_campaign: Path) -> list[Any]:
    return list(read_case_rows(hostile_campaign))


def test_invalid_rows_are_recorded_as_crashed_with_reason(rows: list[Any]) -> None:
    assert len(rows) == 2 * len(FAULTS)
    for row in rows:
        reason = REASONS.get(FAULTS[row["case"] % len(FAULTS)])
        if reason is None:
            assert (row["outcome"][:5], row["error"]) == ("VALID", ""), row
        else:
            assert row["outcome"] == "CRASHED", row
            assert reason in row["error"], row


def test_conditions_of_crashed_cases_are_stored(rows: list[Any]) -> None:
    """Conditions are stored even if the worker process of the case died."""
    assert [(row["is_low"], row["height_m"]) for row in rows] == [(True, 10.0 + row["case"]) for row in rows]


def test_crashed_cases_count_as_failures_of_their_population(hostile_campaign: Path) -> None:
    stored_run = read_run(hostile_campaign)
    (verdict,) = evaluate_requirements(stored_run.frame, stored_run.requirements)
    assert (verdict.status, verdict.n, verdict.failures) == (Status.FAIL, 24, 2 * len(REASONS))


def test_report_of_hostile_campaign_is_written(hostile_campaign: Path) -> None:
    write_report(hostile_campaign)
    assert "the algorithm raised" in (hostile_campaign / "report.html").read_text(encoding="utf-8")
