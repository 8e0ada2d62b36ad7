"""Tests of the conversion of OpenCV camera models, against OpenCV's projection."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.camera import from_opencv
from tests.sim.camera.labels import compute_max_opencv_distance_px

MATRIX = np.array([[900.0, 0.0, 630.0], [0.0, 905.0, 350.0], [0.0, 0.0, 1.0]])
POSE = RigidTransform.from_components([0.5, -1.0, 2.0], Rotation.from_rotvec([0.4, -0.2, 1.0]))


@pytest.mark.parametrize("distortion", [[], [-0.2, 0.05, 0, 0], [0.1, -0.02, 0, 0, 0]])
def test_radial_distortion_from_opencv_is_exact(distortion: list[float]) -> None:
    coefficients = np.array(distortion, dtype=float)
    camera, residual = from_opencv(MATRIX, coefficients, (1280, 720), POSE)
    assert residual.max_px < 1e-9
    assert compute_max_opencv_distance_px(camera, MATRIX, coefficients, POSE) < 1e-7


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
