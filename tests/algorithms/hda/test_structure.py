"""Tests of epipolar search segments, dense matches, triangulation and scale on an exact scene."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.algorithms.hda import HdaDetails, HdaEstimator, HdaOptions, MatchStatus
from marsyard.algorithms.hda.kernels import matching
from marsyard.algorithms.hda.motion import CameraMotion
from marsyard.algorithms.hda.scene import LandingScene, build_scene, undistort
from marsyard.algorithms.hda.structure import (
    clip_to_image,
    dense_structure,
    epipolar_segments,
    forward_backward_error,
    grid_spacing_px,
    match_pixels,
    pixel_lattice,
    scale_factor,
    triangulate,
)
from marsyard.sim.frames import rigid
from tests.algorithms.hda.relief_scene import Pass, make_bumps, make_plane, make_pose, measure_pass

OPTIONS = HdaOptions(block_px=32, grid_px=8, align=True, refine_planes=True)
#: Slope with two bumps; the ground is 9 m to 11 m below the camera. Searches allow depths of 7 m to 13 m.
RELIEF = make_bumps((1.2, 0.8, 0.4, 0.3), (-1.5, -1.0, 0.3, 0.2), base=make_plane(0.05, 0.02))


@pytest.fixture(scope="module")
def scene() -> Pass:
    return Pass(RELIEF, (make_pose(0.0, 0.0, 10.0, 20.0, 2.0, -3.0), make_pose(0.3, -0.7, 10.1, 23.0, 3.0, -1.0)))


@pytest.fixture(scope="module")
def landing_scene(scene: Pass) -> LandingScene:
    return build_scene(measure_pass(scene))


def true_depths(scene: Pass, pixels: np.ndarray) -> np.ndarray:
    """Compute the depths of the ground at pixels of the first image, along its optical axis, metres."""
    first_camera = scene.camera(0)
    return np.asarray((scene.ground(0, pixels) - first_camera.c) @ first_camera.a)


def test_motion_from_poses_equals_camera_motion(scene: Pass, landing_scene: LandingScene) -> None:
    np.testing.assert_allclose(
        landing_scene.second_from_first.as_matrix(), scene.second_from_first.as_matrix(), atol=1e-12
    )


def test_segments_outside_the_image_are_rejected(scene: Pass, landing_scene: LandingScene) -> None:
    pixels = pixel_lattice((320, 240), 8, 6)
    positions = undistort(landing_scene.views[0].camera, pixels)
    view, motion = landing_scene.views[1], scene.second_from_first
    starts, ends, is_inside = epipolar_segments(view, motion, positions, (7.0, 13.0), 6)
    endpoints = np.concatenate([starts, ends], axis=1)
    expected = np.all((endpoints >= 6.0) & (endpoints <= np.array([313.0, 233.0, 313.0, 233.0])), axis=1)
    np.testing.assert_array_equal(is_inside, expected)
    assert 0 < is_inside.sum() < len(pixels)
    matches = match_pixels(landing_scene.views, scene.second_from_first, pixels, (7.0, 13.0), OPTIONS)
    np.testing.assert_array_equal(matches.first, pixels[is_inside])


def test_matches_and_depths_equal_exact_scene(scene: Pass, landing_scene: LandingScene) -> None:
    depths = true_depths(scene, pixel_lattice((320, 240), 16, 6))
    matches = dense_structure(landing_scene.views, scene.second_from_first, (depths.min(), depths.max()), OPTIONS)
    true_pixels = scene.camera(1).project(scene.ground(0, matches.first))[0]
    assert matches.accepted.mean() > 0.98
    error = np.linalg.norm(matches.second - true_pixels, axis=1)[matches.accepted]
    # Sources of error: the bias of the biquadratic fit (up to 0.09 px on each axis) and relief within a window.
    assert np.sqrt(np.mean(error**2)) < 0.15
    depth_errors = (matches.depths - true_depths(scene, matches.first))[matches.accepted]
    # This error divided by the parallax of 32 px is half a percent of the height.
    assert np.sqrt(np.mean(depth_errors**2)) < 0.005 * 10.0


def test_plane_of_features_determines_scale_without_local_matches(scene: Pass, landing_scene: LandingScene) -> None:
    rng = np.random.default_rng(8)
    positions = rng.uniform(-0.3, 0.3, (30, 2))
    depths = 1.0 / (0.1 + positions @ np.array([0.02, -0.03]))  # a plane at 10 m on the axis
    inliers = np.arange(30) != 4
    depths[4] = 3.0
    motion = CameraMotion(scene.second_from_first, depths, np.zeros(30), inliers, 20.0, converged=True)
    blank = np.full((240, 320), 1000, dtype=np.uint16)
    views = (replace(landing_scene.views[0], counts=blank), replace(landing_scene.views[1], counts=blank))
    assert scale_factor(views, motion, positions, 12.0, OPTIONS) == pytest.approx(1.2, rel=1e-9)


def test_unrelated_image_has_few_matches(scene: Pass, landing_scene: LandingScene) -> None:
    noise = np.random.default_rng(2).integers(500, 2500, (240, 320)).astype(np.uint16)
    views = (landing_scene.views[0], replace(landing_scene.views[1], counts=noise))
    matches = dense_structure(views, scene.second_from_first, (9.0, 11.0), OPTIONS)
    assert matches.accepted.mean() < 0.01


def test_diverging_lines_of_sight_have_no_depth() -> None:
    positions = np.array([[0.1, 0.2]])
    assert np.isnan(triangulate(positions, positions, rigid(Rotation.identity(), np.array([1.0, 0.0, 0.0])))[0])


def test_grid_is_centred_with_a_border() -> None:
    pixels = pixel_lattice((320, 240), 8, 6)
    assert pixels.min() >= 6.0
    assert np.all(pixels.max(axis=0) <= [313.0, 233.0])
    assert np.all(np.abs(pixels.mean(axis=0) - [159.5, 119.5]) <= 0.5)


@pytest.mark.parametrize("factor", [0.5, 1.0, 4.0])
def test_all_lengths_scale_with_the_altimeter(factor: float, scene: Pass) -> None:
    exact = measure_pass(scene)
    answer = HdaEstimator(OPTIONS).estimate(replace(exact, slant_range_m=factor * exact.slant_range_m))
    assert isinstance(answer.details, HdaDetails)
    motion = answer.details.motion
    # Required accuracy: 1 % of the baseline; the scale from the altimeter is exact.
    expected = factor * scene.second_from_first.translation
    assert np.linalg.norm(motion.second_from_first.translation - expected) < 0.01 * np.linalg.norm(expected)


def test_matches_failing_the_forward_backward_check_are_counted(scene: Pass, landing_scene: LandingScene) -> None:
    # Half of the second image is unrelated, and any correlation is accepted: matches there are random.
    counts = landing_scene.views[1].counts.copy()
    counts[:, 160:] = np.random.default_rng(2).integers(500, 2500, (240, 160))
    views = (landing_scene.views[0], replace(landing_scene.views[1], counts=counts))
    without_check, with_check = (
        dense_structure(
            views,
            scene.second_from_first,
            (9.0, 11.0),
            replace(OPTIONS, min_match_correlation=-1.0, max_forward_backward_px=tolerance),
        )
        for tolerance in (None, 1.5)
    )
    true_pixels = scene.camera(1).project(scene.ground(0, without_check.first))[0]
    is_wrong = np.linalg.norm(without_check.second - true_pixels, axis=1) > 1.5
    assert np.sum(without_check.accepted & is_wrong) > 100
    # Segments are about 25 px long and the tolerance is +-1.5 px: one in eight random matches passes the reverse check.
    assert np.sum(with_check.accepted & is_wrong) < 0.3 * np.sum(without_check.accepted & is_wrong)
    assert np.sum(with_check.accepted & ~is_wrong) > 0.95 * np.sum(without_check.accepted & ~is_wrong)
    # Other matches are unchanged, and each match has one outcome.
    np.testing.assert_array_equal(with_check.second, without_check.second)
    has_failed = with_check.statuses == MatchStatus.INCONSISTENT
    np.testing.assert_array_equal(with_check.accepted | has_failed, without_check.accepted)
    statuses = np.where(has_failed, MatchStatus.ACCEPTED, with_check.statuses)
    np.testing.assert_array_equal(statuses, without_check.statuses)
    assert len(with_check.points) == with_check.accepted.sum()


def test_segments_are_clipped_at_the_image_border() -> None:
    starts = np.array([[50.0, 50.0], [50.0, 50.0], [10.0, 10.0], [50.0, 50.0]])
    ends = np.array([[60.0, 40.0], [110.0, 80.0], [0.0, 20.0], [np.nan, 10.0]])
    result = clip_to_image((100, 80), starts, ends, 10.0)
    np.testing.assert_allclose(result, [[60.0, 40.0], [50.0 + 60.0 * 19.0 / 30.0, 69.0], [10.0, 10.0], [50.0, 10.0]])


def test_refined_grid_resolves_the_narrowest_hazard(landing_scene: LandingScene) -> None:
    """At 10 m a hazard of 0.3 m is f 0.03 = 12.2 px wide (f = 405 px): at least six grid points are 2 px apart."""
    view = landing_scene.views[0]
    options = replace(OPTIONS, grid_px=16, refine_grid=True, narrowest_hazard=1.5, max_roughness_m=0.2)
    assert grid_spacing_px(view, (9.0, 11.0), options) == 2
    assert grid_spacing_px(view, (900.0, 1100.0), options) == 1
    assert grid_spacing_px(view, (0.9, 1.1), options) == 16
    assert grid_spacing_px(view, (9.0, 11.0), replace(options, refine_grid=False)) == 16


def test_best_match_has_minimum_absolute_difference() -> None:
    rng = np.random.default_rng(1)
    first = rng.integers(0, 4096, (60, 90)).astype(np.uint16)
    second = np.roll(first, (3, 9), axis=(0, 1))
    pixels = np.array([[30, 25], [50, 40]])
    starts, ends = pixels + np.array([-2.0, -0.7]), pixels + np.array([18.0, 6.7])
    result = matching.match_along_epipolar_segments(first, second, pixels, starts, ends, 5)
    np.testing.assert_array_equal(result, pixels + np.array([9, 3]))
    expected_sum = int(np.abs(first[20:31, 25:36].astype(int) - second[20:31, 28:39].astype(int)).sum())
    assert matching.sum_absolute_differences(first, second, 25, 30, 25, 33, 5, 2**62) == expected_sum


def test_correct_matches_pass_the_forward_backward_check(scene: Pass, landing_scene: LandingScene) -> None:
    pixels = pixel_lattice((320, 240), 16, 6)
    positions = undistort(landing_scene.views[0].camera, pixels)
    _, _, is_inside = epipolar_segments(landing_scene.views[1], scene.second_from_first, positions, (7.0, 13.0), 6)
    pixels, positions = pixels[is_inside].astype(np.int64), positions[is_inside]
    true_pixels = np.rint(scene.camera(1).project(scene.ground(0, pixels.astype(np.float64)))[0]).astype(np.int64)
    forward_backward_px = forward_backward_error(
        landing_scene.views, scene.second_from_first, pixels, true_pixels, positions, (7.0, 13.0), 5
    )
    # Both searches use whole pixels: 0.7 px each, plus the effect of relief within a window.
    assert np.mean(forward_backward_px <= 1.5) > 0.98


def test_segment_position_determines_depth(scene: Pass, landing_scene: LandingScene) -> None:
    # With both depth bounds at the true depth, both ends are the true match: Eqs. 6-8 of the landing paper are
    # exact through the lens.
    pixels = np.array([[100.0, 80.0]])
    depth = float(true_depths(scene, pixels)[0])
    true_pixels = scene.camera(1).project(scene.ground(0, pixels))[0]
    positions = undistort(landing_scene.views[0].camera, pixels)
    starts, ends, _ = epipolar_segments(landing_scene.views[1], scene.second_from_first, positions, (depth, depth), 6)
    np.testing.assert_allclose(starts, true_pixels, atol=1e-6)
    np.testing.assert_allclose(ends, true_pixels, atol=1e-6)


def test_segments_contain_the_exact_match(scene: Pass, landing_scene: LandingScene) -> None:
    pixels = pixel_lattice((320, 240), 16, 10)
    true_pixels = scene.camera(1).project(scene.ground(0, pixels))[0]
    positions = undistort(landing_scene.views[0].camera, pixels)
    view, motion = landing_scene.views[1], scene.second_from_first
    starts, ends, is_inside = epipolar_segments(view, motion, positions, (7.0, 13.0), 6)
    assert is_inside.sum() > 100
    segments = (ends - starts)[is_inside]
    length = np.linalg.norm(segments, axis=1)
    offset = (true_pixels - starts)[is_inside]
    fraction = np.sum(offset * segments, axis=1) / length**2
    assert np.all((fraction > 0.0) & (fraction < 1.0))
    # Lens distortion bends the epipolar line by a few hundredths of a pixel over 25 px.
    normal_distance = np.abs(offset[:, 0] * segments[:, 1] - offset[:, 1] * segments[:, 0]) / length
    assert normal_distance.max() < 0.1


def test_triangulation_is_exact_and_precision_follows_parallax() -> None:
    rng = np.random.default_rng(3)
    positions = rng.uniform(-0.3, 0.3, (2000, 2))
    depths = rng.uniform(9.0, 11.0, 2000)
    true_motion = rigid(Rotation.from_rotvec([0.02, -0.03, 0.05]), np.array([1.0, 0.0, 0.0]))
    points = true_motion.apply(np.column_stack([positions, np.ones(2000)]) * depths[:, None])
    second = points[:, :2] / points[:, 2:]
    np.testing.assert_allclose(triangulate(positions, second, true_motion), depths, rtol=1e-10)
    noise = 1e-4
    noisy = triangulate(positions, second + rng.normal(0.0, noise, second.shape), true_motion)
    # dz = z^2 / baseline times the error along the epipolar line; rotation and field of view change this by
    # several percent.
    assert np.std((noisy - depths) / depths**2) == pytest.approx(noise, rel=0.1)
