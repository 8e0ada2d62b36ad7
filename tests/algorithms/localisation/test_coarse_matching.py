"""Tests of the coarse stage of localisation on ray-traced images of synthetic terrain: position offset and refusals.

Three images with five patches each are matched with the map. All estimated positions are wrong by a common offset.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.algorithms.localisation.coarse import CoarseFix, CoarseRefusal, find_coarse_position
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
