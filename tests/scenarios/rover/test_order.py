"""Tests of the order of activities in a step: mapping, drive, tracking (Fig. 12 of the tracking paper)."""

import re

import pytest

from marsyard.scenarios.rover import run as run_module
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.run import run_case
from marsyard.scenarios.rover.world import Vehicle
from marsyard.sim.streams import Streams
from tests.scenarios.rover.short_run import SHORT_RUN


def test_each_step_maps_then_drives_then_tracks(monkeypatch: pytest.MonkeyPatch) -> None:
    activities: list[str] = []

    def record_calls(owner: object, name: str, activity: str) -> None:
        original = getattr(owner, name)

        def call_and_record(*args: object, **kwargs: object) -> object:
            activities.append(activity)
            return original(*args, **kwargs)

        monkeypatch.setattr(owner, name, call_and_record)

    record_calls(run_module, "map_terrain", "map")
    record_calls(Vehicle, "drive", "drive with visual odometry")
    record_calls(run_module, "visit_stop", "track")
    leg = {"motion": "approach", "goal_m": 3.0, "step_fraction": 0.08, "autonav": True, "visual_odometry": True}
    run = run_case(RoverScenarioParameters.model_validate({**SHORT_RUN, "legs": [leg]}), Streams(1, "rover tests", 0))
    # Each activity is represented by its first letter. Consecutive drives count as one drive.
    steps = re.sub("d( d)+", "d", " ".join(activity[0] for activity in activities))
    # The run starts with tracking. Then each step maps, drives with visual odometry, and tracks.
    assert steps.split(" m d t")[0] == "t"
    assert set(steps.split(" m d t")[1:]) == {""}
    assert run.autonav_updates == activities.count("map") >= 2
    assert run.visual_odometry_updates == activities.count("drive with visual odometry")
    assert len(run.stops) == activities.count("track")
