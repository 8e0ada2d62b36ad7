"""Tests of the route: commands of each type of leg, drive past the target, order of activities, stuck rovers."""

import re
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.vtt import prediction
from marsyard.algorithms.vtt.pointing import mast_angles
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.scenarios.rover import closed_loop as closed_loop
from marsyard.scenarios.rover.closed_loop import prepare_run, run_case
from marsyard.scenarios.rover.conditions import fixed_conditions
from marsyard.scenarios.rover.flight_software import (
    GOAL_TOLERANCE_M,
    TargetEstimate,
    goal_position,
    is_finished,
    plan_drive,
    plan_step,
)
from marsyard.scenarios.rover.parameters import LegParameters, MobilityParameters, RoverScenarioParameters
from marsyard.scenarios.rover.run_state import Step, is_stuck
from marsyard.scenarios.rover.scenario import RoverScenario
from marsyard.scenarios.rover.vehicle import Vehicle
from marsyard.sim.dynamics.driving import Soil, drive
from marsyard.sim.dynamics.rover import ROCKY_8, settle
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DriveCommand
from marsyard.sim.streams import Streams
from tests.scenarios.rover.short_run import SHORT_RUN
from tests.sim.dynamics.grounds import NO_SLIP, Plane


def make_target(x: float, y: float) -> TargetEstimate:
    """Return a target at (x, y) in the rover frame; the camera is 1.2 m above it."""
    return TargetEstimate(np.array([x, y, 0.3]), float(np.hypot(np.hypot(x, y), 1.2)))


def integrate_commands(commands: list[DriveCommand]) -> tuple[np.ndarray, float]:
    """Return position (m) and heading (rad, positive to the left) after commands without slip, in the initial axes."""
    position, heading = np.zeros(2), 0.0
    for command in commands:
        sine, cosine = np.sin(heading), np.cos(heading)
        position = position + np.array([[cosine, -sine], [sine, cosine]]) @ command.displacement_m
        heading += command.turn_left_rad
    return position, heading


@pytest.mark.parametrize("angle_deg", [0.0, 5.0, -14.0, 40.0, -120.0])
def test_drive_commands_end_at_the_position(angle_deg: float) -> None:
    angle = np.radians(angle_deg)
    position = 3.0 * np.array([np.cos(angle), np.sin(angle)])
    final_position, _ = integrate_commands(list(plan_drive(position, 10.0)))
    np.testing.assert_allclose(final_position, position, atol=1e-12)


def test_step_length_is_limited() -> None:
    # The second argument of `plan_drive` is the maximum length, m.
    commands = list(plan_drive(np.array([3.0, 0.4]), 0.5))
    assert sum(command.length_m for command in commands) == pytest.approx(0.5)


def test_approach_reaches_distance_and_offset() -> None:
    # A step is 10 % of the distance from the camera; the last step is the remaining distance.
    leg = LegParameters(motion="approach", step_fraction=0.1, goal_m=2.0)
    (step,) = plan_step(leg, 0, make_target(8.0, 0.0))
    assert step.forward_m == pytest.approx(0.1 * np.hypot(8.0, 1.2))
    (final_step,) = plan_step(leg, 0, make_target(2.1, 0.0))
    assert final_step.forward_m == pytest.approx(0.1)
    assert is_finished(leg, 3, make_target(2.0 + 0.9 * GOAL_TOLERANCE_M, 0.0))
    assert not is_finished(leg, 3, make_target(2.0 + 1.1 * GOAL_TOLERANCE_M, 0.0))
    offset_leg = LegParameters(motion="approach", goal_m=2.0, offset_right_m=0.5)
    np.testing.assert_allclose(goal_position(offset_leg, make_target(5.0, 0.0)), [3.0, -0.5])


@pytest.mark.parametrize("motion", ["approach", "back-off"])
@pytest.mark.parametrize("step_m", [0.0, -0.5])
def test_step_towards_a_goal_is_positive(motion: str, step_m: float) -> None:
    """A negative step would drive away from the goal, and zero would not drive at all."""
    with pytest.raises(ValueError, match=f"step_m is {step_m:g}; allowed for motion '{motion}': above 0"):
        LegParameters.model_validate({"motion": motion, "step_m": step_m})
    assert LegParameters(motion="straight", step_m=step_m).step_m == step_m


def test_map_of_the_first_leg_is_stated() -> None:
    """A leg that only maps first has a map, too."""
    for leg, source in (({"maps_first": True, "map_by": "body"}, "body"), ({"map_by": "body"}, "none")):
        parameters = RoverScenarioParameters.model_validate({**SHORT_RUN, "legs": [{"motion": "stay", **leg}]})
        run = prepare_run(parameters, Streams(1, "rover tests", 0))
        assert fixed_conditions(parameters, run)["map_by"] == source
        assert (run.setup.navigation_cameras.body is not None) is (source == "body")


def test_circle_keeps_target_distance_and_bearing() -> None:
    leg = LegParameters(motion="circle", step_deg=10.0, steps=7)
    target = make_target(7.0, 0.5)
    position, heading = integrate_commands(list(plan_step(leg, 0, target)))
    # Seen from above, the rover drives clockwise around the target. The target is fixed in the rover frame.
    target_from_rover = target.position_rover[:2] - position
    sine, cosine = np.sin(-heading), np.cos(-heading)
    np.testing.assert_allclose(
        np.array([[cosine, -sine], [sine, cosine]]) @ target_from_rover, target.position_rover[:2], atol=1e-12
    )
    assert np.degrees(heading) == pytest.approx(-10.0)
    assert is_finished(leg, 7, target)


def test_turn_back_off_and_straight_legs_have_their_commands() -> None:
    turn_leg = LegParameters(motion="turn", step_deg=10.0, steps=7, shuffle_m=0.1)
    first, second = (list(plan_step(turn_leg, number, make_target(3.0, 0.0))) for number in (0, 1))
    assert np.degrees(first[0].turn_left_rad) == pytest.approx(-10.0)
    # the short drives alternate between forward and backward
    assert first[1].forward_m + second[1].forward_m == 0.0
    back_off = LegParameters(motion="back-off", goal_m=7.0, step_m=0.4)
    (reverse,) = plan_step(back_off, 0, make_target(6.8, 0.0))
    assert reverse.forward_m == pytest.approx(-0.2)
    assert is_finished(back_off, 1, make_target(7.0, 0.0))
    straight_leg = LegParameters(motion="straight", step_m=0.425, steps=2)
    assert [command.forward_m for command in plan_step(straight_leg, 0, make_target(1.0, 4.0))] == [0.425]


def test_incomplete_or_inconsistent_legs_are_rejected() -> None:
    with pytest.raises(ValueError, match="needs step_m"):
        LegParameters(motion="straight")
    with pytest.raises(ValueError, match="autonav needs a leg of motion 'approach'"):
        LegParameters(motion="turn", autonav=True)


def test_drive_past_the_target_rolls_the_image_by_30_deg_in_few_steps() -> None:
    """The two images of the paper, at 6.8 m and 1.8 m, differ by 30 deg; one step rolls the image by over 5 deg."""
    p = RoverScenario().check_parameters(load_campaign("vtt-roll").parameters(0))
    mast, azimuth = p.camera.mast(), np.radians(p.start.target_azimuth_deg)
    # the rover drives along x; the start distance is that of the mast's base
    ahead = p.start.distance_m * np.array([np.cos(azimuth), -np.sin(azimuth)]) + mast.geometry.base_m[:2]
    target_world = np.array([*ahead, 0.5 * float(p.target.height_m or 0.0)])
    steps_m = [float(leg.step_m or 0.0) for leg in p.legs for _ in range(leg.steps)]
    assert len(steps_m) <= 6
    heads, positions = [], []
    for x in np.cumsum([0.0, *steps_m]):
        world_from_rover = rigid(Rotation.identity(), np.array([x, 0.0, 0.0]))
        angles = mast_angles(target_world - [x, 0.0, 0.0], mast)
        assert angles is not None
        heads.append(world_from_rover * mast.geometry.rover_from_head(*angles))
        positions.append(np.asarray(heads[-1].inv().apply(target_world.copy())))

    def compute_roll_deg(first: int, second: int) -> float:
        new_from_old: RigidTransform = prediction.pose_change(heads[first], heads[second])
        points = prediction.roll_points(positions[first], mast.left, mast.left, new_from_old, 0.05)
        assert points is not None
        return abs(float(np.degrees(prediction.roll_angle(points))))

    assert compute_roll_deg(0, len(steps_m)) == pytest.approx(30.0, abs=4.0)
    rolls_deg = [compute_roll_deg(*pair) for pair in pairwise(range(len(heads)))]
    # 5.7 deg is the roll that the paper calls noticeable (section 4.3.3)
    assert max(rolls_deg) > 5.7
    distances = [
        float(np.linalg.norm((target_world - [x, 0.0, 0.0])[:2] - mast.geometry.base_m[:2]))
        for x in (0.0, sum(steps_m))
    ]
    assert distances == pytest.approx([6.8, 1.8], abs=0.06)


def test_tracked_and_false_track_have_separate_limits() -> None:
    """A drift above the limit of a tracked target, but below that of a false track, is neither."""

    def run(tracked_px: float) -> dict[str, object]:
        score = {"tracked_px": tracked_px, "false_track_px": 10.0}
        p = RoverScenarioParameters.model_validate({**SHORT_RUN, "score": score})
        return dict(RoverScenario().run(p, Streams(1, "limits", 0)).row)

    row = run(5.0)
    drift_px = float(str(row["drift_px"]))
    assert 0.0 < drift_px < 5.0
    assert (row["tracked"], row["no_false_track"]) == (True, True)
    row = run(0.5 * drift_px)
    assert (row["tracked"], row["target_held"], row["no_false_track"]) == (False, False, True)
    assert row["track_margin_px"] == pytest.approx(10.0 - float(str(row["max_error_px"])))


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
    algorithm = "tests.scenarios.rover.trackers:LosingTracker"
    result = run_slipping_rover(algorithm=algorithm, executable={"isolated": False})
    assert result.outcome == "LOST"
    # the population of stuck rovers does not depend on the tracker
    assert (result.row["stuck"], result.row["mobile"], result.row["target_held"]) == (True, False, False)


def test_too_few_steps_are_not_at_the_goal() -> None:
    result = run_slipping_rover(slip={"flat": 0.5, "soil_spread": 0.0, "step_spread": 0.0})
    assert result.outcome == "COMPLETED"
    legs = [{"motion": "approach", "goal_m": 3.0, "visual_odometry": True, "steps": 1}]
    result = run_slipping_rover(legs=legs)
    assert (result.outcome, result.row["mobile"]) == ("NOT_AT_GOAL", False)


def test_stuck_is_the_slip_over_successive_steps() -> None:
    mobility = MobilityParameters(stuck_slip=0.8, stuck_steps=3)
    slipping, moving = Step(1.0, 0.1), Step(1.0, 0.5)
    assert is_stuck([moving, *[slipping] * 3], mobility)
    assert is_stuck([*[slipping] * 3, moving], mobility)
    # all steps of a shorter run; a run without steps is not stuck
    assert is_stuck([slipping] * 2, mobility)
    assert not is_stuck([slipping, moving], mobility)
    assert not is_stuck([], mobility)
    # (0.1 + 0.1 + 0.5) / 3 = 0.23 of the commanded path, more than 0.2
    assert not is_stuck([slipping, slipping, moving], mobility)


def test_sideways_sliding_is_no_progress() -> None:
    """Diagonally across a slope, the rover slides sideways as much as its path; it is stuck without progress."""
    slip = NO_SLIP.model_copy(update={"across": 1.0, "exponent": 1.0, "full_slope_deg": 16.0})
    slope = float(np.tan(np.radians(15.0)))
    plane, soil, rng = Plane(slope, slope), Soil(slip, 1.0), np.random.default_rng(1)
    start = settle(ROCKY_8, plane, 0.0, 0.0, 0.5 * np.pi)
    commands = DriveCommand(forward_m=1.0), DriveCommand(turn_left_rad=0.1)
    drives = [drive(ROCKY_8, plane, soil, start, command, rng) for command in commands]
    assert drives[0].length_m > 0.8
    step = Step.from_drives(drives)
    # slopes of 15 deg along and across the path; 1 - 15/16 = 0.06 of the path remains
    assert (step.commanded_m, step.progress_m) == pytest.approx((1.0, 0.06), abs=0.02)
    assert is_stuck([step], MobilityParameters())


def test_each_step_maps_then_drives_then_tracks(monkeypatch: pytest.MonkeyPatch) -> None:
    activities: list[str] = []

    def record_calls(owner: object, name: str, activity: str) -> None:
        original = getattr(owner, name)

        def call_and_record(*args: object, **kwargs: object) -> object:
            activities.append(activity)
            return original(*args, **kwargs)

        monkeypatch.setattr(owner, name, call_and_record)

    record_calls(closed_loop, "map_terrain", "map")
    record_calls(Vehicle, "drive", "drive with visual odometry")
    record_calls(closed_loop, "visit_stop", "track")
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
