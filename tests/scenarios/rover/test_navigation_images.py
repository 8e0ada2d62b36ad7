"""Tests of visual odometry and terrain maps from rendered stereo pairs, and of oracles that use the truth instead."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.run import Run, map_terrain, prepare_run, run_case
from marsyard.sim.streams import Streams
from tests.scenarios.rover.short_run import SHORT_RUN

#: A rover with 30 % wheel slip on ground with rocks.
SLIPPING_ROVER: dict[str, Any] = {
    **SHORT_RUN,
    "world": {"samples": 1024, "bank": 1},
    "start": {"distance_m": 5.0},
    "slip": {"flat": 0.3, "soil_spread": 0.0, "step_spread": 0.0},
}
OBSTACLE = {"towards_start_m": 3.0, "right_m": 0.4, "diameter_m": 0.5, "height_m": 0.3}


def run_slipping_rover(seed: int = 4, **changes: Any) -> Run:
    parameters = RoverScenarioParameters.model_validate({**SLIPPING_ROVER, **changes})
    return run_case(parameters, Streams(seed, "rover tests", 0))


def _position_error_m(run: Run) -> float:
    """Compute the horizontal distance between estimated and true final position."""
    vehicle = run.vehicle
    return float(np.linalg.norm((vehicle.estimated_pose.translation - vehicle.stance.world_from_rover.translation)[:2]))


@pytest.mark.slow
def test_visual_odometry_measures_slip_and_wheel_odometry_does_not() -> None:
    leg = {"motion": "approach", "goal_m": 3.6, "step_fraction": 0.1}
    errors = {
        visual: _position_error_m(run_slipping_rover(legs=[leg | {"visual_odometry": visual}]))
        for visual in (False, True)
    }
    # The rover drives 1.4 m, and the wheel odometry measures about 2 m.
    assert errors[False] > 0.4
    # The bound is 2 % of the distance (tracking paper, section 4.2), plus a constant error per step.
    assert errors[True] < 0.02 * 1.4 + 0.03


def test_wheel_odometry_replaces_visual_odometry_without_image_overlap() -> None:
    leg = {"motion": "straight", "step_m": 3.0, "steps": 1, "visual_odometry": True, "visual_odometry_step_m": 3.0}
    run = run_slipping_rover(legs=[leg], slip={"flat": 0.01})
    assert run.visual_odometry_updates == run.visual_odometry_failures == 1
    assert _position_error_m(run) < 0.15


@pytest.mark.parametrize("map_by", ["mast", "body"])
def test_stereo_map_agrees_with_true_heights(map_by: str) -> None:
    leg = {"motion": "approach", "goal_m": 2.0, "autonav": True, "map_by": map_by}
    maps = {}
    for terrain in ("stereo", "oracle-heights"):
        changes = {"legs": [leg], "navigation": {"terrain": terrain}, "obstacles": [OBSTACLE]}
        parameters = RoverScenarioParameters.model_validate({**SLIPPING_ROVER, **changes})
        run = prepare_run(parameters, Streams(4, "rover tests", 0))
        target = run.vehicle.stance.world_from_rover.inv().apply(run.target.point_world.copy())
        map_terrain(parameters, run, parameters.legs[0], run.create_target_estimate(target))
        assert run.navigator.terrain is not None
        maps[terrain] = run.navigator.terrain
    stereo, oracle = maps["stereo"].median_m, maps["oracle-heights"].median_m
    is_in_both = np.isfinite(stereo) & np.isfinite(oracle)
    assert np.count_nonzero(is_in_both) > 100
    error_m = stereo[is_in_both] - oracle[is_in_both]
    assert abs(np.median(error_m)) < 0.02
    assert np.percentile(np.abs(error_m), 80.0) < 0.06
    # The oracle maps all ground within its range; the images show only a part of it.
    assert np.count_nonzero(np.isfinite(oracle) & ~np.isfinite(stereo)) > 0


@pytest.mark.slow
def test_rover_drives_around_an_obstacle_in_its_images() -> None:
    leg = {"motion": "approach", "goal_m": 2.0, "autonav": True}
    # with most seeds, the holes of the map stop the rover in front of the obstacle (NO_PATH)
    run = run_slipping_rover(9, legs=[leg], obstacles=[OBSTACLE], slip={"flat": 0.01}, start={"distance_m": 6.0})
    rocks = run.world.rocks
    rock_m = rocks.position_m[rocks.names["obstacle-1"], :2]
    path = [stance for stop in run.stops for drive in stop.drives for stance in drive.stances]
    closest_m = min(float(np.hypot(*(stance.world_from_rover.translation[:2] - rock_m))) for stance in path)
    assert run.outcome.name == "COMPLETED"
    # The circle around all wheels has a radius of 0.6 m.
    assert closest_m > 0.6 + 0.5 * OBSTACLE["diameter_m"] - 0.05


def test_oracles_need_no_navigation_cameras() -> None:
    leg = {"motion": "approach", "goal_m": 4.5, "autonav": True, "visual_odometry": True}
    run = run_slipping_rover(legs=[leg], navigation={"odometry": "oracle-motion", "terrain": "oracle-heights"})
    assert run.navigation_cameras.mast is run.navigation_cameras.body is None
    assert _position_error_m(run) < 0.05
