"""Matrices of the navigation filter: vector products, small rotations and covariances."""

import numpy as np
from jaxtyping import Float

from marsyard.algorithms.arrays import Vector3


def cross_matrix(vectors: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Return the matrices of the vector product: ``cross_matrix(a) @ b`` is a x b."""
    matrices = np.zeros((*vectors.shape, 3))
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    matrices[..., 0, 1], matrices[..., 0, 2], matrices[..., 1, 2] = -z, y, -x
    matrices[..., 1, 0], matrices[..., 2, 0], matrices[..., 2, 1] = z, -y, x
    return matrices


def left_jacobian(rotation_vector: Vector3) -> Float[np.ndarray, "3 3"]:
    """Compute the left Jacobian of a small rotation, to second order: exp(d + r) = exp(J r) exp(d)."""
    matrix = cross_matrix(rotation_vector)
    return np.asarray(np.eye(3) + 0.5 * matrix + matrix @ matrix / 6.0)


def symmetrise(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Return the symmetric part of a matrix."""
    return np.asarray(0.5 * (matrix + matrix.T))
