"""Conversion to and from OpenCV against OpenCV itself."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.camera import Cahv, Cahvor, Cahvore, CameraModel, OpenCVIntrinsics, from_opencv, to_opencv


def far_points(camera: CameraModel, pixels: np.ndarray) -> np.ndarray:
    return camera.c + 1e4 * camera.rays(pixels)[1].reshape(-1, 3)


def opencv_pixels(intrinsics: OpenCVIntrinsics, points: np.ndarray) -> np.ndarray:
    pose = intrinsics.camera_from_world
    project = cv2.projectPoints if intrinsics.model == "pinhole" else cv2.fisheye.projectPoints
    pixels, _ = project(
        points.reshape(-1, 1, 3),
        rvec=pose.rotation.as_rotvec(),
        tvec=np.asarray(pose.translation),
        **({"cameraMatrix": intrinsics.matrix, "distCoeffs": intrinsics.distortion})
        if intrinsics.model == "pinhole"
        else {"K": intrinsics.matrix, "D": intrinsics.distortion},
    )
    return np.asarray(pixels).reshape(-1, 2)


def distances(camera: CameraModel, intrinsics: OpenCVIntrinsics, pixels: np.ndarray) -> np.ndarray:
    difference = opencv_pixels(intrinsics, far_points(camera, pixels)) - pixels.reshape(-1, 2)
    return np.linalg.norm(difference, axis=-1)


def frame(camera: CameraModel) -> np.ndarray:
    """The samples over which the residual is stated."""
    columns, rows = (np.linspace(-0.5, extent - 0.5, 33) for extent in camera.size)
    return np.stack(np.meshgrid(columns, rows), axis=-1)


SQUARE = Cahv.from_focal_length(
    14.67e-3,
    (12e-6, 13e-6),
    (1024, 768),
    axis=(1, 0.2, -0.3),
    right=(0, -1, 0),
    centre=(3, 4, 5),
    image_centre=(500, 400),
)


def test_linear_camera_is_exact() -> None:
    intrinsics = to_opencv(SQUARE)
    assert intrinsics.model == "pinhole"
    assert intrinsics.residual.max_px < 1e-9
    assert np.array_equal(intrinsics.distortion, np.zeros(5))
    assert np.allclose(intrinsics.matrix, [[1222.5, 0, 500], [0, 14670 / 13, 400], [0, 0, 1]], rtol=0, atol=1e-9)
    assert np.max(distances(SQUARE, intrinsics, frame(SQUARE))) < 1e-8


def test_distortion_about_the_axis_is_exact() -> None:
    camera = Cahvor.from_cahv(SQUARE, r=(0.01, -0.2, 0.08))
    intrinsics = to_opencv(camera)
    assert intrinsics.residual.max_px < 1e-9
    assert np.max(distances(camera, intrinsics, frame(camera))) < 1e-8
    assert intrinsics.distortion == pytest.approx([-0.2 / 1.01, 0.08 / 1.01, 0, 0, 0])


def test_real_navcam_is_fitted_and_the_residual_is_opencvs(navcam: Cahvor) -> None:
    intrinsics = to_opencv(navcam)
    there = distances(navcam, intrinsics, frame(navcam))
    assert intrinsics.residual.rms_px == pytest.approx(np.sqrt(np.mean(there**2)), abs=1e-6)
    assert intrinsics.residual.max_px == pytest.approx(np.max(there), abs=1e-6)
    # Its O is 1.8 degrees from A and its axes 0.024 degrees from square, neither of which OpenCV has; measured 0.090
    # and 0.253 px.
    assert intrinsics.residual.rms_px < 0.1
    assert intrinsics.residual.max_px < 0.3


def test_the_fit_is_least(navcam: Cahvor) -> None:
    intrinsics = to_opencv(navcam)
    rng = np.random.default_rng(1)
    for _ in range(20):
        other = dataclasses.replace(
            intrinsics,
            distortion=intrinsics.distortion + rng.normal(size=5) * 1e-4,
            matrix=intrinsics.matrix + rng.normal(size=(3, 3)) * [[0.1, 0, 0.1], [0, 0.1, 0.1], [0, 0, 0]],
        )
        there = distances(navcam, other, frame(navcam))
        assert np.sqrt(np.mean(there**2)) > intrinsics.residual.rms_px


def test_hazcam_becomes_a_fisheye(hazcam: Cahvore) -> None:
    intrinsics = to_opencv(hazcam)
    assert intrinsics.model == "fisheye"
    assert intrinsics.distortion.shape == (4,)
    # Measured 0.39 and 1.77 px over the whole frame, whose corners look 92 degrees off.
    assert intrinsics.residual.rms_px < 0.5
    assert intrinsics.residual.max_px < 2
    inner = frame(hazcam)[4:-4, 4:-4]
    there = distances(hazcam, intrinsics, inner)
    assert np.max(there) < intrinsics.residual.max_px


def test_size_and_pose_are_kept(navcam: Cahvor) -> None:
    intrinsics = to_opencv(navcam)
    assert intrinsics.size == navcam.size
    # C is OpenCV's origin; the last row of the rotation is its viewing direction.
    assert np.allclose(intrinsics.camera_from_world.apply(np.array(navcam.c)), 0, atol=1e-12)
    assert intrinsics.camera_from_world.rotation.as_matrix()[2] @ navcam.a > 0.999


def test_mirrored_and_blind_cameras_are_refused(navcam: Cahvor) -> None:
    with pytest.raises(ValueError, match="mirrored"):
        to_opencv(dataclasses.replace(navcam, h=1023 * navcam.a - navcam.h))
    with pytest.raises(ValueError, match="sees nothing"):
        to_opencv(Cahvor.from_cahv(SQUARE.scaled(1), r=(0, -2.0, 0)))


# ----- from OpenCV -----

MATRIX = np.array([[900.0, 0.0, 630.0], [0.0, 905.0, 350.0], [0.0, 0.0, 1.0]])
POSE = RigidTransform.from_components([0.5, -1.0, 2.0], Rotation.from_rotvec([0.4, -0.2, 1.0]))


def from_opencv_distances(camera: Cahvor, matrix: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    pixels = frame(camera)
    there, _ = cv2.projectPoints(
        far_points(camera, pixels).reshape(-1, 1, 3),
        POSE.rotation.as_rotvec(),
        np.asarray(POSE.translation),
        matrix,
        distortion,
    )
    return np.linalg.norm(np.asarray(there).reshape(-1, 2) - pixels.reshape(-1, 2), axis=-1)


@pytest.mark.parametrize("distortion", [[], [-0.2, 0.05, 0, 0], [0.1, -0.02, 0, 0, 0]])
def test_radial_distortion_from_opencv_is_exact(distortion: list[float]) -> None:
    coefficients = np.array(distortion, dtype=float)
    camera, residual = from_opencv(MATRIX, coefficients, (1280, 720), POSE)
    assert residual.max_px < 1e-9
    padded = np.concatenate([coefficients, np.zeros(5 - len(coefficients))])
    # Points 1e4 m off are not quite at infinity, nor have they to be: both cameras have one centre.
    assert np.max(from_opencv_distances(camera, MATRIX, padded)) < 1e-8


def test_full_distortion_from_opencv_is_fitted() -> None:
    distortion = np.array([-0.25, 0.08, 0.001, -0.0008, -0.005])
    camera, residual = from_opencv(MATRIX, distortion, (1280, 720), POSE)
    there = from_opencv_distances(camera, MATRIX, distortion)
    # Both are taken at the same samples of the frame, one along CAHVOR's rays and one along OpenCV's.
    assert np.sqrt(np.mean(there**2)) == pytest.approx(residual.rms_px, rel=0.05)
    assert residual.rms_px < 0.2
    assert residual.max_px < 1.0
    assert np.linalg.norm(camera.o - camera.a) > 1e-4  # the lens is tilted to make up for p1 and p2


def test_there_and_back() -> None:
    camera = Cahvor.from_cahv(SQUARE, r=(0.0, -0.2, 0.08))
    intrinsics = to_opencv(camera)
    again, residual = from_opencv(intrinsics.matrix, intrinsics.distortion, camera.size, intrinsics.camera_from_world)
    assert residual.max_px < 1e-9
    for name in "cahvor":
        assert np.allclose(getattr(again, name), getattr(camera, name), rtol=0, atol=1e-9)


def test_skew_of_the_matrix_is_kept() -> None:
    skewed = MATRIX + np.array([[0, 2.0, 0], [0, 0, 0], [0, 0, 0]])
    camera, _ = from_opencv(skewed, np.zeros(0), (1280, 720))
    point = np.array([0.2, -0.1, 1.0])
    assert np.allclose(camera.project(point)[0], (skewed @ point)[:2], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("matrix", "distortion", "fault"),
    [
        (MATRIX, np.zeros(12), "distortion must be none"),
        (MATRIX, np.array([np.nan, 0, 0, 0]), "finite"),
        (-MATRIX, np.zeros(5), "matrix must be"),
        (MATRIX + np.eye(3), np.zeros(5), "matrix must be"),
        (MATRIX, np.array([-2.0, 0.0, 0.0, 0.0]), "folds over"),
    ],
)
def test_impossible_opencv_cameras_are_refused(matrix: np.ndarray, distortion: np.ndarray, fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        from_opencv(matrix, distortion, (1280, 720))
