"""Tests of the preparation of images for hazard detection: radiometry, common orientation and scale, band-pass."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.algorithms.hda import HdaOptions, Matches
from marsyard.algorithms.hda.preparation import MEAN_WINDOW_PX, filter_view, resample_second
from marsyard.algorithms.hda.scene import LandingScene, apply_flat_field, build_scene, project_points
from marsyard.algorithms.hda.structure import dense_structure
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DetectorImage
from marsyard.sim.sensor import Detector, DetectorParameters, natural_fall_off
from marsyard.sim.sensor.optics import OpticsParameters
from tests.algorithms.hda.relief_scene import Pass, make_bumps, make_camera, make_plane, make_pose, measure_pass

OPTIONS = HdaOptions(grid_px=8)
PREPARED = replace(OPTIONS, resample_second=True, filter_images=True)


@pytest.fixture(scope="module")
def scene() -> Pass:
    """A descent by 15 % of the height, with a rotation of 8 deg about the vertical and 3 deg about the other axes."""
    relief = make_bumps((1.2, 0.8, 0.4, 0.3), (-1.5, -1.0, 0.3, 0.2), base=make_plane(0.05, 0.02))
    return Pass(relief, (make_pose(0.0, 0.0, 10.0, 20.0), make_pose(0.2, -0.7, 8.5, 28.0, 3.0, 3.0)))


@pytest.fixture(scope="module")
def landing_scene(scene: Pass) -> LandingScene:
    return build_scene(measure_pass(scene))


def match_errors_px(scene: Pass, matches: Matches) -> np.ndarray:
    """Compute the distances of all matches from the true pixels."""
    return np.linalg.norm(matches.second - scene.camera(1).project(scene.ground(0, matches.first))[0], axis=1)


def test_resampled_image_covers_the_second_image(scene: Pass, landing_scene: LandingScene) -> None:
    motion = scene.second_from_first
    views, _ = resample_second(landing_scene.views, motion, 10.0)
    border_rays = landing_scene.views[1].camera.rays(landing_scene.views[1].camera.border(8))[1]
    pixels, _ = views[1].camera.project(motion.rotation.inv().apply(border_rays))
    assert np.all(pixels >= -1e-9)
    assert np.all(pixels <= np.array(views[1].camera.size) - 1.0 + 1e-9)


def test_opposite_direction_of_view_is_not_resampled(landing_scene: LandingScene) -> None:
    motion = rigid(Rotation.from_euler("x", 120.0, degrees=True), np.zeros(3))
    views, unchanged_motion = resample_second(landing_scene.views, motion, 10.0)
    assert views is landing_scene.views
    assert unchanged_motion is motion


def test_matches_after_rotation_and_descent_are_exact_with_resampling(scene: Pass, landing_scene: LandingScene) -> None:
    without, resampled = (
        dense_structure(
            landing_scene.views, scene.second_from_first, (9.0, 11.0), replace(OPTIONS, resample_second=resample)
        )
        for resample in (False, True)
    )
    errors = match_errors_px(scene, resampled)
    # biquadratic fit: up to 0.09 px towards whole pixels, and the relief of the bumps
    assert np.median(errors[resampled.accepted]) < 0.1
    assert resampled.accepted.mean() > 0.98
    assert np.median(match_errors_px(scene, without)[without.accepted]) > 1.5 * np.median(errors[resampled.accepted])
    # pixels and segments are those of the second image
    assert np.all(resampled.second[resampled.accepted] >= 0.0)
    first_camera = scene.camera(0)
    true_depths = (scene.ground(0, resampled.first) - first_camera.c) @ first_camera.a
    assert np.median(np.abs(resampled.depths - true_depths)) < 0.03


def test_matches_do_not_depend_on_the_exposure_with_the_filter(scene: Pass, landing_scene: LandingScene) -> None:
    """The second image of weak texture is 3 % brighter: the published sum of differences finds wrong matches."""
    first, second = (
        replace(view, counts=np.rint(gain * (1500.0 + 0.05 * (view.counts - 1500.0))).astype(np.uint16))
        for view, gain in zip(landing_scene.views, (1.0, 1.03), strict=True)
    )
    published, prepared = (
        dense_structure((first, second), scene.second_from_first, (9.0, 11.0), options)
        for options in (OPTIONS, PREPARED)
    )
    assert np.mean(match_errors_px(scene, published) <= 1.5) < 0.6
    assert np.mean(match_errors_px(scene, prepared) <= 1.5) > 0.9


def render_detector_image(transfer_row_s: float, clear_row_s: float) -> tuple[np.ndarray, DetectorImage]:
    """Render a scene with a brightness gradient, and its image, exposed for 4 ms with negligible noise."""
    optics = make_camera(320)
    rows, columns = optics.size[1], optics.size[0]
    rng = np.random.default_rng(3)
    scene = (0.2 + 0.1 * np.arange(columns) / columns + 0.02 * rng.standard_normal((rows, columns))).astype(np.float32)
    parameters = DetectorParameters(
        rows_summed=1,
        transfer_row_s=transfer_row_s,
        clear_row_s=clear_row_s,
        full_well_e=1e9,
        responsivity_e_s=4e9,
        gain_e_dn=4000.0,
        read_noise_e=0.0,
        calibration_error=0.0,
        optics=OpticsParameters(diffraction_px=0.0, diffusion_px=0.0, pixel_aperture=False),
    )
    detector = Detector.draw(natural_fall_off(optics), parameters, rng)
    return scene, DetectorImage(detector.expose(scene, rng), 0.0, optics, detector.calibration)


@pytest.mark.parametrize("row_times_s", [(0.0, 0.0), (5e-6, 0.0), (5e-6, 1e-6)])
def test_corrected_counts_match_ideal_image(row_times_s: tuple[float, float]) -> None:
    scene, image = render_detector_image(*row_times_s)
    counts = apply_flat_field(image).astype(np.float64)
    # Ideal counts: 4 ms x 4e9 e/s / 4000 e/DN. Each count is rounded twice, and the response is at least 0.65.
    expected = 0.004 * 4e9 / 4000.0 * scene
    assert np.abs(counts - expected).max() < 0.01 * expected.mean()
    smeared_counts = (image.counts - image.calibration.offset_dn) / image.calibration.flat_field
    max_smear = np.abs(smeared_counts - expected).max() / expected.mean()
    # The transfer of 240 rows takes 240 x 5 us = 1.2 ms, 30 % of the exposure time; lens fall-off reduces it.
    assert (max_smear > 0.2) == (row_times_s[0] > 0.0)


def test_filtered_image_has_no_local_mean(landing_scene: LandingScene) -> None:
    view = landing_scene.views[0]
    counts = filter_view(view).counts
    half = MEAN_WINDOW_PX
    inner = counts[half:-half, half:-half].astype(np.float64)
    assert abs(inner.mean() - 32768.0) < 0.05 * inner.std()
    # a brighter image has the same counts, up to rounding to 1 / 8 count
    brighter = filter_view(replace(view, counts=view.counts + np.uint16(100))).counts
    np.testing.assert_allclose(brighter.astype(np.int64), counts.astype(np.int64), atol=1)


def test_resampled_image_has_orientation_and_scale_of_the_first(scene: Pass, landing_scene: LandingScene) -> None:
    motion = scene.second_from_first
    views, resampled_from_first = resample_second(landing_scene.views, motion, 10.0)
    assert resampled_from_first.rotation.magnitude() < 1e-12
    # points at a depth of 10 m have the same distances in pixels in both images
    points = np.array([[0.3, -0.2, 10.0], [1.3, -0.2, 10.0], [0.3, 0.8, 10.0]])
    second_pixels, _ = views[1].camera.project(resampled_from_first.apply(points))
    focal = landing_scene.views[0].focal_px
    np.testing.assert_allclose(second_pixels - second_pixels[0], focal * 0.1 * (points - points[0])[:, :2], atol=1e-9)
    # both images of a point have the same brightness; 0.01 m of ground is 0.4 px
    pixels = np.array([[100.0, 80.0], [160.0, 120.0], [210.0, 100.0]])
    ground = scene.camera(0), scene.ground(0, pixels)
    camera_points = (ground[1] - ground[0].c) @ np.column_stack(
        [ground[0].right, np.cross(ground[0].a, ground[0].right), ground[0].a]
    )
    matched, is_visible = project_points(views[1].camera, resampled_from_first.apply(camera_points))
    original, _ = project_points(landing_scene.views[1].camera, motion.apply(camera_points))
    assert np.all(is_visible)
    for (u, v), (u2, v2) in zip(np.rint(matched).astype(int), original, strict=True):
        low_u, low_v = int(u2), int(v2)
        window = landing_scene.views[1].counts[low_v - 1 : low_v + 3, low_u - 1 : low_u + 3]
        assert window.min() <= views[1].counts[v, u] <= window.max()
