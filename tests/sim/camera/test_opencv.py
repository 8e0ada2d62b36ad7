"""Tests of the conversion of OpenCV camera models, against OpenCV's projection."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.camera import Cahvor, CameraModel, from_opencv


def make_far_points(camera: CameraModel, pixels: np.ndarray) -> np.ndarray:
    return camera.c + 1e4 * camera.rays(pixels)[1].reshape(-1, 3)


def sample_frame(camera: CameraModel) -> np.ndarray:
    """Return the pixels at which `from_opencv` computes its residual."""
    columns, rows = (np.linspace(-0.5, extent - 0.5, 33) for extent in camera.size)
    return np.stack(np.meshgrid(columns, rows), axis=-1)


MATRIX = np.array([[900.0, 0.0, 630.0], [0.0, 905.0, 350.0], [0.0, 0.0, 1.0]])
POSE = RigidTransform.from_components([0.5, -1.0, 2.0], Rotation.from_rotvec([0.4, -0.2, 1.0]))


def compute_opencv_distances_px(camera: Cahvor, matrix: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    pixels = sample_frame(camera)
    reference, _ = cv2.projectPoints(
        make_far_points(camera, pixels).reshape(-1, 1, 3),
        POSE.rotation.as_rotvec(),
        np.asarray(POSE.translation),
        matrix,
        distortion,
    )
    return np.asarray(np.linalg.norm(np.asarray(reference).reshape(-1, 2) - pixels.reshape(-1, 2), axis=-1))


@pytest.mark.parametrize("distortion", [[], [-0.2, 0.05, 0, 0], [0.1, -0.02, 0, 0, 0]])
def test_radial_distortion_from_opencv_is_exact(distortion: list[float]) -> None:
    coefficients = np.array(distortion, dtype=float)
    camera, residual = from_opencv(MATRIX, coefficients, (1280, 720), POSE)
    assert residual.max_px < 1e-9
    padded = np.concatenate([coefficients, np.zeros(5 - len(coefficients))])
    # The test points are 1e4 m away, not at infinity. This has no effect, because both cameras have the same centre.
    assert np.max(compute_opencv_distances_px(camera, MATRIX, padded)) < 1e-8


def test_full_distortion_from_opencv_is_fitted() -> None:
    distortion = np.array([-0.25, 0.08, 0.001, -0.0008, -0.005])
    camera, residual = from_opencv(MATRIX, distortion, (1280, 720), POSE)
    reference = compute_opencv_distances_px(camera, MATRIX, distortion)
    # Both are computed at the same pixels: here with CAHVOR's rays, in the residual with OpenCV's rays.
    assert np.sqrt(np.mean(reference**2)) == pytest.approx(residual.rms_px, rel=0.05)
    assert residual.rms_px < 0.2
    assert residual.max_px < 1.0
    assert np.linalg.norm(camera.o - camera.a) > 1e-4  # the lens axis is tilted to represent p1 and p2


def test_skew_of_the_matrix_is_preserved() -> None:
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
def test_invalid_opencv_cameras_are_rejected(matrix: np.ndarray, distortion: np.ndarray, fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        from_opencv(matrix, distortion, (1280, 720))
