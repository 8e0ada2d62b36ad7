"""Tests of two-view structure from motion on projected tracks: exact, noisy, with outliers and degenerate."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.hda import CameraMotion, HdaOptions
from marsyard.algorithms.hda.estimator import check_motion
from marsyard.algorithms.hda.kernels import motion as kernels
from marsyard.algorithms.hda.motion import MotionStart, estimate_motion, plane_depths, range_starts
from marsyard.algorithms.interface import SiteOutcome
from marsyard.sim.frames import rigid

FOCAL_PX = 811.0  #: XC-55: 6 mm / 7.4 um.
OPTIONS = HdaOptions()
NO_MOTION_START = rigid(Rotation.identity(), np.zeros(3))


def make_tracks(rng: np.random.Generator, relief: float, tracks: int = 59) -> tuple[np.ndarray, np.ndarray]:
    """Draw normalised image coordinates in the XC-55's field of view, and depths of about 10 m on a 6 deg slope.

    `relief` is the standard deviation of a depth from the slope, as a fraction of the depth.
    """
    points = rng.uniform([-0.39, -0.29], [0.39, 0.29], (tracks, 2))
    return points, 10.0 * (1.0 + 0.1 * points[:, 0]) * (1.0 + relief * rng.standard_normal(tracks))


def draw_motion(rng: np.random.Generator, rotation_sd_rad: float = 0.05) -> RigidTransform:
    """Draw a motion from the first to the second camera: mostly lateral, 0.5 m to 1.5 m, with a small rotation."""
    azimuth = rng.uniform(0.0, 2.0 * np.pi)
    translation = np.array([np.cos(azimuth), np.sin(azimuth), 0.3 * rng.standard_normal()])
    return rigid(Rotation.from_rotvec(rng.normal(0.0, rotation_sd_rad, 3)), rng.uniform(0.5, 1.5) * translation)


def project_points(points: np.ndarray, depths: np.ndarray, true_motion: RigidTransform) -> np.ndarray:
    """Compute the normalised coordinates in the second image, shape (n, 2)."""
    second = true_motion.apply(np.column_stack([points, np.ones(len(points))]) * depths[:, None])
    return second[:, :2] / second[:, 2:]


def solve_motion(points: np.ndarray, second: np.ndarray, start: RigidTransform = NO_MOTION_START) -> CameraMotion:
    """Estimate the motion from tracks; the initial depths are 10 m."""
    return estimate_motion(points, second, FOCAL_PX, (MotionStart(start, np.full(len(points), 10.0)),), OPTIONS)


def motion_errors(result: CameraMotion, true_motion: RigidTransform, scale: float) -> tuple[float, float]:
    """Compute the rotation error, radians, and the translation error as a fraction of the baseline."""
    rotation_error = (result.second_from_first.rotation * true_motion.rotation.inv()).magnitude()
    translation_error = scale * result.second_from_first.translation - true_motion.translation
    return float(rotation_error), float(np.linalg.norm(translation_error) / np.linalg.norm(true_motion.translation))


@pytest.mark.parametrize("relief", [0.0, 0.02, 0.1])
def test_motion_of_exact_tracks_is_exact(relief: float) -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        points, depths = make_tracks(rng, relief)
        true_motion = draw_motion(rng)
        result = solve_motion(points, project_points(points, depths, true_motion))
        scale = depths[0] / result.depths[0]
        assert result.converged
        assert np.all(result.inliers)
        assert max(motion_errors(result, true_motion, scale)) < 1e-6
        np.testing.assert_allclose(scale * result.depths, depths, rtol=1e-6)


def test_motion_noise_reaches_cramer_rao_bound() -> None:
    # The Cramer-Rao bound of the same problem uses a numerical Jacobian; one depth fixes the scale.
    rng = np.random.default_rng(2)
    points, depths = make_tracks(rng, 0.05)
    true_motion = draw_motion(rng, 0.03)
    exact = project_points(points, depths, true_motion)
    unknowns = np.concatenate([np.zeros(3), true_motion.translation, depths[1:]])

    def model(x: np.ndarray) -> np.ndarray:
        rotated = rigid(Rotation.from_rotvec(x[:3]) * true_motion.rotation, x[3:6])
        return (FOCAL_PX * project_points(points, np.concatenate([depths[:1], x[6:]]), rotated)).ravel()

    steps = 1e-6 * np.eye(len(unknowns))
    jacobian = np.stack([(model(unknowns + s) - model(unknowns - s)) / 2e-6 for s in steps], axis=1)
    noise_px = 0.02
    covariance = noise_px**2 * np.linalg.inv(jacobian.T @ jacobian)
    rotations = []
    for _ in range(200):
        result = solve_motion(points, exact + rng.normal(0.0, noise_px / FOCAL_PX, exact.shape), true_motion)
        rotations.append((result.second_from_first.rotation * true_motion.rotation.inv()).as_rotvec())
    ratio = np.std(rotations, axis=0) / np.sqrt(np.diag(covariance)[:3])
    # A Cauchy loss with a scale of ten times the noise increases the errors by less than 1 %. The standard deviation
    # of 200 draws is known to 5 %.
    assert np.all(ratio < 1.2)
    assert np.all(ratio > 0.8)


def test_outlier_tracks_are_rejected() -> None:
    rng = np.random.default_rng(3)
    correct_count = 0
    for _ in range(40):
        points, depths = make_tracks(rng, 0.03)
        true_motion = draw_motion(rng, 0.03)
        second = project_points(points, depths, true_motion)
        is_outlier = rng.random(len(points)) < 0.2
        second[is_outlier] += rng.normal(0.0, 20.0 / FOCAL_PX, (int(is_outlier.sum()), 2))
        result = solve_motion(points, second)
        scale = float(np.median(depths[~is_outlier] / result.depths[~is_outlier]))
        correct_count += max(motion_errors(result, true_motion, scale)) < 0.02
    # 97 % of such motions are correct (`marsyard.algorithms.hda.motion`). Fewer than 36 correct motions in 40 trials
    # have a probability of 1 %.
    assert correct_count >= 36


def test_outlier_along_epipolar_line_is_rejected_by_depth() -> None:
    rng = np.random.default_rng(4)
    points, depths = make_tracks(rng, 0.02)
    true_motion = rigid(Rotation.identity(), np.array([1.0, 0.0, 0.0]))
    wrong_depths = depths.copy()
    wrong_depths[7] = 3.0
    result = solve_motion(points, project_points(points, wrong_depths, true_motion))
    assert result.residuals_px[7] < 1e-3
    assert not result.inliers[7]
    assert result.inliers.sum() == len(points) - 1


def test_best_of_two_initial_motions_is_selected() -> None:
    rng = np.random.default_rng(5)
    points, depths = make_tracks(rng, 0.02)
    true_motion = draw_motion(rng)
    second = project_points(points, depths, true_motion)
    wrong_start = rigid(Rotation.from_rotvec([0.0, 0.0, 2.5]), np.zeros(3))
    for motions in ((wrong_start, true_motion), (true_motion, wrong_start)):
        starts = tuple(MotionStart(motion, np.full(len(points), 10.0)) for motion in motions)
        result = estimate_motion(points, second, FOCAL_PX, starts, OPTIONS)
        assert motion_errors(result, true_motion, depths[0] / result.depths[0])[0] < 1e-6


@pytest.mark.parametrize("rotation_vector", [(0.0, 0.0, 0.0), (0.05, -0.03, 0.1)])
@pytest.mark.parametrize("noise_px", [0.0, 0.1])
def test_pure_rotation_has_no_baseline(rotation_vector: tuple[float, float, float], noise_px: float) -> None:
    rng = np.random.default_rng(7)
    points, depths = make_tracks(rng, 0.05)
    true_motion = rigid(Rotation.from_rotvec(rotation_vector), np.zeros(3))
    second = project_points(points, depths, true_motion) + rng.normal(0.0, noise_px / FOCAL_PX, points.shape)
    result = solve_motion(points, second)
    assert result.parallax_px < 5.0 * noise_px + 1e-6
    assert check_motion(result, OPTIONS) is SiteOutcome.NO_BASELINE


def test_tracks_without_rigid_motion_are_rejected() -> None:
    rng = np.random.default_rng(8)
    for _ in range(5):
        points, _ = make_tracks(rng, 0.05)
        result = solve_motion(points, points + rng.normal(0.0, 60.0 / FOCAL_PX, points.shape))
        assert check_motion(result, OPTIONS) in (SiteOutcome.NO_MOTION, SiteOutcome.NO_BASELINE)
    assert check_motion(None, OPTIONS) is SiteOutcome.NO_MOTION


def test_slant_range_alone_determines_a_motion_by_the_baseline_of_the_campaigns() -> None:
    """Motions by 0.2 of the range with rotations of 4 deg, over inclined ground with rocks: from the range alone."""
    rng = np.random.default_rng(6)
    solved = {"plane perpendicular to the axis": 0, "all planes": 0}
    for _ in range(40):
        points = rng.uniform([-0.39, -0.29], [0.39, 0.29], (200, 2))
        normal = np.array([*np.tan(np.deg2rad(rng.normal(0.0, 12.0, 2))), 1.0])
        depths = plane_depths(points, 10.0, normal) * (1.0 + 0.04 * rng.standard_normal(len(points)))
        course = rng.uniform(0.0, 2.0 * np.pi)
        true_motion = rigid(
            Rotation.from_rotvec(np.deg2rad(rng.normal(0.0, 4.0, 3))),
            2.0 * np.array([np.cos(course), np.sin(course), 0]),
        )
        second = project_points(points, depths, true_motion)
        second[:20] += rng.uniform(-0.1, 0.1, (20, 2))
        starts = range_starts(points, 10.0)
        for name, used in (("plane perpendicular to the axis", starts[:1]), ("all planes", starts)):
            result = estimate_motion(points, second, FOCAL_PX, used, OPTIONS)
            rotation_error = (result.second_from_first.rotation * true_motion.rotation.inv()).magnitude()
            solved[name] += rotation_error < np.deg2rad(0.1)
    assert solved["all planes"] >= 39
    assert solved["plane perpendicular to the axis"] < solved["all planes"]


def test_level_ground_depths_match_a_plane() -> None:
    # A camera 10 m over level ground, tilted by 20 deg.
    tilt = np.deg2rad(20.0)
    up = np.array([0.0, -np.sin(tilt), -np.cos(tilt)])
    points = np.array([[0.0, 0.0], [0.3, 0.0], [0.0, 0.25], [0.0, -0.25]])
    depths = plane_depths(points, 10.0 / np.cos(tilt), up)
    ground = np.column_stack([points, np.ones(4)]) * depths[:, None]
    np.testing.assert_allclose(ground @ up, -10.0, rtol=1e-12)
    # A ray above the horizon does not intersect the ground: its depth is the measured range.
    assert plane_depths(np.array([[0.0, -5.0]]), 12.0, up)[0] == 12.0


def test_residuals_are_reprojection_errors_in_pixels() -> None:
    rng = np.random.default_rng(9)
    points, depths = make_tracks(rng, 0.05)
    true_motion = draw_motion(rng)
    second = project_points(points, depths, true_motion) + 0.01
    motion = kernels.MotionArrays(
        true_motion.rotation.as_quat(scalar_first=True), true_motion.translation, 1.0 / depths
    )
    residuals = kernels.residuals(kernels.MatchArrays(points, second, FOCAL_PX, 1.0), motion)
    np.testing.assert_allclose(residuals, -0.01 * FOCAL_PX, rtol=1e-9)
