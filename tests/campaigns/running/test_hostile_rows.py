"""Tests of cases with invalid rows or closed files: they are recorded as crashed, with reason and sampled values."""

from pathlib import Path
from typing import Any

import pytest

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.reports.campaign_report import write_report
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
DISPERSIONS = """
[dispersions]
height_m = { distribution = "uniform", low = 10.0, high = 20.0, source = "test" }
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


@pytest.fixture(scope="module")
def hostile_campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run a campaign with two cases per fault on two workers."""
    folder = tmp_path_factory.mktemp("hostile")
    path = write_campaign(folder, top_level_keys=TOP_LEVEL_KEYS, dispersions=DISPERSIONS, requirement=REQUIREMENTS)
    return run(path, folder / "hostile", RecordingWatch())


@pytest.fixture(scope="module")
def rows(hostile_campaign: Path) -> list[Any]:
    return list(read_case_rows(hostile_campaign))


def test_invalid_rows_are_recorded_as_crashed_with_reason(rows: list[Any]) -> None:
    assert len(rows) == 2 * len(FAULTS)
    for row in rows:
        reason = FAULTS[row["case"] % len(FAULTS)][1]
        assert row["outcome"][:5] == ("CRASHED"[:5] if reason else "VALID"), row
        assert reason in row["error"] if reason else row["error"] == "", row


def test_sampled_values_of_crashed_cases_are_stored(hostile_campaign: Path, rows: list[Any]) -> None:
    """Sampled values are stored even if the worker process of the case died."""
    campaign = load_campaign(str(next(hostile_campaign.parent.glob("*.toml"))))
    assert len({row["height_m"] for row in rows}) == len(rows)
    assert [row["height_m"] for row in rows] == [campaign.draws(row["case"])["height_m"] for row in rows]


def test_crashed_cases_count_as_failures_of_their_population(hostile_campaign: Path) -> None:
    stored_run = read_run(hostile_campaign)
    (verdict,) = evaluate_requirements(stored_run.frame, stored_run.requirements)
    assert (verdict.status, verdict.n, verdict.failures) == (
        Status.FAIL,
        24,
        2 * sum(bool(reason) for _, reason in FAULTS),
    )


def test_report_of_hostile_campaign_is_written(hostile_campaign: Path) -> None:
    write_report(hostile_campaign)
    assert "the algorithm raised" in (hostile_campaign / "report.html").read_text(encoding="utf-8")
