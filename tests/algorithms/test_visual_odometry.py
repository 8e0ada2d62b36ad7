"""Tests of stereo and visual odometry with images of a textured plane, computed exactly from the cameras' rays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.navigation.stereo import RectifiedPair
from marsyard.algorithms.navigation.visual_odometry import VisualOdometryOutcome, estimate_motion
from marsyard.sim.camera import Cahv, CameraModel
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import StereoMeasurement

#: Spacing of the texture's samples on the ground, metres.
SPACING_M = 0.01
HEIGHT_M, BASELINE_M = 1.5, 0.2  #: Height of the cameras above the ground, and distance between them.


def _make_camera(left_m: float, toe_in_deg: float = 0.0) -> Cahv:
    """Create a mast camera, `left_m` to the left of the rover's axis: 30 deg down, 45 deg wide, 256 x 256 pixels."""
    turn = Rotation.from_euler("ZY", [toe_in_deg, 30.0], degrees=True)
    axis, right = turn.apply([1.0, 0.0, 0.0]), turn.apply([0.0, -1.0, 0.0])
    return Cahv.from_axes((305.0, 305.0), (256, 256), axis=axis, right=right, centre=np.array([0.4, left_m, HEIGHT_M]))


CAMERAS = _make_camera(0.5 * BASELINE_M, -0.5), _make_camera(-0.5 * BASELINE_M, 0.5)


def _make_texture(contrast: float) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    noise = np.random.default_rng(5).standard_normal((1600, 1600))
    smooth = gaussian_filter(noise, 1.5) + 4.0 * gaussian_filter(noise, 6.0)
    smooth /= smooth.std()

    def brightness(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        rows, columns = y / SPACING_M + 800.0, x / SPACING_M + 400.0
        return 1500.0 * (1.0 + contrast * map_coordinates(smooth, [rows, columns], order=1, mode="wrap"))

    return brightness


def _render_pair(world_from_rover: RigidTransform, contrast: float = 0.2) -> StereoMeasurement:
    """Render a stereo pair of the plane z = 0; shot noise: the variance in counts is 0.09 (0.3**2) times the counts."""
    brightness, noise = _make_texture(contrast), np.random.default_rng(1)

    def render(camera: CameraModel) -> np.ndarray:
        origins, directions = camera.transform(world_from_rover).rays(camera.pixel_grid())
        distance = -origins[..., 2] / np.minimum(directions[..., 2], -1e-6)
        points = origins + distance[..., None] * directions
        mean = brightness(points[..., 0], points[..., 1])
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
    points = RectifiedPair.from_measurement(_render_pair(START)).points(1.2, 5.0)
    assert len(points) > 20000
    # one pixel of disparity is 0.4 m in range at 5 m: the height error of a twentieth of a pixel is 6 mm
    assert abs(np.median(points[:, 2])) < 0.003
    assert np.percentile(np.abs(points[:, 2]), 90.0) < 0.03


def test_limits_of_depth_are_respected() -> None:
    pair = RectifiedPair.from_measurement(_render_pair(START))
    depth = (pair.points(1.2, 3.0) - pair.camera.c) @ pair.camera.a
    assert depth.max() <= 3.0 + 1e-9
    assert depth.min() > 1.2


@pytest.mark.parametrize("path_fraction", [1.0, 1.2, 0.9])
def test_motion_is_recovered_despite_a_wrong_prediction(path_fraction: float) -> None:
    result = estimate_motion(_render_pair(START), _render_pair(MOTION), _make_prediction(path_fraction))
    assert result.outcome is VisualOdometryOutcome.CONVERGED
    assert result.first_from_second is not None
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
    assert result.first_from_second is not None
    assert np.linalg.norm(result.first_from_second.translation) < 0.003


def test_ground_without_texture_is_an_expected_failure() -> None:
    result = estimate_motion(_render_pair(START, 0.0), _render_pair(MOTION, 0.0), _make_prediction())
    assert result.outcome in (VisualOdometryOutcome.TOO_FEW_FEATURES, VisualOdometryOutcome.TOO_FEW_INLIERS)
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
    assert result.first_from_second is not None
    assert np.linalg.norm(result.first_from_second.translation) / 0.5 == pytest.approx(1.05, abs=0.01)
