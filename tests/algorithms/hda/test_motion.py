"""Tests of two-view structure from motion on projected tracks: exact, noisy, with outliers and degenerate."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.hda import HdaOptions, Motion
from marsyard.algorithms.hda.estimator import motion_failure
from marsyard.algorithms.hda.kernels import motion as kernels
from marsyard.algorithms.hda.motion import estimate_motion, plane_depths
from marsyard.algorithms.interface import SiteOutcome
from marsyard.sim.frames import rigid

FOCAL_PX = 811.0
OPTIONS = HdaOptions()
STILL = rigid(Rotation.identity(), np.zeros(3))


def make_tracks(rng: np.random.Generator, relief: float, tracks: int = 59) -> tuple[np.ndarray, np.ndarray]:
    """Undistorted coordinates over the XC-55's field of view, and depths of about 10 m on ground with a slope of 6
    deg.
    """
    points_px = rng.uniform([-0.39, -0.29], [0.39, 0.29], (tracks, 2))
    return points_px, 10.0 * (1.0 + 0.1 * points_px[:, 0]) * (1.0 + relief * rng.standard_normal(tracks))


def draw_motion(rng: np.random.Generator, turn_rad: float = 0.05) -> RigidTransform:
    across = rng.uniform(0.0, 2.0 * np.pi)
    step = np.array([np.cos(across), np.sin(across), 0.3 * rng.standard_normal()])
    return rigid(Rotation.from_rotvec(rng.normal(0.0, turn_rad, 3)), rng.uniform(0.5, 1.5) * step)


def project_points(points_px: np.ndarray, depths: np.ndarray, true_motion: RigidTransform) -> np.ndarray:
    points = true_motion.apply(np.column_stack([points_px, np.ones(len(points_px))]) * depths[:, None])
    return points[:, :2] / points[:, 2:]


def solve_motion(points_px: np.ndarray, second: np.ndarray, start: RigidTransform = STILL) -> Motion:
    return estimate_motion(points_px, second, FOCAL_PX, np.full(len(points_px), 10.0), (start,), OPTIONS)


def errors(result: Motion, true_motion: RigidTransform, scale: float) -> tuple[float, float]:
    """Rotation error in radians, and translation error as a fraction of the baseline."""
    turn = (result.second_from_first.rotation * true_motion.rotation.inv()).magnitude()
    miss = scale * result.second_from_first.translation - true_motion.translation
    return float(turn), float(np.linalg.norm(miss) / np.linalg.norm(true_motion.translation))


@pytest.mark.parametrize("relief", [0.0, 0.02, 0.1])
def test_exact_tracks_give_exact_motion(relief: float) -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        points_px, depths = make_tracks(rng, relief)
        true_motion = draw_motion(rng)
        result = solve_motion(points_px, project_points(points_px, depths, true_motion))
        scale = depths[0] / result.depths[0]
        assert result.converged
        assert np.all(result.inliers)
        assert max(errors(result, true_motion, scale)) < 1e-6
        np.testing.assert_allclose(scale * result.depths, depths, rtol=1e-6)


def test_motion_noise_reaches_cramer_rao_bound() -> None:
    # The Cramer-Rao bound of the same problem uses a numerical Jacobian; one depth fixes the scale.
    rng = np.random.default_rng(2)
    points_px, depths = make_tracks(rng, 0.05)
    true_motion = draw_motion(rng, 0.03)
    exact = project_points(points_px, depths, true_motion)
    unknowns = np.concatenate([np.zeros(3), true_motion.translation, depths[1:]])

    def model(x: np.ndarray) -> np.ndarray:
        rotated = rigid(Rotation.from_rotvec(x[:3]) * true_motion.rotation, x[3:6])
        return (FOCAL_PX * project_points(points_px, np.concatenate([depths[:1], x[6:]]), rotated)).ravel()

    steps = 1e-6 * np.eye(len(unknowns))
    jacobian = np.stack([(model(unknowns + s) - model(unknowns - s)) / 2e-6 for s in steps], axis=1)
    noise_px = 0.02
    covariance = noise_px**2 * np.linalg.inv(jacobian.T @ jacobian)
    turns = []
    for _ in range(200):
        result = solve_motion(points_px, exact + rng.normal(0.0, noise_px / FOCAL_PX, exact.shape), true_motion)
        turns.append((result.second_from_first.rotation * true_motion.rotation.inv()).as_rotvec())
    ratio = np.std(turns, axis=0) / np.sqrt(np.diag(covariance)[:3])
    # The Cauchy loss at ten times the noise loses less than 1 % of efficiency. 200 draws have a standard deviation of 5
    # %.
    assert np.all(ratio < 1.2)
    assert np.all(ratio > 0.8)


def test_outlier_tracks_are_rejected() -> None:
    rng = np.random.default_rng(3)
    right = 0
    for _ in range(40):
        points_px, depths = make_tracks(rng, 0.03)
        true_motion = draw_motion(rng, 0.03)
        second = project_points(points_px, depths, true_motion)
        wrong = rng.random(len(points_px)) < 0.2
        second[wrong] += rng.normal(0.0, 20.0 / FOCAL_PX, (int(wrong.sum()), 2))
        result = solve_motion(points_px, second)
        scale = float(np.median(depths[~wrong] / result.depths[~wrong]))
        right += max(errors(result, true_motion, scale)) < 0.02
    # 97 % of such motions are correct (`marsyard.algorithms.hda.motion`): fewer than 36 of 40 have a probability of 1
    # %.
    assert right >= 36


def test_outlier_along_epipolar_line_is_rejected_by_depth() -> None:
    rng = np.random.default_rng(4)
    points_px, depths = make_tracks(rng, 0.02)
    true_motion = rigid(Rotation.identity(), np.array([1.0, 0.0, 0.0]))
    shown = depths.copy()
    shown[7] = 3.0
    result = solve_motion(points_px, project_points(points_px, shown, true_motion))
    assert result.residuals_px[7] < 1e-3
    assert not result.inliers[7]
    assert result.inliers.sum() == len(points_px) - 1


def test_best_of_two_initial_motions_is_selected() -> None:
    rng = np.random.default_rng(5)
    points_px, depths = make_tracks(rng, 0.02)
    true_motion = draw_motion(rng)
    second = project_points(points_px, depths, true_motion)
    away = rigid(Rotation.from_rotvec([0.0, 0.0, 2.5]), np.zeros(3))
    for starts in ((away, true_motion), (true_motion, away)):
        result = estimate_motion(points_px, second, FOCAL_PX, np.full(len(points_px), 10.0), starts, OPTIONS)
        assert errors(result, true_motion, depths[0] / result.depths[0])[0] < 1e-6


def test_scaling_does_not_change_residuals() -> None:
    rng = np.random.default_rng(6)
    points_px, depths = make_tracks(rng, 0.02)
    result = solve_motion(points_px, project_points(points_px, depths, draw_motion(rng))).scale(3.0)
    assert result.depths.mean() == pytest.approx(30.0, rel=0.3)
    np.testing.assert_allclose(
        project_points(points_px, result.depths, result.second_from_first),
        project_points(points_px, result.depths / 3.0, result.scale(1.0 / 3.0).second_from_first),
        atol=1e-12,
    )


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.05, -0.03, 0.1)])
@pytest.mark.parametrize("noise_px", [0.0, 0.1])
def test_pure_rotation_has_no_baseline(turn: tuple[float, float, float], noise_px: float) -> None:
    rng = np.random.default_rng(7)
    points_px, depths = make_tracks(rng, 0.05)
    true_motion = rigid(Rotation.from_rotvec(turn), np.zeros(3))
    second = project_points(points_px, depths, true_motion) + rng.normal(0.0, noise_px / FOCAL_PX, points_px.shape)
    result = solve_motion(points_px, second)
    assert result.parallax_px < 5.0 * noise_px + 1e-6
    assert motion_failure(result, OPTIONS) is SiteOutcome.NO_BASELINE


def test_tracks_without_rigid_motion_are_rejected() -> None:
    rng = np.random.default_rng(8)
    for _ in range(5):
        points_px, _ = make_tracks(rng, 0.05)
        result = solve_motion(points_px, points_px + rng.normal(0.0, 60.0 / FOCAL_PX, points_px.shape))
        assert motion_failure(result, OPTIONS) in (SiteOutcome.NO_MOTION, SiteOutcome.NO_BASELINE)
    assert motion_failure(None, OPTIONS) is SiteOutcome.NO_MOTION


def test_residuals_are_reprojection_errors_in_pixels() -> None:
    rng = np.random.default_rng(9)
    points_px, depths = make_tracks(rng, 0.05)
    true_motion = draw_motion(rng)
    second = project_points(points_px, depths, true_motion) + 0.01
    motion = kernels.Motion(true_motion.rotation.as_quat(scalar_first=True), true_motion.translation, 1.0 / depths)
    r = kernels.residuals(kernels.Matches(points_px, second, FOCAL_PX, 1.0), motion)
    np.testing.assert_allclose(r, -0.01 * FOCAL_PX, rtol=1e-9)


def test_level_ground_depths_match_a_plane() -> None:
    # A camera 10 m over level ground, tilted by 20 deg.
    tilt = np.deg2rad(20.0)
    up = np.array([0.0, -np.sin(tilt), -np.cos(tilt)])
    points_px = np.array([[0.0, 0.0], [0.3, 0.0], [0.0, 0.25], [0.0, -0.25]])
    depths = plane_depths(points_px, 10.0 / np.cos(tilt), up)
    points = np.column_stack([points_px, np.ones(4)]) * depths[:, None]
    np.testing.assert_allclose(points @ up, -10.0, rtol=1e-12)
    # Rays above the horizon do not meet the ground and get the measured range.
    assert plane_depths(np.array([[0.0, -5.0]]), 12.0, up)[0] == 12.0
