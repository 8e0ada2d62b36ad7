"""Tests of target coordinates, mast pointing, image roll and stereo: closed forms and round trips."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.vtt.options import VttOptions
from marsyard.algorithms.vtt.pointing import aim_at_pixel, aim_at_position, frame_centre, mast_angles
from marsyard.algorithms.vtt.prediction import (
    bearing_rad,
    designated_position_world,
    horizontal_axis,
    magnification,
    predicted_position,
    roll_angle,
    roll_points,
)
from marsyard.algorithms.vtt.stereo import disparity_px_m, epipolar_pixels, search_ranges, triangulate
from marsyard.sim.camera import Cahv
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import MastCalibration, MastGeometry, PixelTarget, RoverTarget, SiteTarget
from tests.algorithms.vtt.synthetic_drive import MAST, navcam, pancam, pose


def draw_targets(seed: int, count: int) -> np.ndarray:
    """Draw points on the ground around the rover, 2 to 12 m away, in the rover frame."""
    rng = np.random.default_rng(seed)
    azimuth, distance = rng.uniform(-2.5, 2.5, count), rng.uniform(2.0, 12.0, count)
    return np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), rng.uniform(-0.3, 0.5, count)], axis=1)


# ----- target coordinates -----


@pytest.mark.parametrize(
    ("direction", "degrees"), [((0, 1, 0), 0), ((1, 0, 0), 90), ((0, -1, 5), 180), ((-1, 0, 0), -90)]
)
def test_bearings_are_clockwise_from_north(direction: tuple[int, int, int], degrees: int) -> None:
    assert np.degrees(bearing_rad(np.array(direction, dtype=np.float64))) == pytest.approx(degrees)


# ----- mast pointing -----


def test_rounding_does_not_shift_subframe_borders() -> None:
    # A centred target puts the borders on whole pixels, where rounding depends on the last bit.
    target, options = np.array([6.0, 0.5, 0.1]), VttOptions()
    aim = aim_at_position(target, navcam(), options)
    for offset_m in (-1e-13, 1e-13, -3e-12, 3e-12):
        shifted_aim = aim_at_position(target + offset_m, navcam(), options)
        assert (shifted_aim.left, shifted_aim.right) == (aim.left, aim.right)


@pytest.mark.parametrize("mast", [navcam(), pancam()])
def test_pointing_centres_the_target(mast: MastCalibration) -> None:
    for target in draw_targets(2, 20):
        angles = mast_angles(target, mast)
        assert angles is not None
        target_in_head = mast.geometry.rover_from_head(*angles).inv().apply(target)
        np.testing.assert_allclose(mast.left.project(target_in_head)[0], frame_centre(mast.left), atol=1e-4)


def test_pointing_a_pair_splits_the_disparity() -> None:
    mast = pancam()
    for target in draw_targets(3, 20):
        angles = mast_angles(target, mast, use_both=True)
        assert angles is not None
        target_head = mast.geometry.rover_from_head(*angles).inv().apply(target)
        left, right = (camera.project(target_head)[0] - frame_centre(camera) for camera in (mast.left, mast.right))
        np.testing.assert_allclose(left + right, 0.0, atol=1e-4)
        distance = float(np.linalg.norm(target_head))
        # The disparity is f B / R to second order in the small angles.
        assert left[0] - right[0] == pytest.approx(3440.9 * 0.3 / distance, rel=0.02)


def test_near_targets_need_pair_centred_pointing() -> None:
    # 516 px of disparity at 2 m: if the left image is centred, the target is outside the right one of 1024 px.
    target = np.array([1.2, -0.1, 0.1])
    assert aim_at_position(target, pancam(), VttOptions()) is None
    aim = aim_at_position(target, pancam(), VttOptions(aim_pair=True))
    assert aim.left.corner[0] - aim.right.corner[0] > 400


def test_mast_limits_are_enforced() -> None:
    geometry = replace(MAST, azimuth_limits_rad=(-0.5, 0.5), elevation_limits_rad=(-0.6, 0.5))
    limited_mast = replace(navcam(), geometry=geometry)
    assert mast_angles(np.array([8.0, 1.0, 0.0]), limited_mast) is not None
    assert mast_angles(np.array([0.0, -8.0, 0.0]), limited_mast) is None  # to the right
    assert mast_angles(np.array([1.0, 0.0, 0.0]), limited_mast) is None  # at the foot of the mast


def test_aim_subframes_cover_the_search_windows() -> None:
    options = VttOptions()
    aim = aim_at_position(np.array([6.0, 0.5, 0.1]), navcam(), options)
    angles = (aim.azimuth_rad, aim.elevation_rad)
    target_in_head = navcam().geometry.rover_from_head(*angles).inv().apply(np.array([6.0, 0.5, 0.1]))
    # Half the window on each side. The right image adds half the disparity range and two rows of epipolar tolerance.
    for camera, box, half_size in (
        (navcam().left, aim.left, np.array([80.0, 80.0])),
        (navcam().right, aim.right, np.array([120.0, 82.0])),
    ):
        pixel = camera.project(target_in_head)[0]
        assert np.all(pixel - half_size >= box.corner)
        assert np.all(pixel + half_size <= np.add(box.corner, box.size) - 1)


def test_pixel_designation_uses_its_pixel_and_covers_all_ranges() -> None:
    mast, options = navcam(), VttOptions(seed_range_m=(2.0, 30.0))
    aim = aim_at_pixel(PixelTarget(np.array([400.0, 700.0]), 0.3, -0.2), mast, options)
    assert (aim.azimuth_rad, aim.elevation_rad) == (0.3, -0.2)
    _, direction = mast.left.rays(np.array([400.0, 700.0]))
    for range_m in (2.0, 5.0, 30.0):
        pixel = mast.right.project(mast.left.c + range_m * direction)[0]
        assert np.all(pixel - 12.0 >= aim.right.corner)
        assert np.all(pixel + 12.0 <= np.add(aim.right.corner, aim.right.size) - 1)
    assert aim_at_pixel(PixelTarget(np.array([400.0, 1100.0]), 0.3, -0.2), mast, options) is None


# ----- magnification and roll -----


def test_magnification_is_the_ratio_of_distances_to_the_camera() -> None:
    old_centre, new_centre = np.array([0.0, 3.0, 0.0]), np.array([0.0, 0.0, 1.0])
    assert magnification(np.array([4.0, 0.0, 0.0]), old_centre, np.array([2.0, 0.0, 1.0]), new_centre) == 2.5


def test_horizontal_axis_follows_skewed_image() -> None:
    h, v = np.array([500.0, -1200.0, 30.0]), np.array([400.0, 0.0, -1200.0])
    skewed_camera = Cahv(np.zeros(3), np.array([1.0, 0.0, 0.0]), h, v, (1024, 1024))
    np.testing.assert_allclose(horizontal_axis(skewed_camera), skewed_camera.right, atol=1e-12)
    np.testing.assert_allclose(horizontal_axis(navcam().left), navcam().left.right, atol=1e-12)


def test_passing_a_target_rolls_its_image() -> None:
    # Fig. 4 of the tracking paper, for a level rover: the azimuth to the target changes by t at a depression angle d. A
    # horizontal line that was perpendicular to the line of sight is then inclined by atan(tan t sin d) in the image.
    mast = replace(navcam(), geometry=MastGeometry(np.array([0.0, 0.0, 1.5]), np.zeros(3), np.zeros(3)))
    mast = replace(mast, left=mast.left.transform(rigid(Rotation.identity(), np.array([0.0, -0.1, 0.0]))))
    target, positions_m = np.array([6.8, 0.0, 0.0]), [(0.0, 0.0), (5.6, 0.9)]
    heads = []
    for x, y in positions_m:
        stop = pose(x, y)
        angles = mast_angles(stop.inv().apply(target), mast)
        assert angles is not None
        heads.append(stop * mast.geometry.rover_from_head(*angles))
    new_from_old = heads[1].inv() * heads[0]
    points = roll_points(heads[0].inv().apply(target), mast.left, mast.left, new_from_old, 0.001)
    assert points is not None
    roll = roll_angle(points)
    azimuth_change = np.arctan2(0.9, 1.2)  # to the right
    depression = np.arctan2(1.5, np.hypot(0.9, 1.2))
    expected = np.arctan(np.tan(azimuth_change) * np.sin(depression))
    assert abs(np.degrees(roll)) == pytest.approx(np.degrees(expected), abs=0.5)
    assert abs(np.degrees(roll)) > 25.0
    # The right-hand side of the first image is farther away in the second, so it is higher: counter-clockwise roll.
    assert roll < 0.0


def test_roll_is_undefined_for_invisible_targets() -> None:
    camera = navcam().left
    behind = rigid(Rotation.from_rotvec([0.0, 0.0, np.pi]), np.zeros(3))
    assert roll_points(np.array([5.0, 0.0, 0.0]), camera, camera, behind, 0.05) is None


# ----- stereo -----


@pytest.mark.parametrize("mast", [navcam(), pancam()])
def test_epipolar_curve_contains_points_of_the_ray(mast: MastCalibration) -> None:
    pixel = np.array([700.3, 250.8])
    curve = epipolar_pixels(mast.left.rays(pixel), mast.left, mast.right, (2.0, 20.0))
    _, direction = mast.left.rays(pixel)
    for range_m in (2.0, 3.3, 7.0, 20.0):
        u, v = mast.right.project(mast.left.c + range_m * direction)[0]
        assert np.interp(u, curve[::-1, 0], curve[::-1, 1]) == pytest.approx(v, abs=1e-3)
    assert np.abs(np.diff(curve[:, 0])).max() < 0.6


def test_search_ranges_follow_disparity_steps() -> None:
    left, right = navcam().left, navcam().right
    min_range_m, max_range_m = search_ranges(left, right, 5.0, 20.0)
    scale = disparity_px_m(left, right)
    assert scale == pytest.approx(1222.5 * 0.2)
    assert scale / min_range_m - scale / 5.0 == pytest.approx(20.0)
    assert scale / 5.0 - scale / max_range_m == pytest.approx(20.0)
    assert search_ranges(left, right, 30.0, 20.0)[1] > 1e5  # 20 px exceed the disparity of 8 px: no upper limit


def test_diverging_lines_of_sight_have_no_range() -> None:
    left, right = navcam().left, navcam().right
    distant_point = np.array([1e3, 0.0, 0.0])
    left_pixel, right_pixel = left.project(distant_point)[0], right.project(distant_point)[0]
    assert triangulate(left, right, left_pixel, right_pixel) is not None
    assert triangulate(left, right, left_pixel, right_pixel + np.array([3.0, 0.0])) is None  # they diverge
    assert triangulate(left, left, left_pixel, left_pixel) is None


def draw_pose(rng: np.random.Generator) -> RigidTransform:
    """Draw a pose with a random attitude and position."""
    return rigid(Rotation.random(rng=rng), rng.normal(0.0, 5.0, 3))


@pytest.mark.parametrize("roll_deg", [-30.0, -3.0, 0.0, 12.0, 80.0])
def test_image_roll_is_opposite_to_camera_roll(roll_deg: float) -> None:
    camera = navcam().left
    # The head rolls clockwise about its line of sight (+x forward): the image rolls counter-clockwise.
    roll_motion = rigid(Rotation.from_rotvec(np.deg2rad(roll_deg) * camera.a), np.zeros(3))
    target = camera.c + 5.0 * camera.rays(frame_centre(camera))[1]
    points = roll_points(target, camera, camera, roll_motion.inv(), 0.05)
    assert points is not None
    roll = roll_angle(points)
    # The lens axis is 5 px from the rotation centre: the target moves in the image.
    assert np.degrees(roll) == pytest.approx(-roll_deg, abs=0.3)


def test_mast_rotates_about_both_axes_in_order() -> None:
    for azimuth, elevation in ((0.7, -0.4), (-2.1, 0.3)):
        pan = Rotation.from_rotvec([0.0, 0.0, -azimuth])
        rotation = pan * Rotation.from_rotvec([0.0, -elevation, 0.0])
        rover_from_head = MAST.rover_from_head(azimuth, elevation)
        np.testing.assert_allclose(rover_from_head.rotation.as_matrix(), rotation.as_matrix(), atol=1e-14)
        position = MAST.base_m + pan.apply(MAST.elbow_m) + rotation.apply(MAST.head_m)
        np.testing.assert_allclose(rover_from_head.translation, position, atol=1e-14)


def test_rover_and_site_coordinates_agree() -> None:
    # Site coordinates are north, east, down: 3 m north, 4 m east and 1 m below the origin.
    site = designated_position_world(SiteTarget(np.array([3.0, 4.0, 1.0])), pose(9.0, 9.0, 1.0))
    np.testing.assert_allclose(site, [4.0, 3.0, -1.0], atol=1e-12)
    # For a rover at (4, 1) that faces north, the target is 2 m ahead and 1 m below.
    rover = designated_position_world(RoverTarget(np.array([2.0, 0.0, -1.0])), pose(4.0, 1.0, np.pi / 2))
    np.testing.assert_allclose(rover, site, atol=1e-12)


def test_target_is_fixed_while_the_rover_moves() -> None:
    # 5 m ahead; after a drive of 1 m and a left turn of 90 deg the target is 4 m to the right.
    predicted = predicted_position(np.array([5.0, 0.0, 0.2]), pose(0.0, 0.0), pose(1.0, 0.0, np.pi / 2))
    np.testing.assert_allclose(predicted, [0.0, -4.0, 0.2], atol=1e-12)
    rng = np.random.default_rng(1)
    old, new, point = draw_pose(rng), draw_pose(rng), rng.normal(size=3)
    np.testing.assert_allclose(new.apply(predicted_position(point, old, new)), old.apply(point), atol=1e-12)


@pytest.mark.parametrize("mast", [navcam(), pancam()])
def test_triangulation_inverts_projection(mast: MastCalibration) -> None:
    rng = np.random.default_rng(4)
    for point in rng.uniform([2.0, -0.15, -0.15], [12.0, 0.15, 0.15], (20, 3)):
        result = triangulate(mast.left, mast.right, mast.left.project(point)[0], mast.right.project(point)[0])
        assert result is not None
        np.testing.assert_allclose(result, point, atol=1e-6)
