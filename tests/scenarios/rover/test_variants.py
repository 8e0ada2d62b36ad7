"""Tests of campaigns whose runs are a list, and of the rover's shadow along a shared drive."""

from typing import Any

import pytest

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.scenario import RoverScenario, SharedDriveParameters, SharedDriveScenario
from marsyard.sim.streams import Streams
from tests.scenarios.rover.short_run import SHORT_RUN

VARIANTS: list[dict[str, Any]] = [
    {"diameter_m": 0.18, "leg": {"goal_m": 2.0}},
    {"diameter_m": 1.0, "leg": {"goal_m": 2.0, "visual_odometry": True}, "incline": {"name": "ramp", "slope_deg": 9.0}},
]


def test_variant_replaces_leg_ground_and_rock() -> None:
    p = RoverScenarioParameters.model_validate({**SHORT_RUN, "variants": VARIANTS, "variant": 1})
    selected = RoverScenario().check_parameters(p)
    assert [leg.visual_odometry for leg in selected.legs] == [True]
    assert (selected.target.diameter_m, selected.target.shape) == (1.0, 8)
    assert (selected.world.incline.slope_deg, selected.world.samples) == (9.0, 1024)
    # selected parameters have no variants; a second check does not change them
    assert RoverScenario().check_parameters(selected) == selected
    with pytest.raises(ValueError, match="variant is 2; allowed: 0 to 1"):
        RoverScenarioParameters.model_validate({**SHORT_RUN, "variants": VARIANTS, "variant": 2})


def test_regression_campaign_has_the_14_runs_of_the_paper() -> None:
    """Six ways of driving on level ground and visual odometry on the ramp, to a small and to a large rock."""
    campaign = load_campaign("vtt-regression")
    assert campaign.configuration.cases == 14
    scenario = RoverScenario()
    runs = [scenario.check_parameters(campaign.parameters(case)) for case in range(14)]
    legs = [run.legs[0] for run in runs]
    assert (
        len({(run.target.diameter_m, run.world.incline.name, leg) for run, leg in zip(runs, legs, strict=True)}) == 14
    )
    ramp = [leg for run, leg in zip(runs, legs, strict=True) if run.world.incline.slope_deg]
    # wheel odometry does not measure the slip on a slope
    assert [(leg.visual_odometry, leg.autonav) for leg in ramp] == [(True, False)] * 2


def test_shadow_of_a_shared_drive_does_not_depend_on_the_tracker() -> None:
    """The sun is 30 deg high behind the rover: at the last stop the mast shades the middle of the rock."""
    settings: dict[str, Any] = {
        "drive": {
            **SHORT_RUN,
            "start": {"distance_m": 2.6},
            "sun": {"hour_angle_deg_min": 0.0},
            "legs": [{"motion": "approach", "goal_m": 1.3, "step_fraction": 0.25, "steps": 2}],
            "algorithm": "tests.scenarios.rover.trackers:LosingTracker",
        },
        "variants": [
            {"diameter_m": 0.8, "height_m": 0.4, "shape": 8, "sun_azimuth_deg": 270.0, "sun_elevation_deg": 30.0}
        ],
        "targets": [{"across": 0.0, "up": 0.5}],
    }
    scenario = SharedDriveScenario()
    row = scenario.run(SharedDriveParameters.model_validate(settings), Streams(1, "shared shadow", 0)).row
    # the tracker loses the target at the second stop, before the shadow arrives
    assert not row["tracked"]
    assert (row["rover_shadow_on_target"], row["no_rover_shadow_on_target"]) == (True, False)
    settings["drive"] = {**settings["drive"], "rover_shadow": False}
    row = scenario.run(SharedDriveParameters.model_validate(settings), Streams(1, "shared shadow", 0)).row
    assert not row["rover_shadow_on_target"]
