"""Tests of the order of activities in a step (Fig. 12): visual odometry during the drive, tracking, navigation."""

import re

import pytest

from marsyard.scenarios.rover import run as loop
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.run import run_case
from marsyard.scenarios.rover.world import Vehicle
from marsyard.sim.streams import Streams
from tests.scenarios.rover.short_run import SHORT


def test_step_uses_previous_tracking_and_mapping(monkeypatch: pytest.MonkeyPatch) -> None:
    activities: list[str] = []

    def record_calls(kind: object, name: str, activity: str) -> None:
        before = getattr(kind, name)

        def call_and_record(*args: object, **kwargs: object) -> object:
            activities.append(activity)
            return before(*args, **kwargs)

        monkeypatch.setattr(kind, name, call_and_record)

    record_calls(loop, "map_terrain", "map")
    record_calls(Vehicle, "drive", "drive and see how far")
    record_calls(loop, "visit_stop", "track")
    leg = {"motion": "approach", "goal_m": 3.0, "step_fraction": 0.08, "autonav": True, "visual_odometry": True}
    run = run_case(RoverScenarioParameters.model_validate({**SHORT, "legs": [leg]}), Streams(1, "rover tests", 0))
    steps = re.sub("d( d)+", "d", " ".join(activity[0] for activity in activities))
    # The target is tracked first. Then each step maps, drives with visual odometry, and tracks.
    assert steps.split(" m d t")[0] == "t"
    assert set(steps.split(" m d t")[1:]) == {""}
    assert run.autonav_updates == activities.count("map") >= 2
    assert run.visual_odometry_updates == activities.count("drive and see how far")
    assert len(run.stops) == activities.count("track")
