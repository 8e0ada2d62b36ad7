"""Tests of match offsets from the epipolar constraint of the poses, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.scenarios.measured.consistency import PairAgreement, PairMatches, agreement_row, epipolar_offsets_px
from marsyard.sim.camera import Cahv, Cahvor
from marsyard.sim.frames import rigid

CAMERA = Cahvor.from_cahv(
    Cahv(
        np.zeros(3),
        np.array([0.0, 0.0, -1.0]),
        np.array([800.0, 0.0, -320.0]),
        np.array([0.0, -800.0, -240.0]),
        (640, 480),
    ),
    r=np.array([0.0, 0.05, -0.01]),
)
TURN = Rotation.from_euler("xyz", [3.0, -2.0, 20.0], degrees=True)


@pytest.mark.parametrize("moved_m", [0.0, 0.05, 40.0])
def test_correct_poses_have_zero_offsets(moved_m: float) -> None:
    rng = np.random.default_rng(1)
    second = CAMERA.transform(rigid(TURN, moved_m * np.array([1.0, 0.4, 0.1])))
    points = np.stack([rng.uniform(-30, 30, 400), rng.uniform(-25, 25, 400), -100.0 - rng.uniform(0, 50, 400)], axis=1)
    if moved_m == 0.0:
        points *= 1e4  # for any distance
    actual, expected = CAMERA.project(points)[0], second.project(points)[0]
    assert np.abs(epipolar_offsets_px(CAMERA, second, actual, expected)).max() < 1e-5


def test_only_error_across_epipolar_line_is_an_offset() -> None:
    """A camera that moves along its columns has horizontal epipolar lines near the image centre."""
    pinhole = Cahv(CAMERA.c, CAMERA.a, CAMERA.h, CAMERA.v, CAMERA.size)
    second = pinhole.transform(rigid(Rotation.identity(), np.array([5.0, 0.0, 0.0])))
    points = np.array([[0.0, 0.0, -100.0], [10.0, -6.0, -120.0], [-4.0, 7.0, -90.0]])
    actual, expected = pinhole.project(points)[0], second.project(points)[0]
    across = epipolar_offsets_px(pinhole, second, actual, expected + np.array([0.0, 2.0]))
    along = epipolar_offsets_px(pinhole, second, actual, expected + np.array([3.0, 0.0]))
    assert np.allclose(across, [0.0, 2.0], atol=0.05)  # nearest in angle, not in pixels
    assert np.allclose(along, 0.0, atol=1e-6)
    # A match behind infinity is off by its distance from infinity.
    infinity = second.project(1e9 * pinhole.rays(actual)[1])[0]
    beyond = epipolar_offsets_px(pinhole, second, actual, infinity + np.array([4.0, 0.0]))
    assert np.allclose(beyond, [4.0, 0.0], atol=0.05)


def test_pure_rotation_maps_to_one_point() -> None:
    second = CAMERA.transform(rigid(TURN, np.zeros(3)))
    actual = np.array([[300.0, 200.0], [400.0, 260.0]])
    expected = second.project(1e3 * CAMERA.rays(actual)[1])[0]
    result = epipolar_offsets_px(CAMERA, second, actual, expected + np.array([1.5, -2.0]))
    assert np.allclose(result, [1.5, -2.0], atol=1e-4)


def test_agreement_row_uses_inliers_only() -> None:
    offsets = np.full((40, 2), [3.0, 4.0])
    is_inlier = np.arange(40) < 20
    offsets[~is_inlier] = 500.0
    reported = agreement_row([PairAgreement(PairMatches(np.zeros((2, 40, 2)), is_inlier), offsets)])
    assert (reported["matches"], reported["residual_median_px"], reported["residual_90_percent_px"]) == (20, 5.0, 5.0)
    assert reported["outlier_fraction"] == 0.5
    few = agreement_row([PairAgreement(PairMatches(np.zeros((2, 40, 2)), np.arange(40) < 10), offsets)])
    assert np.isnan(few["residual_median_px"])
    assert few["pairs_matched"] == 0
