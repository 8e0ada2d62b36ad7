"""Tests of the rover's navigation: path planner, terrain map, and stereo and visual odometry on a textured plane."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.navigation import visual_odometry
from marsyard.algorithms.navigation.planner import NavigationOptions, NavigationOutcome, NavigationPlan, navigate
from marsyard.algorithms.navigation.stereo import RectifiedPair
from marsyard.algorithms.navigation.terrain_map import CELL_M, GroundLimits, TerrainMap
from marsyard.algorithms.navigation.visual_odometry import VisualOdometryOutcome, estimate_motion
from marsyard.scenarios.conformance.inputs import MEAN_RADIANCE, TexturedPlane
from marsyard.sim.camera import Cahv, CameraModel
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DriveCommand, StereoMeasurement

OPTIONS = NavigationOptions()
SPACING_M = 0.05  #: Spacing of the simulated stereo points.


def _make_pose(east: float, north: float, yaw_deg: float = 0.0) -> RigidTransform:
    """Create a pose on level ground; yaw is counter-clockwise from east."""
    return rigid(Rotation.from_euler("Z", yaw_deg, degrees=True), np.array([east, north, 0.0]))


def _sample_ground(
    rocks: tuple[tuple[float, float, float, float], ...] = (), slope_deg: float = 0.0, half_width_m: float = 9.0
) -> np.ndarray:
    """Sample a plane that rises to the east, with rocks (east, north, radius, height) as cylinders."""
    axis = np.arange(-half_width_m, half_width_m, SPACING_M)
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


def _navigate(terrain: TerrainMap, east: float, goal_east: float) -> NavigationPlan:
    """Plan a step of 0.5 m to the east from a position on the east axis."""
    return navigate(terrain, _make_pose(east, 0.0), np.array([goal_east, 0.0]), 0.5, OPTIONS)


def _drive_to_goal(terrain: TerrainMap, pose: RigidTransform, goal: np.ndarray, step_m: float) -> np.ndarray:
    """Drive to the goal with a new plan after each step; return the positions (east, north), metres."""
    positions = [pose.translation[:2]]
    for _ in range(60):
        plan = navigate(terrain, pose, goal, step_m, OPTIONS)
        if plan.outcome is NavigationOutcome.AT_GOAL:
            return np.array(positions)
        assert plan.outcome is NavigationOutcome.PATH
        for command in plan.commands:
            for _ in range(10):
                pose = _apply_command(pose, command.part(0.1))
                positions.append(pose.translation[:2])
    raise AssertionError("the goal was not reached")


def test_free_ground_is_crossed_in_a_straight_line() -> None:
    plan = _navigate(_map_ground(), 0.0, 5.0)
    assert plan.outcome is NavigationOutcome.PATH
    assert plan.commands == (DriveCommand(forward_m=0.5),)


def test_lateral_goal_is_reached_along_gentle_arcs() -> None:
    plan = navigate(_map_ground(), _make_pose(0.0, 0.0), np.array([4.0, 1.0]), 0.3, OPTIONS)
    # The circle through the origin along x and (4, 1) has the curvature 2 y / (x^2 + y^2) = 2 / 17. A pair of arcs may
    # have more curvature first and less later.
    assert plan.commands[0].turn_left_rad / plan.commands[0].forward_m == pytest.approx(2.0 / 17.0, abs=0.05)
    positions = _drive_to_goal(_map_ground(), _make_pose(0.0, 0.0), np.array([4.0, 1.0]), 0.3)
    assert positions[-1] == pytest.approx([4.0, 1.0], abs=0.02)


def test_goal_behind_requires_a_turn() -> None:
    command = _navigate(_map_ground(), 0.0, -3.0).commands[0]
    assert command.length_m == 0.0
    assert abs(command.turn_left_rad) > np.radians(90.0)


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
    assert _navigate(_map_ground((3.0, 0.0, 0.25, 0.1)), 0.0, 6.0).commands == (DriveCommand(0.5),)


def test_ramp_is_climbed_up_to_the_maximum_tilt() -> None:
    for slope_deg in (25.0, 29.0):
        assert _navigate(_map_ground(slope_deg=slope_deg), 0.0, 5.0).outcome is NavigationOutcome.PATH
    # The plan must not enter a ramp of 35 deg, which starts at 2 m.
    points = _sample_ground()
    points[:, 2] = np.tan(np.radians(35.0)) * np.maximum(points[:, 0] - 2.0, 0.0)
    steep = TerrainMap.empty(np.zeros(2)).add_points(points)
    assert _navigate(steep, 0.0, 5.0).outcome is NavigationOutcome.NO_PATH


def test_target_rock_is_avoided_unless_it_is_excluded() -> None:
    terrain = _map_ground((6.0, 0.0, 0.6, 0.8))
    assert _navigate(terrain, 3.0, 4.8).outcome is NavigationOutcome.NO_PATH
    plan = _navigate(terrain.without_hazards(np.array([6.0, 0.0]), 0.8), 3.0, 4.8)
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
    rock, goal = (1.2, 0.0, 0.25, 0.4), np.array([6.0, 0.0])
    one_sector, two_sectors = (_map_stereo_sectors(-2.8, azimuths, rock) for azimuths in ((90.0,), (70.0, 110.0)))
    assert _navigate(one_sector, 0.0, 6.0).outcome is NavigationOutcome.NO_PATH
    assert _drive_to_goal(two_sectors, _make_pose(0.0, 0.0), goal, 0.5)[-1] == pytest.approx(goal, abs=0.02)
    # Without the rock one sector is wide enough.
    assert _navigate(_map_stereo_sectors(-2.8, (90.0,)), 0.0, 6.0).outcome is NavigationOutcome.PATH


def test_rover_on_unmapped_ground_has_no_path() -> None:
    # The sectors start 1.8 m from the cameras: the ground at 0 m and 1 m is not mapped, the ground at 3 m is.
    terrain = _map_stereo_sectors(0.0, (70.0, 110.0))
    outcomes = [_navigate(terrain, east, 7.0).outcome for east in (0.0, 1.0, 3.0)]
    assert outcomes == [NavigationOutcome.NOT_MAPPED] * 2 + [NavigationOutcome.PATH]


def test_plan_with_a_long_step_contains_both_arcs_of_the_path() -> None:
    plan = navigate(_map_ground((3.0, 0.0, 0.25, 0.4)), _make_pose(0.0, 0.0), np.array([6.0, 0.0]), 20.0, OPTIONS)
    curvatures = [command.turn_left_rad / command.forward_m for command in plan.commands if command.forward_m]
    assert len(curvatures) == 2
    pose = _make_pose(0.0, 0.0)
    for command in plan.commands:
        pose = _apply_command(pose, command)
    assert pose.translation[:2] == pytest.approx([6.0, 0.0], abs=0.01)


def test_invalid_options_are_rejected() -> None:
    with pytest.raises(ValueError, match="half_width_m is 0"):
        NavigationOptions(half_width_m=0.0)
    with pytest.raises(ValueError, match="margin_m is -1"):
        NavigationOptions(margin_m=-1.0)


#: Limits of the rover: radius of its footprint, height of steps, tilt and roughness.
LIMITS = GroundLimits(radius_m=0.7, climb_m=0.2, tilt_rad=float(np.radians(30.0)), roughness_m=0.06)
EMPTY = TerrainMap.empty(np.zeros(2))
ORIGIN = np.zeros((1, 2))
#: Level ground within 3 m of the origin; points (east, north, up), metres.
LEVEL_POINTS = _sample_ground(half_width_m=3.0)


def test_plane_has_the_goodness_of_its_tilt() -> None:
    terrain = EMPTY.add_points(_sample_ground(slope_deg=15.0, half_width_m=3.0))
    # goodness at a tilt of 15 deg and a limit of 30 deg: 1 - 15 / 30; the tolerance covers the slope over half a cell
    assert terrain.goodness(LIMITS).at(ORIGIN)[0] == pytest.approx(0.5, abs=0.01)
    assert np.isnan(EMPTY.goodness(LIMITS).at(ORIGIN)[0])


@pytest.mark.parametrize("height", [0.3, -0.3])
def test_rocks_and_holes_are_hazards(height: float) -> None:
    points = _sample_ground(((1.0, 0.0, 0.25, height),), half_width_m=3.0)
    goodness = EMPTY.add_points(points).goodness(LIMITS)
    assert goodness.at(np.array([[1.0, 0.0]]))[0] == 0.0
    assert goodness.hazard_distances_m(ORIGIN)[0] == pytest.approx(1.0, abs=0.25 + CELL_M)


def test_single_false_match_is_not_a_hazard() -> None:
    outlier = np.array([[0.01, 0.01, 1.5]])
    goodness = EMPTY.add_points(np.concatenate([LEVEL_POINTS, outlier])).goodness(LIMITS)
    assert goodness.at(ORIGIN)[0] == pytest.approx(1.0)


def test_new_points_replace_old_ones_and_two_points_do_not_map_a_cell() -> None:
    terrain = EMPTY.add_points(LEVEL_POINTS).add_points(LEVEL_POINTS + np.array([0.0, 0.0, 0.4]))
    assert np.nanmin(terrain.median_m) == pytest.approx(0.4)
    few = EMPTY.add_points(np.array([[0.0, 0.0, 1.0], [0.02, 0.0, 1.0]]))
    assert not few.mapped_cells.any()


def test_points_outside_of_the_map_are_ignored() -> None:
    assert not EMPTY.add_points(LEVEL_POINTS + np.array([100.0, 0.0, 0.0])).mapped_cells.any()
    assert np.isnan(EMPTY.goodness(LIMITS).at(np.array([[100.0, 0.0]]))[0])


def test_plane_under_the_rover_does_not_replace_measurements() -> None:
    # The rover stands on the plane up = 0.1 east; the southern edge of the map is measured at a height of 1 m.
    normal = np.array([-0.1, 0.0, 1.0])
    terrain = EMPTY.add_points(LEVEL_POINTS[:600] + np.array([0.0, 0.0, 1.0])).add_plane(np.zeros(3), normal, 1.0)
    row, column = np.argwhere(np.isfinite(terrain.median_m) & (np.abs(terrain.median_m - 1.0) > 0.5))[0]
    east, _ = terrain.corner_m + CELL_M * np.array([column, row])
    assert terrain.median_m[row, column] == pytest.approx(0.1 * east)
    assert np.count_nonzero(np.abs(terrain.median_m - 1.0) < 1e-9) > 0


def test_ground_around_the_target_has_no_hazards() -> None:
    points = _sample_ground(((1.0, 0.0, 0.5, 0.6),), half_width_m=3.0)
    terrain = EMPTY.add_points(points).without_hazards(np.array([1.0, 0.0]), 0.8)
    assert terrain.goodness(LIMITS).at(np.array([[1.0, 0.0]]))[0] > 0.9


HEIGHT_M, BASELINE_M = 1.5, 0.2  #: Height of the cameras above the ground, and distance between them.


def _make_camera(left_m: float, toe_in_deg: float = 0.0) -> Cahv:
    """Create a mast camera, `left_m` to the left of the rover's axis: 30 deg down, 45 deg wide, 256 x 256 pixels."""
    turn = Rotation.from_euler("ZY", [toe_in_deg, 30.0], degrees=True)
    axis, right = turn.apply([1.0, 0.0, 0.0]), turn.apply([0.0, -1.0, 0.0])
    return Cahv.from_axes((305.0, 305.0), (256, 256), axis=axis, right=right, centre=np.array([0.4, left_m, HEIGHT_M]))


CAMERAS = _make_camera(0.5 * BASELINE_M, -0.5), _make_camera(-0.5 * BASELINE_M, 0.5)


def _render_pair(world_from_rover: RigidTransform, contrast: float = 1.0) -> StereoMeasurement:
    """Render a stereo pair of the plane z = 0; shot noise: the variance in counts is 0.09 (0.3**2) times the counts."""
    plane, noise = TexturedPlane(np.zeros(3), np.eye(3)[:2], step_m=0.01), np.random.default_rng(1)

    def render(camera: CameraModel) -> np.ndarray:
        relative = plane.radiance(camera.transform(world_from_rover)).astype(np.float64) / MEAN_RADIANCE
        mean = 1500.0 * (1.0 + contrast * (relative - 1.0))
        return np.rint(mean + 0.3 * np.sqrt(mean) * noise.standard_normal(mean.shape)).astype(np.uint16)

    return StereoMeasurement(render(CAMERAS[0]), render(CAMERAS[1]), CAMERAS)


#: True poses of the rover at the first and the second pair.
START = rigid(Rotation.identity(), np.zeros(3))
MOTION = rigid(Rotation.from_euler("ZYX", [6.0, 1.5, -1.0], degrees=True), np.array([0.5, 0.05, 0.02]))


def _make_prediction(path_fraction: float = 1.0, yaw_error_deg: float = 0.1) -> RigidTransform:
    """Predict `MOTION` as wheel odometry and gyros do: path times a fraction, with an error of the yaw."""
    turn = Rotation.from_rotvec([0.0, 0.0, np.radians(yaw_error_deg)])
    return rigid(MOTION.rotation * turn, path_fraction * MOTION.translation)


def test_rectified_points_are_on_the_plane() -> None:
    pair = RectifiedPair.from_measurement(_render_pair(START))
    points = pair.points(1.2, 5.0)
    assert len(points) > 20000
    # one pixel of disparity is 0.4 m in range at 5 m: the height error of a twentieth of a pixel is 6 mm
    assert abs(np.median(points[:, 2])) < 0.003
    assert np.percentile(np.abs(points[:, 2]), 90.0) < 0.03
    # limits of depth
    depth = (pair.points(1.2, 3.0) - pair.camera.c) @ pair.camera.a
    assert depth.max() <= 3.0 + 1e-9
    assert depth.min() > 1.2


@pytest.mark.parametrize("path_fraction", [1.0, 1.2, 0.9])
def test_motion_is_recovered_despite_a_wrong_prediction(path_fraction: float) -> None:
    result = estimate_motion(_render_pair(START), _render_pair(MOTION), _make_prediction(path_fraction))
    assert result.outcome is VisualOdometryOutcome.CONVERGED
    error_m = np.linalg.norm(result.first_from_second.translation - MOTION.translation)
    assert error_m < 0.005
    assert error_m < 4.0 * result.sigma_m
    error_rad = (result.first_from_second.rotation.inv() * MOTION.rotation).magnitude()
    assert np.degrees(error_rad) < 0.1
    assert result.inliers > 0.8 * result.features


def test_slip_is_measured() -> None:
    """A rover with full slip does not move; wheel odometry reports 0.3 m."""
    result = estimate_motion(
        _render_pair(START), _render_pair(START), rigid(Rotation.identity(), np.array([0.3, 0.0, 0.0]))
    )
    assert np.linalg.norm(result.first_from_second.translation) < 0.003


def test_ground_without_texture_is_an_expected_failure() -> None:
    result = estimate_motion(_render_pair(START, 0.0), _render_pair(MOTION, 0.0), _make_prediction())
    assert result.outcome in (VisualOdometryOutcome.TOO_FEW_FEATURES, VisualOdometryOutcome.TOO_FEW_INLIERS)
    assert result.first_from_second is None


def test_motion_with_too_few_inliers_after_the_last_adjustment_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(visual_odometry, "_ADJUSTMENTS", 1)
    monkeypatch.setattr(visual_odometry, "_MAX_NORMALISED_DISTANCE", 1e-6)
    result = estimate_motion(_render_pair(START), _render_pair(MOTION), _make_prediction())
    assert (result.outcome, result.inliers) == (VisualOdometryOutcome.TOO_FEW_INLIERS, 0)
    assert result.first_from_second is None


def test_motion_that_contradicts_the_gyros_is_rejected() -> None:
    result = estimate_motion(_render_pair(START), _render_pair(MOTION), _make_prediction(yaw_error_deg=2.5))
    assert result.outcome in (VisualOdometryOutcome.INCONSISTENT, VisualOdometryOutcome.TOO_FEW_FEATURES)
    assert result.first_from_second is None


def test_calibration_error_scales_the_motion() -> None:
    """A pair whose calibrated baseline is 5 % too long estimates a path that is 5 % too long."""
    wide = replace(CAMERAS[1], c=CAMERAS[0].c + 1.05 * (CAMERAS[1].c - CAMERAS[0].c))
    straight = rigid(Rotation.identity(), np.array([0.5, 0.0, 0.0]))
    pairs = [replace(_render_pair(pose), cameras=(CAMERAS[0], wide)) for pose in (START, straight)]
    result = estimate_motion(pairs[0], pairs[1], straight)
    assert np.linalg.norm(result.first_from_second.translation) / 0.5 == pytest.approx(1.05, abs=0.01)


def test_limits_of_depth_are_respected() -> None:
    pair = RectifiedPair.from_measurement(_render_pair(START))
    depth = (pair.points(1.2, 3.0) - pair.camera.c) @ pair.camera.a
    assert depth.max() <= 3.0 + 1e-9
    assert depth.min() > 1.2
