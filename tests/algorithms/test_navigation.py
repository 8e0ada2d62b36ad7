"""Tests of navigation to a goal around obstacles and over mapped ground."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.navigation import (
    NavigationOptions,
    NavigationOutcome,
    NavigationPlan,
    Obstacle,
    TerrainMap,
    Wedge,
    navigate,
)
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DriveCommand

OPTIONS = NavigationOptions()
EAST, NAVCAM = 0.5 * np.pi, np.radians(45.0)
EVERYWHERE = TerrainMap((Wedge(np.zeros(2), 0.0, np.pi, 0.0, 100.0),))


def _make_pose(east: float, north: float, yaw_deg: float = 0.0) -> RigidTransform:
    return rigid(Rotation.from_euler("Z", yaw_deg, degrees=True), np.array([east, north, 0.0]))


def _make_rock(east: float, north: float, radius: float = 0.25, height: float = 0.4, name: str = "rock") -> Obstacle:
    return Obstacle(name, np.array([east, north]), radius, height)


def _apply_command(pose: RigidTransform, command: DriveCommand) -> RigidTransform:
    """The pose after a command on level ground, without slip."""
    translation = np.array([*command.displacement_m, 0.0])
    return pose * rigid(Rotation.from_rotvec([0.0, 0.0, command.turn_left_rad]), translation)


def _drive_to_goal(
    terrain: TerrainMap, pose: RigidTransform, goal: np.ndarray, step_m: float, **options: object
) -> np.ndarray:
    """Positions (east, north) of the rover with a new plan at each step, until it reaches the goal."""
    positions = [pose.translation[:2]]
    for _ in range(60):
        plan = navigate(terrain, pose, goal, step_m, OPTIONS, **options)  # type: ignore[arg-type]
        if plan.outcome is NavigationOutcome.AT_GOAL:
            return np.array(positions)
        assert plan.outcome is NavigationOutcome.PATH
        for command in plan.commands:
            for _ in range(10):
                pose = _apply_command(pose, command.part(0.1))
                positions.append(pose.translation[:2])
    raise AssertionError("the goal was not reached")


def _path_length_m(plan: NavigationPlan) -> float:
    return sum(command.length_m for command in plan.commands)


def test_free_ground_is_crossed_in_a_straight_line() -> None:
    plan = navigate(EVERYWHERE, _make_pose(0.0, 0.0), np.array([5.0, 0.0]), 0.5, OPTIONS)
    assert plan.outcome is NavigationOutcome.PATH
    assert plan.commands == (DriveCommand(forward_m=0.5),)
    assert plan.path_m[-1] == pytest.approx([5.0, 0.0])


def test_lateral_goal_is_reached_along_gentle_arcs() -> None:
    plan = navigate(EVERYWHERE, _make_pose(0.0, 0.0), np.array([4.0, 1.0]), 0.3, OPTIONS)
    # The circle through the origin along x and (4, 1) has the curvature 2 y / (x^2 + y^2) = 2 / 17. A pair of arcs may
    # have more curvature first and less later.
    assert plan.commands[0].turn_left_rad / plan.commands[0].forward_m == pytest.approx(2.0 / 17.0, abs=0.05)
    assert _drive_to_goal(EVERYWHERE, _make_pose(0.0, 0.0), np.array([4.0, 1.0]), 0.3)[-1] == pytest.approx(
        [4.0, 1.0], abs=0.02
    )


def test_goal_behind_requires_turn_or_reverse_drive() -> None:
    goal = np.array([-3.0, 0.0])
    turn_plan = navigate(EVERYWHERE, _make_pose(0.0, 0.0), goal, 0.5, OPTIONS)
    assert turn_plan.commands[0].length_m == 0.0
    assert abs(turn_plan.commands[0].turn_left_rad) > np.radians(90.0)
    reverse_plan = navigate(EVERYWHERE, _make_pose(0.0, 0.0), goal, 0.5, OPTIONS, backwards=True)
    assert len(reverse_plan.commands) == 1
    assert reverse_plan.commands[0].forward_m == pytest.approx(-0.5)
    assert reverse_plan.commands[0].turn_left_rad == pytest.approx(0.0)
    positions = _drive_to_goal(EVERYWHERE, _make_pose(0.0, 0.0), np.array([-3.0, 0.5]), 0.5, backwards=True)
    assert positions[-1] == pytest.approx([-3.0, 0.5], abs=0.02)


@pytest.mark.parametrize("offset_m", [-0.3, 0.0, 0.4])
@pytest.mark.parametrize("yaw_deg", [0.0, 135.0])
def test_obstacle_is_passed_with_clearance(offset_m: float, yaw_deg: float) -> None:
    rotation = Rotation.from_euler("Z", yaw_deg, degrees=True).as_matrix()[:2, :2]
    rock = _make_rock(*(rotation @ np.array([3.0, offset_m])).tolist())
    terrain = TerrainMap(EVERYWHERE.wedges, (rock,))
    goal = rotation @ np.array([7.0, 0.0])
    positions = _drive_to_goal(terrain, _make_pose(0.0, 0.0, yaw_deg), goal, 0.5)
    assert positions[-1] == pytest.approx(goal, abs=0.02)
    closest = np.hypot(*(positions - rock.position_m).T).min()
    # Paths are sampled every 0.1 m: between samples the clearance may be 0.01 m smaller.
    assert closest > OPTIONS.half_width_m + OPTIONS.margin_m + rock.radius_m - 0.01
    path_length_m = np.hypot(*np.diff(positions, axis=0).T).sum()
    assert path_length_m < 1.25 * 7.0


def test_small_rocks_are_driven_over() -> None:
    terrain = TerrainMap(EVERYWHERE.wedges, (_make_rock(3.0, 0.0, 0.15, 0.1),))
    assert navigate(terrain, _make_pose(0.0, 0.0), np.array([6.0, 0.0]), 0.5, OPTIONS).commands == (DriveCommand(0.5),)


def test_target_rock_is_avoided_unless_it_is_named() -> None:
    rock = _make_rock(6.0, 0.0, 0.6, 0.8, "target")
    terrain = TerrainMap(EVERYWHERE.wedges, (rock,))
    goal = np.array([4.8, 0.0])
    assert navigate(terrain, _make_pose(0.0, 0.0), goal, 6.0, OPTIONS).outcome is NavigationOutcome.PATH
    near_pose = _make_pose(3.0, 0.0)
    assert navigate(terrain, near_pose, goal, 0.5, OPTIONS).outcome is NavigationOutcome.NO_PATH
    plan = navigate(terrain, near_pose, goal, 0.5, OPTIONS, target="target")
    assert plan.commands == (DriveCommand(forward_m=0.5),)


def _map_wedges(apex_east: float, azimuths_deg: tuple[float, ...], rocks: tuple[Obstacle, ...]) -> TerrainMap:
    """Terrain map from navcam images, 45 deg wide, that show the ground from 1.8 m to 20 m."""
    terrain = TerrainMap()
    for azimuth in azimuths_deg:
        wedge = Wedge(np.array([apex_east, 0.0]), float(np.radians(azimuth)), 0.5 * NAVCAM, 1.8, 20.0)
        terrain = terrain.add_wedge(wedge, rocks)
    return terrain


def test_passing_an_obstacle_needs_two_wedges() -> None:
    # The wedges start 2.6 m behind the rover; the obstacle is 2 m ahead.
    rocks = (_make_rock(2.0, 0.0),)
    goal = np.array([6.0, 0.0])
    one_wedge, two_wedges = (_map_wedges(-2.6, azimuths, rocks) for azimuths in ((90.0,), (70.0, 110.0)))
    assert navigate(one_wedge, _make_pose(0.0, 0.0), goal, 0.5, OPTIONS).outcome is NavigationOutcome.NO_PATH
    positions = _drive_to_goal(two_wedges, _make_pose(0.0, 0.0), goal, 0.5)
    assert positions[-1] == pytest.approx(goal, abs=0.02)
    assert two_wedges.contains(positions).all()
    # Without the obstacle one wedge is wide enough.
    without_rock = _map_wedges(-2.6, (90.0,), ())
    assert navigate(without_rock, _make_pose(0.0, 0.0), goal, 0.5, OPTIONS).outcome is NavigationOutcome.PATH


def test_path_starts_on_mapped_ground_after_two_metres() -> None:
    goal = np.array([7.0, 0.0])
    terrain = _map_wedges(0.0, (70.0, 110.0), ())
    outcomes = {
        east: navigate(terrain, _make_pose(east, 0.0), goal, 0.5, OPTIONS).outcome for east in (0.0, 1.0, 2.0, 2.6, 3.0)
    }
    assert [east for east, outcome in outcomes.items() if outcome is NavigationOutcome.NOT_MAPPED] == [0.0, 1.0, 2.0]
    assert outcomes[2.6] is outcomes[3.0] is NavigationOutcome.PATH


def test_paths_stay_on_mapped_ground() -> None:
    terrain = _map_wedges(-2.6, (90.0,), ())
    plan = navigate(terrain, _make_pose(0.0, 0.0), np.array([2.2, 2.2]), 0.5, OPTIONS)
    assert plan.outcome is NavigationOutcome.NO_PATH


def test_rock_seen_again_replaces_its_mapped_position() -> None:
    rock_ahead, rock_outside = _make_rock(5.0, 0.0, name="ahead"), _make_rock(0.0, 5.0, name="adjacent")
    terrain = _map_wedges(0.0, (90.0,), (rock_ahead, rock_outside))
    assert [rock.name for rock in terrain.obstacles] == ["ahead"]
    moved_rock = _make_rock(5.2, 0.1, name="ahead")
    repeated = terrain.add_wedge(terrain.wedges[0], (moved_rock,))
    assert len(repeated.wedges) == 2
    assert repeated.obstacles == (moved_rock,)
    # A rock is visible if only its rim is inside the wedge.
    partly_inside = _make_rock(5.0, 5.0 * np.tan(0.5 * NAVCAM) + 0.2, name="rim")
    assert len(terrain.add_wedge(terrain.wedges[0], (partly_inside,)).obstacles) == 2


def test_wedge_covers_azimuths_on_both_sides_of_south() -> None:
    wedge = Wedge(np.zeros(2), np.pi, 0.3, 0.5, 5.0)
    positions = np.array([[0.1, -2.0], [-0.1, -2.0], [0.0, 2.0], [0.0, -0.4], [0.0, -5.1], [-2.0, -2.0]])
    assert wedge.covers(positions).tolist() == [True, True, False, False, False, False]


def test_one_step_may_cover_both_arcs() -> None:
    terrain = TerrainMap(EVERYWHERE.wedges, (_make_rock(3.0, 0.0),))
    plan = navigate(terrain, _make_pose(0.0, 0.0), np.array([7.0, 0.0]), 100.0, OPTIONS)
    pose = _make_pose(0.0, 0.0)
    for command in plan.commands:
        pose = _apply_command(pose, command)
    assert pose.translation[:2] == pytest.approx([7.0, 0.0], abs=1e-9)
    assert _path_length_m(plan) == pytest.approx(np.hypot(*np.diff(plan.path_m, axis=0).T).sum(), rel=1e-3)


def test_invalid_options_are_rejected() -> None:
    with pytest.raises(ValueError, match="half_width_m"):
        NavigationOptions(half_width_m=0.0)
    with pytest.raises(ValueError, match="margin_m"):
        NavigationOptions(margin_m=-0.1)
