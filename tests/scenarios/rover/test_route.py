"""Tests of drive commands of route legs, from the estimated target position."""

import numpy as np
import pytest

from marsyard.scenarios.rover.parameters import LegParameters
from marsyard.scenarios.rover.run import (
    GOAL_TOLERANCE_M,
    TargetEstimate,
    drive_towards,
    goal_position,
    is_finished,
    step_commands,
)
from marsyard.sim.measurements import DriveCommand


def make_target(x: float, y: float) -> TargetEstimate:
    """A target in the rover frame, seen from a camera 1.2 m above it."""
    return TargetEstimate(np.array([x, y, 0.3]), float(np.hypot(np.hypot(x, y), 1.2)))


def drive(commands: list[DriveCommand]) -> tuple[np.ndarray, float]:
    """Position and heading after commands without slip, in the initial axes."""
    position, heading = np.zeros(2), 0.0
    for one in commands:
        sine, cosine = np.sin(heading), np.cos(heading)
        position = position + np.array([[cosine, -sine], [sine, cosine]]) @ one.displacement_m
        heading += one.turn_left_rad
    return position, heading


@pytest.mark.parametrize("angle_deg", [0.0, 5.0, -14.0, 40.0, -120.0])
def test_steps_reach_a_position(angle_deg: float) -> None:
    angle = np.radians(angle_deg)
    position = 3.0 * np.array([np.cos(angle), np.sin(angle)])
    reached, _ = drive(list(drive_towards(position, 10.0)))
    np.testing.assert_allclose(reached, position, atol=1e-12)


def test_step_length_is_limited() -> None:
    commands = list(drive_towards(np.array([3.0, 0.4]), 0.5))
    assert sum(one.length_m for one in commands) == pytest.approx(0.5)


def test_approach_reaches_distance_and_offset() -> None:
    # 10 % of the camera distance while far, and the remaining distance at the end.
    leg = LegParameters(motion="approach", step_fraction=0.1, goal_m=2.0)
    (step,) = step_commands(leg, 0, make_target(8.0, 0.0))
    assert step.forward_m == pytest.approx(0.1 * np.hypot(8.0, 1.2))
    (last,) = step_commands(leg, 0, make_target(2.1, 0.0))
    assert last.forward_m == pytest.approx(0.1)
    assert is_finished(leg, 3, make_target(2.0 + 0.9 * GOAL_TOLERANCE_M, 0.0))
    assert not is_finished(leg, 3, make_target(2.0 + 1.1 * GOAL_TOLERANCE_M, 0.0))
    aside = LegParameters(motion="approach", goal_m=2.0, offset_right_m=0.5)
    np.testing.assert_allclose(goal_position(aside, make_target(5.0, 0.0)), [3.0, -0.5])


def test_circle_keeps_target_distance_and_bearing() -> None:
    leg = LegParameters(motion="circle", step_deg=10.0, steps=7)
    target = make_target(7.0, 0.5)
    position, heading = drive(list(step_commands(leg, 0, target)))
    # From above, the rover drives clockwise around the target; the target is fixed in the rover frame.
    away = target.position_rover[:2] - position
    sine, cosine = np.sin(-heading), np.cos(-heading)
    np.testing.assert_allclose(
        np.array([[cosine, -sine], [sine, cosine]]) @ away, target.position_rover[:2], atol=1e-12
    )
    assert np.degrees(heading) == pytest.approx(-10.0)
    assert is_finished(leg, 7, target)


def test_turn_reverse_and_straight_legs() -> None:
    turn = LegParameters(motion="turn", step_deg=10.0, steps=7, shuffle_m=0.1)
    first, second = (
        list(step_commands(turn, 0, make_target(3.0, 0.0))),
        list(step_commands(turn, 1, make_target(3.0, 0.0))),
    )
    assert np.degrees(first[0].turn_left_rad) == pytest.approx(-10.0)
    assert first[1].forward_m + second[1].forward_m == 0.0
    back = LegParameters(motion="back-off", goal_m=7.0, step_m=0.4)
    (away,) = step_commands(back, 0, make_target(6.8, 0.0))
    assert away.forward_m == pytest.approx(-0.2)
    assert is_finished(back, 1, make_target(7.0, 0.0))
    straight = LegParameters(motion="straight", step_m=0.425, steps=2)
    assert [one.forward_m for one in step_commands(straight, 0, make_target(1.0, 4.0))] == [0.425]
    with pytest.raises(ValueError, match="needs step_m"):
        LegParameters(motion="straight")
    with pytest.raises(ValueError, match="autonav needs a leg of motion 'approach'"):
        LegParameters(motion="turn", autonav=True)
