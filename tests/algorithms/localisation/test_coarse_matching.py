"""Tests of the coarse stage of localisation: matching on ray-traced images of synthetic terrain, and its consistency.

Three images with five patches each are matched with the map. All estimated positions are wrong by a common offset.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from marsyard.algorithms.localisation.coarse import CoarseFix, CoarseRefusal, find_coarse_position
from marsyard.algorithms.localisation.consistency import (
    OffsetErrors,
    OffsetTest,
    PatchGeometry,
    check_offsets,
    estimate_position_error,
    offset_covariance,
)
from marsyard.algorithms.localisation.interface import MapProduct
from marsyard.algorithms.localisation.map_sampling import elevation_at
from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.algorithms.localisation.posed_image import PosedImage
from tests.algorithms.localisation.synthetic_map import (
    MAP_PIXEL_M,
    Scene,
    make_camera,
    make_image,
    make_scene,
    map_from_fine,
)

OPTIONS = LvsOptions()
#: Heights of the three images above the ground.
HEIGHTS_M = (3500.0, 3410.0, 3320.0)
#: Covariance of position, velocity and attitude. 3.5 standard deviations of the position are more than the search
#: radius of 3.2 km; that of the attitude is 0.1 deg.
COVARIANCE = np.diag(np.repeat([1067.0, 1.0, np.radians(0.1)], 3) ** 2)
#: True minus estimated position (east, north), metres: a large and a small error.
OFFSET_M, NEAR_M = np.array([2400.0, -1800.0]), np.array([1000.0, -800.0])


def make_images(scene: Scene) -> tuple[PosedImage, ...]:
    """Render three images one second apart, with exact poses."""
    camera, images = make_camera(512), []
    for k, height in enumerate(HEIGHTS_M):
        position = np.array([130.0 + 30.0 * k, -210.0 + 20.0 * k, 0.0])
        position[2] = elevation_at(scene.map_product, position[:2]) + height
        attitude = Rotation.from_euler("zyx", [30 + 5 * k, 6 - 2 * k, -4], degrees=True)
        images.append(make_image(scene, camera, position, attitude, time_s=float(k)))
    return tuple(images)


@cache
def random_images() -> tuple[PosedImage, ...]:
    return make_images(make_scene())


def run_coarse_stage(
    images: tuple[PosedImage, ...], map_product: MapProduct, offset: np.ndarray, height_error_m: float = 0.0
) -> CoarseFix | CoarseRefusal:
    """Run the coarse stage with estimated positions that are wrong by `offset`, and by 150 m in height.

    The measured altitudes are wrong by `height_error_m`.
    """
    error = np.array([-offset[0], -offset[1], 150.0])
    wrong = [replace(image, position_m=image.position_m + error) for image in images]
    return find_coarse_position(wrong, [h + height_error_m for h in HEIGHTS_M], map_product, COVARIANCE, OPTIONS)


def test_exact_images_determine_offsets_up_to_the_limit_of_the_initial_error() -> None:
    """The search area extends beyond 3.2 km: offsets near its border are refused."""
    for offset_m in (OFFSET_M, OPTIONS.search_radius_m * np.array([0.8, -0.6])):
        fix = run_coarse_stage(random_images(), make_scene().map_product, offset_m)
        assert isinstance(fix, CoarseFix)
        # without noise: a tenth of a coarse pixel of 12 m; required: 100 m
        np.testing.assert_allclose(fix.offset_m, offset_m, atol=1.2)
        # the errors of the fix are much smaller than a patch's tolerance of 60 m
        assert np.sqrt(np.diag(fix.covariance)).max() < 20.0


def test_errors_of_pose_altitude_radiometry_and_noise_stay_within_100_m() -> None:
    rng = np.random.default_rng(3)
    images = []
    for image in random_images():
        haze = np.linspace(0.3, 0.6, image.radiance.shape[1], dtype=np.float32)
        hazy = haze + 0.4 * image.radiance**1.5
        noisy = (hazy + hazy.mean() / 40.0 * rng.standard_normal(hazy.shape)).astype(np.float32)
        attitude = Rotation.from_rotvec([2e-3, -3e-3, 5e-3]) * image.world_from_body
        images.append(replace(image, radiance=noisy, world_from_body=attitude))
    fix = run_coarse_stage(tuple(images), make_scene().map_product, OFFSET_M, height_error_m=30.0)
    assert isinstance(fix, CoarseFix)
    error = fix.offset_m - OFFSET_M
    # attitude errors of 3.6 mrad shift the ground by 12.6 m
    assert np.hypot(*error) < 20.0
    assert error @ np.linalg.solve(fix.covariance, error) < 13.8  # 99.9 % of chi-square with two degrees of freedom


def tilt_attitudes(images: tuple[PosedImage, ...], angle_deg: float) -> tuple[PosedImage, ...]:
    """Return the images with estimated attitudes that are wrong by a tilt about the north axis."""
    rotation = Rotation.from_euler("y", angle_deg, degrees=True)
    return tuple(replace(image, world_from_body=rotation * image.world_from_body) for image in images)


def test_attitudes_beyond_the_stated_error_are_refused() -> None:
    """10 deg of tilt: at least seven patches agree within 60 m on an offset that is wrong by 600 m."""
    result = run_coarse_stage(tilt_attitudes(random_images(), 10.0), make_scene().map_product, NEAR_M)
    assert result is CoarseRefusal.INCONSISTENT
    fix = run_coarse_stage(tilt_attitudes(random_images(), 0.1), make_scene().map_product, NEAR_M)
    assert isinstance(fix, CoarseFix)
    error = fix.offset_m - NEAR_M
    assert error @ np.linalg.solve(fix.covariance, error) < 13.8  # 99.9 % of chi-square with two degrees of freedom


def test_an_unrelated_map_is_refused() -> None:
    unrelated = make_scene(seed=11, fine=1).map_product
    assert run_coarse_stage(random_images(), unrelated, OFFSET_M) is CoarseRefusal.NO_CONSENSUS


def make_dunes(period_m: float) -> Scene:
    """Create flat ground with two crossed periodic patterns."""
    size = 1536
    phase = 2.0 * np.pi * np.arange(size) * (MAP_PIXEL_M / period_m)
    appearance = (1.0 + 0.1 * (np.sin(phase)[:, np.newaxis] + np.sin(0.97 * phase + 1.0))).astype(np.float32)
    return Scene(appearance, 1, map_from_fine(appearance, 1, np.zeros((size, size), np.float32)))


@pytest.mark.parametrize("period_m", [110.0, 400.0])
def test_periodic_dunes_are_refused(period_m: float) -> None:
    dunes = make_dunes(period_m)
    result = run_coarse_stage(make_images(dunes), dunes.map_product, OFFSET_M)
    assert isinstance(result, CoarseRefusal)


def test_uniform_ground_and_an_offset_beyond_the_search_radius_are_refused() -> None:
    flat, product = np.ones_like(random_images()[0].radiance), make_scene().map_product
    images = tuple(replace(image, radiance=flat) for image in random_images())
    assert run_coarse_stage(images, product, OFFSET_M) is CoarseRefusal.TOO_FEW_PATCHES
    assert isinstance(run_coarse_stage(random_images(), product, np.array([2800.0, 2200.0])), CoarseRefusal)


HEIGHT_M, SIDE_M = 3000.0, 1000.0
#: Standard deviations of position (m), velocity (m/s) and attitude (rad), per axis.
STATE_SD = np.repeat([800.0, 1.0, 2e-3], 3)
#: Time from each of the three images to the last one, s.
AGES_S = np.array([6.6, 3.3, 0.0])
FALSE_REFUSAL = 1e-4  #: Probability that correct patches are refused.
TEST = OffsetTest(outlier_probability=1e-3, false_refusal=FALSE_REFUSAL, chance_agreement=0.126)
#: Ground points relative to the nadir: up to 35 deg off nadir; the areas do not overlap.
POINTS_M = np.array([[0.0, 0.0], [1500.0, 200.0], [-1300.0, 700.0], [200.0, -1600.0], [-300.0, 1700.0]])


def make_patches() -> PatchGeometry:
    """Five patches on level ground in each of three images."""
    images = np.repeat(np.arange(3), 5)
    # the ground moves below the lander: each image shows other ground
    centres = np.tile(POINTS_M, (3, 1)) + 10_000.0 * images[:, np.newaxis]
    lines = np.column_stack([np.tile(POINTS_M, (3, 1)), np.full(15, -HEIGHT_M)])
    return PatchGeometry(images, centres, np.full(15, SIDE_M), lines, AGES_S[images])


ERRORS = OffsetErrors(np.full(15, 60.0), distortion_m=6.0, elevation_m=5.0, matching_m=3.5)
OFFSET_COVARIANCE = offset_covariance(make_patches(), np.diag(STATE_SD**2), ERRORS)


def find_offsets(state_errors: np.ndarray, height_errors_m: np.ndarray) -> np.ndarray:
    """Compute the exact offsets of the patches for errors of the state (true minus estimated) and of the heights.

    The true ray through the patch's pixel is intersected with the ground; no linearisation.
    """
    patches = make_patches()
    turned = Rotation.from_rotvec(state_errors[6:]).apply(patches.lines_m)
    heights = HEIGHT_M + height_errors_m[patches.images]
    hits = turned[:, :2] / -turned[:, 2:] * heights[:, np.newaxis]
    position = state_errors[:2] - patches.ages_s[:, np.newaxis] * state_errors[3:5]
    return np.asarray(position + hits - patches.lines_m[:, :2])


def draw(
    rng: np.random.Generator, attitude_rad: np.ndarray | None = None, state: np.ndarray | None = None
) -> np.ndarray:
    """Draw errors with the stated standard deviations, with other errors of attitude or state if they are given."""
    state = STATE_SD * rng.standard_normal(9) if state is None else state.copy()
    if attitude_rad is not None:
        state[6:] = attitude_rad
    offsets = find_offsets(state, 60.0 * (rng.standard_normal() + rng.standard_normal(3)))
    tangents = make_patches().lines_m[:, :2] / HEIGHT_M
    offsets += ERRORS.elevation_m * tangents * rng.standard_normal((15, 1))
    return np.asarray(offsets + np.hypot(ERRORS.distortion_m, ERRORS.matching_m) * rng.standard_normal((15, 2)))


def test_offsets_with_the_stated_errors_are_chi_square() -> None:
    """The ray geometry is exact in the drawn offsets: the linear model has the right signs and derivatives."""
    rng = np.random.default_rng(1)
    weights = np.linalg.inv(OFFSET_COVARIANCE)
    squares = np.array([o @ weights @ o for o in (draw(rng).ravel() for _ in range(400))])
    # 15 patches x 2 axes: the mean is 30, with a standard deviation of sqrt(60 / 400) for 400 draws; the tolerance is
    # 4 sigma plus 1 % for the effect of linearisation
    assert squares.mean() == pytest.approx(30.0, abs=4.0 * np.sqrt(60.0 / 400.0) + 0.3)
    # 5 % above the 95 % quantile: 4 standard deviations of a binomial number
    assert np.mean(squares > chi2.ppf(0.95, 30)) == pytest.approx(0.05, abs=4.0 * np.sqrt(0.05 * 0.95 / 400.0))


def test_position_error_is_estimated_with_its_covariance() -> None:
    """The normalised square of the estimate's error has the mean 2; its variance is below that of the mean offset."""
    rng, patches, state_covariance = np.random.default_rng(6), make_patches(), np.diag(STATE_SD**2)
    squares, errors, mean_errors = [], [], []
    for _ in range(400):
        state = STATE_SD * rng.standard_normal(9)
        offsets = draw(rng, state=state)
        estimate, covariance = estimate_position_error(offsets, patches, state_covariance, ERRORS)
        errors.append(estimate - state[:2])
        mean_errors.append(offsets.mean(axis=0) - state[:2])
        squares.append(errors[-1] @ np.linalg.solve(covariance, errors[-1]))
    # standard deviation of the mean of 400 draws: sqrt(4 / 400); 1 % for the effect of linearisation
    assert np.mean(squares) == pytest.approx(2.0, abs=4.0 * np.sqrt(4.0 / 400.0) + 0.02)
    assert np.var(errors) < 0.75 * np.var(mean_errors)


def test_stated_errors_are_accepted() -> None:
    rng = np.random.default_rng(2)
    results = [check_offsets(draw(rng), OFFSET_COVARIANCE, 0, TEST) for _ in range(200)]
    assert all(result.is_consistent for result in results)
    # 200 x 15 patches, of which 3 are expected to be removed: outlier_probability is 1e-3
    assert sum(np.count_nonzero(~result.members) for result in results) <= 12


def test_a_wrong_attitude_is_inconsistent() -> None:
    """10 deg of tilt: all patches are displaced by about 530 m, those at 35 deg off nadir by up to 230 m more.

    2 deg of heading: 57 m at a distance of 1.6 km, in opposite directions on both sides.
    """
    rng = np.random.default_rng(3)
    azimuths = rng.uniform(-np.pi, np.pi, 5)
    tilts = np.radians(10.0) * np.column_stack([np.cos(azimuths), np.sin(azimuths), np.zeros(5)])
    for error_rad in (*tilts, np.radians([0.0, 0.0, 2.0])):
        assert not check_offsets(draw(rng, error_rad), OFFSET_COVARIANCE, 0, TEST).is_consistent


def test_an_outlier_is_removed() -> None:
    offsets = draw(np.random.default_rng(4))
    offsets[7] += [80.0, -40.0]  # ten standard deviations
    result = check_offsets(offsets, OFFSET_COVARIANCE, 0, TEST)
    assert result.is_consistent
    np.testing.assert_array_equal(np.flatnonzero(~result.members), [7])


def test_more_outliers_than_chance_explains_are_inconsistent() -> None:
    """P(at least k of k wrong patches are near the others) = 0.126^k: above 1e-4 up to k = 4."""
    wrong, azimuths = np.array([0, 3, 6, 9, 12]), 2.0 * np.pi * np.arange(5) / 5.0
    for count, is_consistent in ((4, True), (5, False)):
        offsets = np.zeros((15, 2))
        offsets[wrong[:count]] = 200.0 * np.column_stack([np.cos(azimuths), np.sin(azimuths)])[:count]
        result = check_offsets(offsets, OFFSET_COVARIANCE, 0, TEST)
        np.testing.assert_array_equal(np.flatnonzero(~result.members), wrong[:count])
        assert result.outlier_probability == pytest.approx(0.126**count)
        assert result.normalised_square < result.limit
        assert result.is_consistent is is_consistent


def test_images_of_the_same_ground_share_the_map_error() -> None:
    """The error of equal squares is equal; half of it is common if they overlap by half; none without overlap."""
    centres = np.array([[0.0, 0.0], [0.0, 0.0], [0.5 * SIDE_M, 0.0], [0.0, SIDE_M]])
    lines = np.tile([0.0, 0.0, -HEIGHT_M], (4, 1))
    patches = PatchGeometry(np.arange(4), centres, np.full(4, SIDE_M), lines, np.zeros(4))
    errors = OffsetErrors(np.zeros(4), distortion_m=6.0, elevation_m=5.0, matching_m=0.0)
    covariance = offset_covariance(patches, np.zeros((9, 9)), errors).reshape(4, 2, 4, 2)
    np.testing.assert_allclose(covariance[0, 0, :, 0], 36.0 * np.array([1.0, 1.0, 0.5, 0.0]))
    np.testing.assert_array_equal(covariance[:, 0, :, 1], 0.0)


def test_a_single_patch_is_tested() -> None:
    result = check_offsets(np.array([[3.0, 0.0]]), np.eye(2), 0, TEST)
    assert result.normalised_square == pytest.approx(9.0)
    assert result.limit == pytest.approx(chi2.isf(FALSE_REFUSAL, 2))
    assert result.is_consistent
