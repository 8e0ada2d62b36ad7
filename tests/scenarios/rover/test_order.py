"""Order of a step's activities (Fig. 12): visual odometry within the drive, tracking, navigation."""

import re

import pytest

from marsyard.scenarios.rover import run as loop
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.run import run_case
from marsyard.scenarios.rover.world import Vehicle
from marsyard.sim.streams import Streams
from tests.scenarios.rover.short_run import SHORT


def test_a_step_drives_by_what_was_tracked_and_mapped_before_it(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []

    def record_calls(kind: object, name: str, word: str) -> None:
        before = getattr(kind, name)

        def after(*args: object, **more: object) -> object:
            done.append(word)
            return before(*args, **more)

        monkeypatch.setattr(kind, name, after)

    record_calls(loop, "map_terrain", "map")
    record_calls(Vehicle, "drive", "drive and see how far")
    record_calls(loop, "visit_stop", "track")
    leg = {"motion": "approach", "goal_m": 3.0, "step_fraction": 0.08, "autonav": True, "visual_odometry": True}
    run = run_case(RoverScenarioParameters.model_validate({**SHORT, "legs": [leg]}), Streams(1, "rover tests", 0))
    steps = re.sub("d( d)+", "d", " ".join(word[0] for word in done))
    # the target is seen first; then each step is mapped, driven in parts that visual odometry joins, and tracked
    assert steps.split(" m d t")[0] == "t"
    assert set(steps.split(" m d t")[1:]) == {""}
    assert run.autonav_updates == done.count("map") >= 2
    assert run.visual_odometry_updates == done.count("drive and see how far")
    assert len(run.stops) == done.count("track")
