"""Tests of numbers `in-turn` (a new terrain for each case) in studies: they belong to the random streams."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.workers import ExecutorConfig
from marsyard.campaigns.sampling.points import POINT_COLUMN, Point
from marsyard.campaigns.studies.runner import Candidate, prepare_campaign
from marsyard.campaigns.studies.search import SearchSettings, start_search, write_regression_campaigns
from marsyard.campaigns.studies.subset import NEW_STREAM
from tests.campaigns.fake_campaign import REQUIREMENT, RecordingWatch, read_case_rows, write_campaign

#: Streams of case 5, blended with new ones.
BLEND = ((5, 0.8), (NEW_STREAM, 0.6))
DISPERSIONS = """
[dispersions]
altitude_m = {distribution = "normal", mean = 2000, sd = 100, truncate = [1700, 2200]}
terrain = {distribution = "in-turn", low = 0, high = "HIGH"}
"""


def load_fake_campaign(folder: Path, high: int, bound: float = 5.0) -> Campaign:
    """Load a campaign whose terrains are the numbers up to `high`, in turn."""
    dispersions, requirement = DISPERSIONS.replace("HIGH", str(high)), REQUIREMENT.replace("5.0", str(bound))
    return load_campaign(str(write_campaign(folder, dispersions=dispersions, requirement=requirement)))


def test_terrain_follows_the_number_of_the_streams(tmp_path: Path) -> None:
    campaign = prepare_campaign(load_fake_campaign(tmp_path, 99_999), 20_000)
    # a new case, a case with blended streams (a step of a Markov chain), and a case with the streams of case 3
    first, blended, repeated = (
        candidate.point(17) for candidate in (Candidate((0.0,)), Candidate((0.0,), blend=BLEND), Candidate((0.0,), 3))
    )
    assert [campaign.draws_at(point)["terrain"] for point in (first, blended, repeated)] == [17, 17, 3]


def test_reduced_violation_keeps_its_terrain(tmp_path: Path) -> None:
    campaign = load_fake_campaign(tmp_path, 99_999, bound=0.5)
    settings = SearchSettings("velocity", cases=20, restarts=1, max_failures=1)
    result = start_search(campaign, settings, 500, tmp_path / "run", ExecutorConfig(1), RecordingWatch())
    rows = {int(row["case"]): row for row in read_case_rows(tmp_path / "run")}
    assert all(row["terrain"] == Point.read(str(row[POINT_COLUMN])).stream for row in rows.values())
    (failure,) = result.failures
    assert failure.values["terrain"] == rows[failure.case]["terrain"] == rows[failure.original_case]["terrain"]
    (path,) = write_regression_campaigns(campaign, result, tmp_path / "run")
    assert tomllib.loads(path.read_text())["parameters"]["terrain"] == failure.values["terrain"]


def test_numbers_that_repeat_within_the_study_are_rejected(tmp_path: Path) -> None:
    campaign = load_fake_campaign(tmp_path, 9)
    assert prepare_campaign(campaign, 10).drawn_paths == ("altitude_m",)
    with pytest.raises(CampaignError, match=r"dispersions\.terrain: the 10 values .* repeat within 11 cases; extend"):
        prepare_campaign(campaign, 11)


@pytest.mark.parametrize("name", ["dimes-gusev", "dimes-smoke", "loc-jezero", "vtt-terrains"])
def test_campaigns_with_a_terrain_for_each_case_can_be_studied(name: str) -> None:
    """20,000 is the default limit of `marsyard rare`."""
    campaign = prepare_campaign(load_campaign(name), 20_000)
    assert not {"location.terrain", "world.terrain"} & set(campaign.drawn_paths)
