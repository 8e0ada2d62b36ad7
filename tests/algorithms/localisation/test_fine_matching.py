"""Tests of the fine stage of localisation: pixels of landmarks in ray-traced images against the exact projection."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.algorithms.localisation.fine import LandmarkMatches, match_landmarks
from marsyard.algorithms.localisation.landmarks import Landmarks, select_landmarks
from marsyard.algorithms.localisation.map_sampling import elevation_at
from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.algorithms.localisation.pose_fit import fit_pose, pose_jacobian
from marsyard.algorithms.localisation.posed_image import PosedImage
from marsyard.sim.measurements import DetectorCalibration, DetectorImage
from tests.algorithms.localisation.synthetic_map import make_camera, make_image, make_scene, solve_position

OPTIONS = LvsOptions()
ATTITUDE = Rotation.from_euler("zyx", [30.0, 6.0, -4.0], degrees=True)
DIRECTION = np.array([0.75, -0.65, 0.15])  #: Direction of the position errors, about a unit vector.


@cache
def landmarks() -> Landmarks:
    return select_landmarks(make_scene().map_product, OPTIONS)


@cache
def exact_image(height_m: float, pixels: int = 512) -> PosedImage:
    """Render an image from a height above the ground; its estimated pose is exact."""
    position = np.array([130.0, -210.0, 0.0])
    position[2] = elevation_at(make_scene().map_product, position[:2]) + height_m
    return make_image(make_scene(), make_camera(pixels), position, ATTITUDE)


def run_fine_stage(image: PosedImage, sd_m: float) -> LandmarkMatches:
    """Match landmarks in an image whose position has the standard deviation `sd_m` along east and north."""
    sd = np.array([sd_m, sd_m, max(0.2 * sd_m, 5.0)])
    return match_landmarks(image, landmarks(), make_scene().map_product, sd, OPTIONS)


def pixel_errors(truth: PosedImage, matches: LandmarkMatches) -> np.ndarray:
    """Errors of the measured pixels, working pixels."""
    return (matches.measured_px - truth.world_camera.project(matches.points_m)[0]) / matches.working_pixel


@pytest.mark.parametrize(
    ("height_m", "pixels", "error_m"),
    [(4200.0, 768, 200.0), (4200.0, 768, 20.0), (2000.0, 512, 200.0), (1000.0, 512, 20.0), (500.0, 512, 20.0)],
)
def test_exact_images_match_without_bias(height_m: float, pixels: int, error_m: float) -> None:
    truth = exact_image(height_m, pixels)
    wrong = replace(truth, position_m=truth.position_m + error_m * DIRECTION)
    matches = run_fine_stage(wrong, error_m / 1.5)
    assert matches.attempted == OPTIONS.max_landmarks
    assert len(matches) > 0.9 * matches.attempted
    errors = pixel_errors(truth, matches)
    assert np.median(np.hypot(*errors.T)) < 0.03  # required: 0.15
    assert np.abs(errors.mean(axis=0)).max() < 0.01  # required: 0.03
    position = solve_position(wrong, matches.points_m, matches.measured_px)
    # required: 0.5 m (2 m at 4 km); a bias of 0.01 working pixels of 6.7 m is 0.07 m
    np.testing.assert_allclose(position, truth.position_m, atol=0.15)
    np.testing.assert_allclose(wrong.position_m + matches.translation_m, truth.position_m, atol=0.03 * error_m + 1.0)


def test_landmarks_are_accurate_despite_haze_noise_and_attitude_error() -> None:
    rng = np.random.default_rng(2)
    truth = exact_image(2000.0)
    haze = np.linspace(0.3, 0.6, truth.radiance.shape[1], dtype=np.float32)
    hazy = haze + 0.4 * truth.radiance**1.5
    noisy = (hazy + hazy.mean() / 80.0 * rng.standard_normal(hazy.shape)).astype(np.float32)
    attitude = Rotation.from_rotvec([2e-3, -3e-3, 4e-3]) * ATTITUDE
    wrong = replace(truth, radiance=noisy, position_m=truth.position_m + 60.0 * DIRECTION, world_from_body=attitude)
    matches = run_fine_stage(wrong, 40.0)
    assert len(matches) > 0.8 * matches.attempted
    errors = pixel_errors(truth, matches)
    assert np.median(np.hypot(*errors.T)) < 0.15
    assert np.abs(errors.mean(axis=0)).max() < 0.03
    position = solve_position(replace(wrong, world_from_body=ATTITUDE), matches.points_m, matches.measured_px)
    np.testing.assert_allclose(position, truth.position_m, atol=0.5)


def test_hidden_ground_and_wrong_ground_are_rejected() -> None:
    truth = exact_image(2000.0)
    # a third of the image is displaced by three pixels; a disk, such as the heat shield, hides a part
    radiance = truth.radiance.copy()
    radiance[:, 340:] = np.roll(truth.radiance, 3, axis=0)[:, 340:]
    v, u = np.mgrid[:512, :512]
    radiance[(u - 150.0) ** 2 + (v - 280.0) ** 2 < 60.0**2] = 0.2
    wrong = replace(truth, radiance=radiance, position_m=truth.position_m + 5.0 * DIRECTION)
    matches = run_fine_stage(wrong, 4.0)
    assert matches.accepted > len(matches) > 0.45 * matches.attempted
    errors = pixel_errors(truth, matches)
    assert np.hypot(*errors.T).max() < 1.5
    assert np.median(np.hypot(*errors.T)) < 0.1


def test_an_image_of_other_ground_has_no_matches() -> None:
    truth = exact_image(2000.0)
    for radiance in (np.flipud(truth.radiance).copy(), np.ones_like(truth.radiance)):
        for sd_m in (3.0, 130.0):
            matches = run_fine_stage(replace(truth, radiance=radiance), sd_m)
            assert len(matches) == 0
            assert matches.measured_px.shape == (0, 2)


def test_landmarks_lie_on_the_map_and_levels_are_nested() -> None:
    points, product = landmarks().points_m, make_scene().map_product
    pixels = np.rint((points[:, :2] - product.origin_m) / product.pixel_m).astype(int)
    np.testing.assert_array_equal(points[:, 2], product.elevation_m[pixels[:, 1], pixels[:, 0]])
    for level in (1, 3):
        cells = pixels // (OPTIONS.landmark_spacing_px << level)
        chosen = landmarks().levels >= level
        # one landmark, the best, in each occupied cell
        keys = cells[:, 0] * 10000 + cells[:, 1]
        assert len(np.unique(keys[chosen])) == np.count_nonzero(chosen) == len(np.unique(keys))
        best = np.zeros(keys.max() + 1)
        np.maximum.at(best, keys, landmarks().interest)
        np.testing.assert_array_equal(best[keys[chosen]], landmarks().interest[chosen])


def test_pose_jacobian_equals_finite_differences() -> None:
    image = exact_image(1000.0)
    points = np.array([[100.0, -200.0, 10.0], [600.0, 300.0, -40.0], [-300.0, 100.0, 60.0]])
    jacobian = pose_jacobian(image.world_camera, image.position_m, points)
    for k, step in enumerate([0.1, 0.1, 0.1, 1e-5, 1e-5, 1e-5]):
        change = np.zeros(6)
        change[k] = step
        plus, minus = image.correct(change[:3], change[3:]), image.correct(-change[:3], -change[3:])
        difference = plus.world_camera.project(points)[0] - minus.world_camera.project(points)[0]
        np.testing.assert_allclose(jacobian[:, :, k], difference / (2.0 * step), rtol=1e-5, atol=1e-6)


def test_pose_fit_rejects_wrong_half_of_the_matches() -> None:
    rng = np.random.default_rng(4)
    image = exact_image(1000.0)
    points = np.column_stack([rng.uniform(-700.0, 900.0, (120, 2)), rng.uniform(-50.0, 50.0, 120)])
    jacobian = pose_jacobian(image.world_camera, image.position_m, points)
    correction = np.array([6.0, -4.0, 3.0, 1e-3, -2e-3, 1.5e-3])
    displacements = jacobian @ correction + 0.05 * rng.standard_normal((120, 2))
    wrong = np.arange(120) % 2 == 0
    displacements[wrong] = rng.uniform(-12.0, 12.0, (60, 2))
    # standard deviations of position (m) and attitude (rad), noise and maximum residual (pixels)
    fit = fit_pose(jacobian, displacements, np.array([20.0, 20.0, 10.0, 2e-3, 2e-3, 2e-3]), 0.3, 1.2)
    assert fit.consistent[~wrong].all()
    assert fit.consistent[wrong].sum() <= 4  # by chance: pi 1.2^2 / 24^2 of 60 is 0.5
    np.testing.assert_allclose(fit.translation_m, correction[:3], atol=0.5)
    np.testing.assert_allclose(fit.rotation_rad, correction[3:], atol=5e-4)


def test_detector_image_is_corrected_for_offset_and_flat_field() -> None:
    truth = exact_image(2000.0)
    flat = np.linspace(0.5, 1.0, 512 * 512).reshape(512, 512)
    counts = np.rint(2000.0 * truth.radiance * flat + 50.0).astype(np.uint16)
    detector = DetectorCalibration(flat, 150e-6, 0.0, 0.0, 1, 50.0, 4095)
    image = PosedImage.from_detector(
        DetectorImage(counts, 7.0, truth.camera, detector), truth.position_m, truth.world_from_body
    )
    np.testing.assert_allclose(image.radiance, 2000.0 * truth.radiance, atol=1.01)
    assert image.time_s == 7.0
    assert image.radiance.dtype == np.float32
