"""Tests of the drive commands that each type of route leg computes from the estimated target position."""

import numpy as np
import pytest

from marsyard.scenarios.rover.flight_software import (
    GOAL_TOLERANCE_M,
    TargetEstimate,
    goal_position,
    is_finished,
    plan_drive,
    plan_step,
)
from marsyard.scenarios.rover.parameters import LegParameters
from marsyard.sim.measurements import DriveCommand


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
    first, second = (
        list(plan_step(turn_leg, 0, make_target(3.0, 0.0))),
        list(plan_step(turn_leg, 1, make_target(3.0, 0.0))),
    )
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
