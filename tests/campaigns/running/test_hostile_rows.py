"""No row and no closed file stops a campaign: the case is recorded as crashed, with its reason and its conditions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from marsyard.reports.campaign import write_report
from marsyard.reports.stored import read_run
from marsyard.reports.verdicts import Status, judge_campaign
from tests.campaigns.fake_campaign import Silence, rows_of, run, write_campaign
from tests.campaigns.hostile_scenario import DEEDS

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
#: What the error of each deed's case says; of those that are left out the case is whole.
REASONS = {
    "text in a metric": "column velocity_error_m_s holds 'small'; error needs a number",
    "text in a population": "column near holds 'yes'; error needs true or false",
    "int of 400 digits": "column number holds an integer of 1329 bits",
    "int of 5000 digits": "column velocity_error_m_s holds an integer of 16610 bits",
    "closes files": "the case closed or replaced the worker's file descriptors",
    "error without a message": "SilentError, whose message cannot be had",
    "raises": "ValueError: the algorithm raised",
    "exits": "the worker process died: EXIT (3)",
    "list in a column": "column text holds a list",
}


@pytest.fixture(scope="module")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every deed twice, in one campaign of two workers."""
    folder = tmp_path_factory.mktemp("hostile")
    path = write_campaign(folder, head=HEAD, dispersions="", requirement=REQUIREMENTS)
    return run(path, folder / "hostile", Silence())


@pytest.fixture(scope="module")
def rows(hostile: Path) -> list[Any]:
    return list(rows_of(hostile))


def test_the_campaign_continues_and_reports_the_reason(rows: list[Any]) -> None:
    assert len(rows) == 2 * len(DEEDS)
    for row in rows:
        reason = REASONS.get(DEEDS[row["case"] % len(DEEDS)])
        assert row["outcome"] == ("CRASHED" if reason else row["outcome"]), row
        assert (reason or "") in row["error"], row
        assert reason is not None or (row["outcome"].startswith("VALID") and row["error"] == ""), row


def test_conditions_of_crashed_cases_are_kept(rows: list[Any]) -> None:
    """Also those of a case whose process ended."""
    assert [(row["near"], row["height_m"]) for row in rows] == [(True, 10.0 + row["case"]) for row in rows]


def test_crashed_cases_stay_in_their_populations(hostile: Path) -> None:
    stored = read_run(hostile)
    (verdict,) = judge_campaign(stored.frame, stored.requirements)
    assert (verdict.status, verdict.n, verdict.failures) == (Status.FAIL, 24, 2 * len(REASONS))


def test_a_report_is_written(hostile: Path) -> None:
    write_report(hostile)
    assert "the algorithm raised" in (hostile / "report.html").read_text(encoding="utf-8")
