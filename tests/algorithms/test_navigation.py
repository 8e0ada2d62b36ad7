"""Tests of the rover's path planner: navigation to a goal around hazards and over mapped ground."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.navigation.planner import NavigationOptions, NavigationOutcome, NavigationPlan, navigate
from marsyard.algorithms.navigation.terrain_map import TerrainMap
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DriveCommand

OPTIONS = NavigationOptions()
SPACING_M = 0.05  #: Spacing of the simulated stereo points.


def _make_pose(east: float, north: float, yaw_deg: float = 0.0) -> RigidTransform:
    """Create a pose on level ground; yaw is counter-clockwise from east."""
    return rigid(Rotation.from_euler("Z", yaw_deg, degrees=True), np.array([east, north, 0.0]))


def _sample_ground(rocks: tuple[tuple[float, float, float, float], ...] = (), slope_deg: float = 0.0) -> np.ndarray:
    """Sample a plane that rises to the east, with rocks (east, north, radius, height) as cylinders."""
    axis = np.arange(-9.0, 9.0, SPACING_M)
    east, north = (values.ravel() for values in np.meshgrid(axis, axis))
    height = np.tan(np.radians(slope_deg)) * east
    for rock_east, rock_north, radius, rock_height in rocks:
        height = height + rock_height * (np.hypot(east - rock_east, north - rock_north) <= radius)
    return np.column_stack([east, north, height])


def _map_ground(*rocks: tuple[float, float, float, float], slope_deg: float = 0.0) -> TerrainMap:
    """Map the ground of `_sample_ground` within 9 m of the origin."""
    return TerrainMap.empty(np.zeros(2)).add_points(_sample_ground(rocks, slope_deg))


def _apply_command(pose: RigidTransform, command: DriveCommand) -> RigidTransform:
    """Return the pose after a command on level ground, without slip."""
    translation = np.array([*command.displacement_m, 0.0])
    return pose * rigid(Rotation.from_rotvec([0.0, 0.0, command.turn_left_rad]), translation)


def _drive_to_goal(
    terrain: TerrainMap, pose: RigidTransform, goal: np.ndarray, step_m: float, backwards: bool = False
) -> np.ndarray:
    """Drive to the goal with a new plan after each step; return the positions (east, north), metres."""
    positions = [pose.translation[:2]]
    for _ in range(60):
        plan = navigate(terrain, pose, goal, step_m, OPTIONS, backwards)
        if plan.outcome is NavigationOutcome.AT_GOAL:
            return np.array(positions)
        assert plan.outcome is NavigationOutcome.PATH
        for command in plan.commands:
            for _ in range(10):
                pose = _apply_command(pose, command.part(0.1))
                positions.append(pose.translation[:2])
    raise AssertionError("the goal was not reached")


def _compute_path_length_m(plan: NavigationPlan) -> float:
    return sum(command.length_m for command in plan.commands)


def test_free_ground_is_crossed_in_a_straight_line() -> None:
    plan = navigate(_map_ground(), _make_pose(0.0, 0.0), np.array([5.0, 0.0]), 0.5, OPTIONS)
    assert plan.outcome is NavigationOutcome.PATH
    assert plan.commands == (DriveCommand(forward_m=0.5),)
    assert plan.path_m[-1] == pytest.approx([5.0, 0.0])


def test_lateral_goal_is_reached_along_gentle_arcs() -> None:
    plan = navigate(_map_ground(), _make_pose(0.0, 0.0), np.array([4.0, 1.0]), 0.3, OPTIONS)
    # The circle through the origin along x and (4, 1) has the curvature 2 y / (x^2 + y^2) = 2 / 17. A pair of arcs may
    # have more curvature first and less later.
    assert plan.commands[0].turn_left_rad / plan.commands[0].forward_m == pytest.approx(2.0 / 17.0, abs=0.05)
    positions = _drive_to_goal(_map_ground(), _make_pose(0.0, 0.0), np.array([4.0, 1.0]), 0.3)
    assert positions[-1] == pytest.approx([4.0, 1.0], abs=0.02)


def test_goal_behind_requires_turn_or_reverse_drive() -> None:
    goal, terrain = np.array([-3.0, 0.0]), _map_ground()
    turn_plan = navigate(terrain, _make_pose(0.0, 0.0), goal, 0.5, OPTIONS)
    assert turn_plan.commands[0].length_m == 0.0
    assert abs(turn_plan.commands[0].turn_left_rad) > np.radians(90.0)
    reverse_plan = navigate(terrain, _make_pose(0.0, 0.0), goal, 0.5, OPTIONS, backwards=True)
    assert len(reverse_plan.commands) == 1
    assert reverse_plan.commands[0].forward_m == pytest.approx(-0.5)
    assert reverse_plan.commands[0].turn_left_rad == pytest.approx(0.0)
    positions = _drive_to_goal(terrain, _make_pose(0.0, 0.0), np.array([-3.0, 0.5]), 0.5, backwards=True)
    assert positions[-1] == pytest.approx([-3.0, 0.5], abs=0.02)


@pytest.mark.parametrize(
    ("yaw_deg", "offset_m"),
    [
        (0.0, 0.4),
        (135.0, -0.3),
        *(
            pytest.param(*pair, marks=pytest.mark.slow)
            for pair in ((0.0, -0.3), (0.0, 0.0), (135.0, 0.0), (135.0, 0.4))
        ),
    ],
)
def test_hazard_is_passed_with_clearance(offset_m: float, yaw_deg: float) -> None:
    rotation = Rotation.from_euler("Z", yaw_deg, degrees=True).as_matrix()[:2, :2]
    rock = rotation @ np.array([3.0, offset_m])
    goal = rotation @ np.array([7.0, 0.0])
    positions = _drive_to_goal(_map_ground((*rock, 0.25, 0.4)), _make_pose(0.0, 0.0, yaw_deg), goal, 0.5)
    assert positions[-1] == pytest.approx(goal, abs=0.02)
    min_distance_m = np.hypot(*(positions - rock).T).min()
    # the radius of the rock is 0.25 m
    assert min_distance_m > OPTIONS.half_width_m + 0.25
    assert np.hypot(*np.diff(positions, axis=0).T).sum() < 1.25 * 7.0


def test_low_rocks_are_driven_over() -> None:
    terrain = _map_ground((3.0, 0.0, 0.25, 0.1))
    assert navigate(terrain, _make_pose(0.0, 0.0), np.array([6.0, 0.0]), 0.5, OPTIONS).commands == (DriveCommand(0.5),)


def test_ramp_is_climbed_up_to_the_maximum_tilt() -> None:
    goal = np.array([5.0, 0.0])
    outcomes = [
        navigate(_map_ground(slope_deg=slope), _make_pose(0.0, 0.0), goal, 0.5, OPTIONS).outcome
        for slope in (25.0, 29.0)
    ]
    assert outcomes == [NavigationOutcome.PATH] * 2
    # The plan must not enter a ramp of 35 deg, which starts at 2 m.
    points = _sample_ground()
    points[:, 2] = np.tan(np.radians(35.0)) * np.maximum(points[:, 0] - 2.0, 0.0)
    steep = TerrainMap.empty(np.zeros(2)).add_points(points)
    assert navigate(steep, _make_pose(0.0, 0.0), goal, 0.5, OPTIONS).outcome is NavigationOutcome.NO_PATH


def test_target_rock_is_avoided_unless_it_is_excluded() -> None:
    terrain, goal, pose = _map_ground((6.0, 0.0, 0.6, 0.8)), np.array([4.8, 0.0]), _make_pose(3.0, 0.0)
    assert navigate(terrain, pose, goal, 0.5, OPTIONS).outcome is NavigationOutcome.NO_PATH
    plan = navigate(terrain.without_hazards(np.array([6.0, 0.0]), 0.8), pose, goal, 0.5, OPTIONS)
    assert plan.commands == (DriveCommand(forward_m=0.5),)


def _map_stereo_sectors(camera_east_m: float, azimuths_deg: tuple[float, ...], *rocks: tuple[float, ...]) -> TerrainMap:
    """Map the ground that stereo pairs of a navcam show: sectors of 45 deg about these azimuths, from 1.8 m on."""
    points = _sample_ground(rocks)  # type: ignore[arg-type]
    offset = points[:, :2] - (camera_east_m, 0.0)
    azimuth = np.degrees(np.arctan2(offset[:, 0], offset[:, 1]))
    is_mapped = np.zeros(len(points), dtype=np.bool_)
    for centre in azimuths_deg:
        is_mapped |= np.abs(azimuth - centre) <= 22.5
    return TerrainMap.empty(np.zeros(2)).add_points(points[is_mapped & (np.hypot(*offset.T) >= 1.8)])


def test_path_around_a_hazard_needs_two_mapped_sectors() -> None:
    # The cameras are 2.8 m behind the rover. The rock is 1.2 m ahead, where one sector reaches 1.7 m to each side.
    rock, goal, pose = (1.2, 0.0, 0.25, 0.4), np.array([6.0, 0.0]), _make_pose(0.0, 0.0)
    one_sector, two_sectors = (_map_stereo_sectors(-2.8, azimuths, rock) for azimuths in ((90.0,), (70.0, 110.0)))
    assert navigate(one_sector, pose, goal, 0.5, OPTIONS).outcome is NavigationOutcome.NO_PATH
    assert _drive_to_goal(two_sectors, pose, goal, 0.5)[-1] == pytest.approx(goal, abs=0.02)
    # Without the rock one sector is wide enough.
    assert navigate(_map_stereo_sectors(-2.8, (90.0,)), pose, goal, 0.5, OPTIONS).outcome is NavigationOutcome.PATH


def test_rover_on_unmapped_ground_has_no_path() -> None:
    # The sectors start 1.8 m from the cameras: the ground at 0 m and 1 m is not mapped, the ground at 3 m is.
    goal, terrain = np.array([7.0, 0.0]), _map_stereo_sectors(0.0, (70.0, 110.0))
    outcomes = {east: navigate(terrain, _make_pose(east, 0.0), goal, 0.5, OPTIONS).outcome for east in (0.0, 1.0, 3.0)}
    assert outcomes[0.0] is outcomes[1.0] is NavigationOutcome.NOT_MAPPED
    assert outcomes[3.0] is NavigationOutcome.PATH


def test_plan_with_a_long_step_contains_both_arcs_of_the_path() -> None:
    plan = navigate(_map_ground((3.0, 0.0, 0.25, 0.4)), _make_pose(0.0, 0.0), np.array([6.0, 0.0]), 20.0, OPTIONS)
    curvatures = [command.turn_left_rad / command.forward_m for command in plan.commands if command.forward_m]
    assert len(curvatures) == 2
    assert _compute_path_length_m(plan) == pytest.approx(np.hypot(*np.diff(plan.path_m, axis=0).T).sum(), rel=1e-3)


def test_invalid_options_are_rejected() -> None:
    with pytest.raises(ValueError, match="half_width_m is 0"):
        NavigationOptions(half_width_m=0.0)
    with pytest.raises(ValueError, match="margin_m is -1"):
        NavigationOptions(margin_m=-1.0)
