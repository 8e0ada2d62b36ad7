"""Tests of the offsets of matched pixels from the epipolar curves of given camera poses, and of their summary."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.scenarios.measured.pose_agreement import PairAgreement, PairMatches, agreement_row, epipolar_offsets_px
from marsyard.sim.camera import Cahv, Cahvor
from marsyard.sim.frames import rigid

#: Camera of 640 x 480 pixels that looks along -z, with a focal length of 800 px and lens distortion.
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
ROTATION = Rotation.from_euler("xyz", [3.0, -2.0, 20.0], degrees=True)


@pytest.mark.parametrize("baseline_m", [0.0, 0.05, 40.0])
def test_offsets_are_zero_for_correct_poses(baseline_m: float) -> None:
    rng = np.random.default_rng(1)
    second_camera = CAMERA.transform(rigid(ROTATION, baseline_m * np.array([1.0, 0.4, 0.1])))
    points = np.stack([rng.uniform(-30, 30, 400), rng.uniform(-25, 25, 400), -100.0 - rng.uniform(0, 50, 400)], axis=1)
    if baseline_m == 0.0:
        # without a baseline the epipolar curve is a single point, the image of infinity: use distant points
        points *= 1e4
    first_px, second_px = CAMERA.project(points)[0], second_camera.project(points)[0]
    assert np.abs(epipolar_offsets_px(CAMERA, second_camera, first_px, second_px)).max() < 1e-5


def test_offset_is_perpendicular_to_the_epipolar_line() -> None:
    """A camera that moves along the x axis of its images has horizontal epipolar lines."""
    pinhole = Cahv(CAMERA.c, CAMERA.a, CAMERA.h, CAMERA.v, CAMERA.size)
    second_camera = pinhole.transform(rigid(Rotation.identity(), np.array([5.0, 0.0, 0.0])))
    points = np.array([[0.0, 0.0, -100.0], [10.0, -6.0, -120.0], [-4.0, 7.0, -90.0]])
    first_px, second_px = pinhole.project(points)[0], second_camera.project(points)[0]
    perpendicular = epipolar_offsets_px(pinhole, second_camera, first_px, second_px + np.array([0.0, 2.0]))
    parallel = epipolar_offsets_px(pinhole, second_camera, first_px, second_px + np.array([3.0, 0.0]))
    # Tolerance: the nearest point of the line is that with the smallest angular distance, not pixel distance.
    assert np.allclose(perpendicular, [0.0, 2.0], atol=0.05)
    assert np.allclose(parallel, 0.0, atol=1e-6)
    # The epipolar line ends at the image of an infinitely distant point; beyond this end, offsets are measured from it.
    infinity_px = second_camera.project(1e9 * pinhole.rays(first_px)[1])[0]
    beyond = epipolar_offsets_px(pinhole, second_camera, first_px, infinity_px + np.array([4.0, 0.0]))
    assert np.allclose(beyond, [4.0, 0.0], atol=0.05)


def test_offsets_after_a_pure_rotation_are_measured_from_the_predicted_pixel() -> None:
    second_camera = CAMERA.transform(rigid(ROTATION, np.zeros(3)))
    first_px = np.array([[300.0, 200.0], [400.0, 260.0]])
    second_px = second_camera.project(1e3 * CAMERA.rays(first_px)[1])[0]
    offsets = epipolar_offsets_px(CAMERA, second_camera, first_px, second_px + np.array([1.5, -2.0]))
    assert np.allclose(offsets, [1.5, -2.0], atol=1e-4)


def test_summary_row_uses_inliers_only() -> None:
    offsets = np.full((40, 2), [3.0, 4.0])
    is_inlier = np.arange(40) < 20
    offsets[~is_inlier] = 500.0
    row = agreement_row([PairAgreement(PairMatches(np.zeros((2, 40, 2)), is_inlier), offsets)])
    assert (row["matches"], row["residual_median_px"], row["residual_90_percent_px"]) == (20, 5.0, 5.0)
    assert row["outlier_fraction"] == 0.5
    few_inliers = agreement_row([PairAgreement(PairMatches(np.zeros((2, 40, 2)), np.arange(40) < 10), offsets)])
    assert np.isnan(few_inliers["residual_median_px"])
    assert few_inliers["pairs_matched"] == 0
