"""Robust fit of a common correction of position and attitude to landmarks' displacements in an image.

True position = estimated position + translation, true attitude = exp(rotation) estimated attitude (rotation vector in
world axes). A point of the world at the offset d from the body frame's origin appears where the estimated pose would
show the point displaced by d x rotation - translation.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from marsyard.algorithms.arrays import Flags, Points2, Points3, Vector3
from marsyard.algorithms.localisation.matrices import cross_matrix
from marsyard.sim.camera import CameraModel

#: Factor of the control parameter between iterations (Yang et al. 2020, remark 5), and maximum number of iterations.
_GROWTH = 1.4
_MAX_ITERATIONS = 60


@dataclass(frozen=True)
class PoseFit:
    """Common correction of a pose, and the consistent landmarks.

    - translation_m, rotation_rad: correction of position and attitude (rotation vector), world axes
    - residuals_px: displacements minus those of the correction
    - consistent: landmarks with a residual within the limit
    """

    translation_m: Vector3
    rotation_rad: Vector3
    residuals_px: Points2
    consistent: Flags


def pose_jacobian(camera: CameraModel, position_m: Vector3, points_m: Points3) -> Float[np.ndarray, "n 2 6"]:
    """Derivatives of the points' pixels with respect to position (px/m) and attitude (px/rad) of the body frame.

    - camera: camera model in the world frame
    - position_m: origin of the body frame
    """
    by_point = camera.projection_jacobian(points_m)
    offsets = points_m - position_m
    # d x rotation = [d]x rotation
    return np.concatenate([-by_point, by_point @ cross_matrix(offsets)], axis=2)


def fit_pose(
    jacobian: Float[np.ndarray, "n 2 6"],
    displacements_px: Points2,
    prior_sd: Float[np.ndarray, "6"],
    noise_px: float,
    max_residual_px: float,
) -> PoseFit:
    """Fit a pose correction with truncated least squares by graduated non-convexity; deterministic.

    Minimises ``sum min(|r_i|^2, max_residual^2) / noise^2 + |x / prior_sd|^2`` over the correction x. Source: Yang et
    al., "Graduated Non-Convexity for Robust Spatial Perception", RA-L 2020, Eq. 14.

    - prior_sd: standard deviations of the corrections of position (m) and attitude (rad)
    - noise_px: standard deviation of a displacement per axis
    """
    # unknowns in units of their standard deviations, residuals in units of the noise
    design = jacobian * (prior_sd / noise_px)
    values = displacements_px / noise_px
    limit2 = (max_residual_px / noise_px) ** 2
    weights = np.ones(len(values))
    mu = 0.0  # set after the first iteration, which has equal weights
    solution = np.zeros(6)
    for _ in range(_MAX_ITERATIONS):
        weighted = weights[:, np.newaxis, np.newaxis] * design
        normal = np.eye(6) + np.einsum("nij,nik->jk", weighted, design, optimize=True)
        solution = np.linalg.solve(normal, np.einsum("nij,ni->j", weighted, values))
        squares = np.sum((values - design @ solution) ** 2, axis=1)
        if mu == 0.0:
            largest = float(squares.max(initial=0.0))
            if largest <= limit2:
                break
            mu = limit2 / max(2.0 * largest - limit2, limit2)
        new_weights = _truncated_weights(squares, limit2, mu)
        if mu > 1.0 and np.allclose(new_weights, weights, atol=1e-3):
            break
        weights, mu = new_weights, _GROWTH * mu
    residuals = displacements_px - jacobian @ (prior_sd * solution)
    correction = prior_sd * solution
    consistent = np.hypot(residuals[:, 0], residuals[:, 1]) <= max_residual_px
    return PoseFit(correction[:3], correction[3:], residuals, consistent)


def _truncated_weights(squares: Float[np.ndarray, "n"], limit2: float, mu: float) -> Float[np.ndarray, "n"]:
    """Weights of truncated least squares for the control parameter mu (Yang et al., Eq. 14)."""
    roots = np.sqrt(limit2 * mu * (mu + 1.0) / np.maximum(squares, np.finfo(np.float64).tiny)) - mu
    weights = np.where(squares <= mu / (mu + 1.0) * limit2, 1.0, roots)
    return np.asarray(np.where(squares >= (mu + 1.0) / mu * limit2, 0.0, weights))
