"""Tests of studies on the systems of Marsyard: requirements with margins, and cases without sources of error."""

from __future__ import annotations

import math

import pytest

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.definition.margins import compute_margin
from marsyard.campaigns.sampling.points import Point
from marsyard.campaigns.studies.budget import active_sources
from marsyard.scenarios.systems import systems

#: Small campaigns that each render cases of one scenario.
CAMPAIGNS = {
    "dimes-smoke": ("terrain.samples=512",),
    "hda-benign": ("terrain.samples=512",),
    "vtt-montecarlo": ("world.samples=512", "start.distance_m=2.4", "target.diameter_m=0.5"),
}


@pytest.mark.parametrize("system", ["dimes", "vtt", "hda"])
def test_each_system_has_requirements_with_margins_and_error_sources(system: str) -> None:
    (names,) = [item.campaigns for item in systems() if item.name == system]
    n_with_margin = 0
    for name in names:
        campaign = load_campaign(name)
        requirements = campaign.configuration.requirements
        n_with_margin += any(item.bound is not None or item.margin is not None for item in requirements)
        assert len(active_sources(campaign)[0]) >= 3, name  # error sources that have an effect in this campaign
    assert n_with_margin >= 1


@pytest.mark.slow
@pytest.mark.parametrize("name", CAMPAIGNS)
def test_case_of_each_system_runs_without_its_error_sources(name: str) -> None:
    """A case at a point is deterministic, has a margin, and changes if all sources of error are removed.

    A small step of its random streams changes it as well.
    """
    campaign = load_campaign(name, CAMPAIGNS[name])
    removed = tuple(source.name for source in active_sources(campaign)[0])
    requirement = next(item for item in campaign.configuration.requirements if item.bound or item.margin)
    rows = []
    step = ((3, 0.995), (4, math.sqrt(1.0 - 0.995**2)))
    for sources, blend in (((), ()), (removed, ()), ((), ()), ((), step)):
        point = Point((0.1,) * len(campaign.drawn_paths), 3, (), sources, blend)
        parameters = campaign.parameters_at(point)
        for shared_input in campaign.scenario.shared_inputs(parameters):
            campaign.scenario.prepare(parameters, shared_input)
        result = campaign.scenario.run(parameters, campaign.streams_at(point))
        row = {column: value for column, value in result.row.items() if "time" not in column}
        rows.append({"outcome": str(result.outcome), "answered": result.answered, **row})
        assert not math.isnan(compute_margin(rows[-1], requirement))
    assert rows[0] == pytest.approx(rows[2], nan_ok=True)
    assert rows[0] != rows[1]
    assert rows[0] != rows[3]
