"""Tests of the outcome of a rover that hardly moves: STUCK with or without the target, or LOST by the tracker."""

from typing import Any

import pytest

from marsyard.scenarios.rover.parameters import MobilityParameters, RoverScenarioParameters
from marsyard.scenarios.rover.run import Step, is_stuck
from marsyard.scenarios.rover.scenario import RoverScenario
from marsyard.sim.streams import Streams
from tests.scenarios.rover.short_run import SHORT_RUN

#: 95 % slip on level ground; visual odometry measures it.
SLIPPING: dict[str, Any] = {
    **SHORT_RUN,
    "slip": {"flat": 0.95, "soil_spread": 0.0, "step_spread": 0.0},
    "navigation": {"odometry": "oracle-motion"},
    "legs": [{"motion": "approach", "goal_m": 3.0, "visual_odometry": True, "steps": 12}],
}


def run_slipping_rover(**changes: object) -> Any:
    return RoverScenario().run(
        RoverScenarioParameters.model_validate({**SLIPPING, **changes}), Streams(1, "stuck rovers", 0)
    )


def test_stuck_rover_is_no_failure_of_the_tracker() -> None:
    result = run_slipping_rover()
    assert (result.outcome, result.answered) == ("STUCK", False)
    # five steps of 95 % slip end the run, before the maximum of 12 steps
    assert result.row["updates"] == 6
    assert (result.row["stuck"], result.row["mobile"], result.row["tracked"]) == (True, False, False)
    assert result.row["target_held"]
    assert result.row["slip_mean"] == pytest.approx(0.95, abs=0.01)


def test_loss_by_the_tracker_of_a_slipping_rover_is_lost() -> None:
    result = run_slipping_rover(algorithm="tests.scenarios.rover.trackers:LosingTracker")
    assert result.outcome == "LOST"
    assert (result.row["stuck"], result.row["mobile"], result.row["target_held"]) == (False, True, False)


def test_too_few_steps_are_not_at_the_goal() -> None:
    result = run_slipping_rover(slip={"flat": 0.5, "soil_spread": 0.0, "step_spread": 0.0})
    assert result.outcome == "COMPLETED"
    legs = [{"motion": "approach", "goal_m": 3.0, "visual_odometry": True, "steps": 1}]
    result = run_slipping_rover(legs=legs)
    assert (result.outcome, result.row["mobile"]) == ("NOT_AT_GOAL", True)


def test_stuck_is_the_slip_over_successive_steps() -> None:
    mobility = MobilityParameters(stuck_slip=0.8, stuck_steps=3)
    slipping, moving = Step(1.0, 0.1), Step(1.0, 0.5)
    assert not is_stuck([slipping] * 2, mobility)
    assert is_stuck([moving, *[slipping] * 3], mobility)
    # (0.1 + 0.1 + 0.5) / 3 = 0.23 of the commanded path, more than 0.2
    assert not is_stuck([slipping, slipping, moving], mobility)
