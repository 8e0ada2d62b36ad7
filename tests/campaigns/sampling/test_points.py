"""Tests of `Point`, a case as a point in standard normal space: distributions, correlation, nominal values and text.

The arguments of a point are its coordinates, the number of its random streams, and the paths with nominal values.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm, spearmanr

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.sampling.points import Point

CAMPAIGN = """
name = "points"
scenario = "tests.campaigns.fake_scenario:FakeScenario"
cases = 4

[parameters]
altitude_m = 1234.0

[dispersions]
"wind.east_m_s" = { distribution = "uniform", low = -30.0, high = 30.0 }
"wind.north_m_s" = { distribution = "normal", mean = 0.0, sd = 5.0 }
altitude_m = { distribution = "normal", mean = "2000 + wind.east_m_s", sd = 10.0 }
terrain = { distribution = "integer", low = 0, high = 3 }
kind = { distribution = "choice", values = ["rough", "plain"], weights = [1, 3] }

[[correlations]]
parameters = ["wind.east_m_s", "wind.north_m_s"]
rank = [[1.0, 0.6], [0.6, 1.0]]
"""


@pytest.fixture
def campaign_path(tmp_path: Path) -> Path:
    path = tmp_path / "points.toml"
    path.write_text(CAMPAIGN)
    return path


def test_points_have_the_distributions_of_the_cases(campaign_path: Path) -> None:
    campaign, rng = load_campaign(str(campaign_path)), np.random.default_rng(1)
    # five dispersions; the tolerances are three to four standard errors of 2000 points
    values = [campaign.draws_at(Point(tuple(rng.standard_normal(5)), 0)) for _ in range(2000)]
    east, north = (np.array([value[path] for value in values]) for path in ("wind.east_m_s", "wind.north_m_s"))
    assert np.quantile(east, [0.1, 0.5, 0.9]) == pytest.approx([-24.0, 0.0, 24.0], abs=2.0)
    assert spearmanr(east, north).statistic == pytest.approx(0.6, abs=0.05)
    assert np.mean([value["kind"] == "plain" for value in values]) == pytest.approx(0.75, abs=0.04)
    residuals = [value["altitude_m"] - 2000.0 - value["wind.east_m_s"] for value in values]
    assert np.std(residuals) == pytest.approx(10.0, rel=0.06)


def test_coordinates_are_quantiles_of_the_standard_normal_distribution(campaign_path: Path) -> None:
    campaign = load_campaign(str(campaign_path))
    values = campaign.draws_at(Point((1.0, 0.0, -2.0, 0.0, 0.0), 7))
    assert values["wind.east_m_s"] == pytest.approx(-30.0 + 60.0 * norm.cdf(1.0))
    assert values["altitude_m"] == pytest.approx(2000.0 + values["wind.east_m_s"] - 20.0)


def test_nominal_paths_have_the_parameters_of_the_campaign(campaign_path: Path) -> None:
    campaign = load_campaign(str(campaign_path))
    values = campaign.draws_at(Point((1.0, 1.0, 1.0, 1.0, 1.0), 0, ("altitude_m", "kind")))
    assert (values["altitude_m"], values["kind"]) == (1234.0, "plain")
    assert campaign.parameters_at(Point((0.0,) * 5, 0)).model_dump()["terrain"] in range(4)


def test_extreme_coordinates_have_finite_values(campaign_path: Path) -> None:
    campaign = load_campaign(str(campaign_path))
    for extreme in (-40.0, 40.0):
        values = campaign.draws_at(Point((extreme,) * 5, 0))
        assert all(np.isfinite(value) for value in values.values() if isinstance(value, float))


def test_point_round_trips_as_text() -> None:
    for blend in ((), ((3, 0.8), (12, 0.6))):
        point = Point((0.1, -1.0 / 3.0), 12, ("a.b",), blend=blend)
        assert Point.read(point.text) == point
    with pytest.raises(ValueError, match="not a point"):
        Point.read("[1, 2]")
