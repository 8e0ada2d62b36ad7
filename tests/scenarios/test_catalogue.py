"""Test that the requirements of the catalogue's campaigns use columns that their scenarios report."""

from __future__ import annotations

from pathlib import Path

import pytest

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.running.engine import check_metrics
from marsyard.campaigns.store.rows import Row
from marsyard.scenarios.rover.scenario import SharedDriveParameters, SharedDriveScenario
from marsyard.scenarios.systems import catalogue, systems
from marsyard.sim.streams import Streams


def _run_small_case(scenario: str) -> Row:
    """Return the row of a small case of a scenario."""
    if scenario == "rover-drive":
        result = SharedDriveScenario().run(_make_short_drive(), Streams(1, "catalogue", 0))
    else:
        small_campaigns = {
            load_campaign(name, settings).configuration.scenario: (name, settings)
            for system in systems()
            for name, settings in system.compilation_campaigns.items()
        }
        # The field test has no small campaign: its first case is run.
        campaign = load_campaign(*small_campaigns.get(scenario, ("dimes-fieldtest", ())))
        result = campaign.scenario.run(campaign.parameters(0), campaign.streams(0))
    return {"case": 0, "outcome": result.outcome, "answered": result.answered, **result.row}


def _make_short_drive() -> SharedDriveParameters:
    """Return a drive of one step with the step ranges of all campaigns, because each is a column."""
    range_names = {
        step_range["name"]
        for campaign in _list_campaigns("rover-drive")
        for step_range in _read_parameters(campaign)["step_ranges"]
    }
    return SharedDriveParameters.model_validate(
        {
            "drive": {
                "world": {"samples": 512, "bank": 1},
                "start": {"distance_m": 3.6},
                "legs": [{"motion": "circle", "step_deg": 5.0, "steps": 1}],
            },
            "variants": [{"diameter_m": 0.8, "height_m": 0.5, "shape": 8, "yaw_deg": 30.0, "sun_azimuth_deg": 260.0}],
            "targets": [{"across": 0.0, "up": 0.5}],
            "step_ranges": [{"name": name, "min": 0.0, "max": 10.0} for name in sorted(range_names)],
        }
    )


def _read_parameters(campaign: str) -> dict[str, list[dict[str, str]]]:
    return dict(load_campaign(campaign).configuration.parameters)


def _list_campaigns(scenario: str) -> list[str]:
    return [name for name in catalogue() if load_campaign(name).configuration.scenario == scenario]


@pytest.mark.slow
@pytest.mark.parametrize(
    "scenario", ["descent", pytest.param("fieldtest", marks=pytest.mark.slow), "rover", "rover-drive", "landing"]
)
def test_requirements_use_columns_of_their_scenario(scenario: str) -> None:
    row = _run_small_case(scenario)
    for name in _list_campaigns(scenario):
        check_metrics(load_campaign(name).configuration, row, Path(name))
