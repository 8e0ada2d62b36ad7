"""Visual odometry: motion of the rover between two stereo pairs (as on MER: Cheng, Maimone & Matthies 2005).

Features of the first pair are matched between its images and triangulated. They are tracked to the second pair, and
triangulated there again; tracking starts at the pixels that wheel odometry and gyros predict. A robust pose estimate
rejects outliers. The motion minimises the distances between both sets of points, weighted by their covariances. The
estimate is rejected if it has too few features, is inaccurate, or contradicts the prediction: wheel odometry then
remains in use. Features, windows and limits of the flight software are not published in detail; they are assumed.
"""

from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np
from jaxtyping import Float64
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.arrays import Flags, Points2, Points3
from marsyard.algorithms.navigation.stereo import RectifiedPair, track_features
from marsyard.sim.frames import rigid_from_axes, rotation_matrix
from marsyard.sim.measurements import StereoMeasurement

#: Maximum number of features, their minimum distance in pixels, and the minimum corner strength of a feature divided by
#: that of the strongest.
_FEATURES, _SPACING_PX, _QUALITY = 300, 6.0, 0.003
#: Minimum depth of matched points, metres; error of a matched coordinate (1 sigma), and maximum reprojection error of
#: an inlier, pixels.
_MIN_RANGE_M, _MATCH_ERROR_PX, _INLIER_PX = 1.0, 0.25, 1.5
#: Minimum numbers of tracked features and of inliers.
_MIN_FEATURES, _MIN_INLIERS = 20, 12
#: Maximum standard deviation of the position along any axis, metres; maximum distance from the predicted position
#: divided by the predicted path (wheels that slip completely differ by 1); maximum angle from the gyros' rotation.
_MAX_SIGMA_M, _MAX_EXCESS, _MAX_TURN_ERROR_RAD = 0.03, 1.3, float(np.radians(2.0))
#: Iterations and confidence of the robust pose estimate.
_RANSAC_ITERATIONS, _RANSAC_CONFIDENCE = 300, 0.999
#: Number of adjustments, each followed by a rejection of outliers, and largest normalised distance of an inlier.
_ADJUSTMENTS, _MAX_NORMALISED_DISTANCE = 3, 3.5
#: Additional distance from the predicted position that is accepted, metres.
_MAX_EXCESS_M = 0.05


class VisualOdometryOutcome(Enum):
    """Outcome of visual odometry. All members except CONVERGED are expected failures."""

    CONVERGED = "the motion was estimated"
    TOO_FEW_FEATURES = "too few features were tracked"
    TOO_FEW_INLIERS = "too few features agree with one motion"
    INACCURATE = "the estimated motion is too uncertain"
    INCONSISTENT = "the motion contradicts wheel odometry and gyros"


@dataclass(frozen=True)
class MotionEstimate:
    """Result of `estimate_motion`.

    - first_from_second: pose of the second rover frame in the first; None unless the outcome is CONVERGED
    - sigma_m: largest standard deviation of the position; NaN without an estimate
    """

    outcome: VisualOdometryOutcome
    first_from_second: RigidTransform | None
    features: int
    inliers: int
    sigma_m: float


def estimate_motion(first: StereoMeasurement, second: StereoMeasurement, predicted: RigidTransform) -> MotionEstimate:
    """Estimate the rover's motion between two stereo pairs.

    `predicted` is the pose of the second rover frame in the first, from wheel odometry and gyros.
    """
    first_pair, second_pair = RectifiedPair.from_measurement(first), RectifiedPair.from_measurement(second)
    pixels = _detect_features(first_pair)
    disparities, valid = first_pair.feature_disparities(pixels, _MIN_RANGE_M)
    pixels, disparities = pixels[valid], disparities[valid]
    points = first_pair.triangulate(pixels, disparities)
    expected_pixels, visible = second_pair.camera.project(
        np.asarray(predicted.inv().apply(points.copy())).reshape(-1, 3)
    )
    inside = visible & second_pair.camera.in_frame(expected_pixels)
    pixels, disparities, points = (values[inside] for values in (pixels, disparities, points))
    second_pixels, valid = track_features(first_pair.left, second_pair.left, pixels, expected_pixels[inside])
    second_disparities, is_matched = second_pair.feature_disparities(second_pixels, _MIN_RANGE_M)
    valid &= is_matched
    count = int(np.count_nonzero(valid))
    if count < _MIN_FEATURES:
        return MotionEstimate(VisualOdometryOutcome.TOO_FEW_FEATURES, None, count, 0, float("nan"))
    pixels, disparities, points = pixels[valid], disparities[valid], points[valid]
    second_pixels, second_disparities = second_pixels[valid], second_disparities[valid]
    second_points = second_pair.triangulate(second_pixels, second_disparities)
    inliers = _find_inliers(second_pair, points, second_pixels, predicted)
    covariances = (
        first_pair.covariances(pixels, disparities, _MATCH_ERROR_PX),
        second_pair.covariances(second_pixels, second_disparities, _MATCH_ERROR_PX),
    )
    motion, sigma_m = predicted, float("nan")
    for _ in range(_ADJUSTMENTS):
        if np.count_nonzero(inliers) < _MIN_INLIERS:
            break
        whitening = _compute_whitening(covariances, motion)
        motion, sigma_m = _refine_motion(points, second_points, whitening, inliers, motion)
        residuals = _residuals(points, second_points, whitening, rotation_matrix(motion), motion.translation)
        distances = np.linalg.norm(residuals, axis=1)
        inliers = distances <= _MAX_NORMALISED_DISTANCE
    inlier_count = int(np.count_nonzero(inliers))
    if inlier_count < _MIN_INLIERS:
        return MotionEstimate(VisualOdometryOutcome.TOO_FEW_INLIERS, None, count, inlier_count, float("nan"))
    outcome = _check_motion(motion, sigma_m, predicted)
    is_valid = outcome is VisualOdometryOutcome.CONVERGED
    return MotionEstimate(outcome, motion if is_valid else None, count, inlier_count, sigma_m)


def _detect_features(pair: RectifiedPair) -> Points2:
    """Detect corners (u, v) in the left image, at least four pixels from its border and from pixels without data."""
    mask = cv2.erode((pair.left > 0).astype(np.uint8), np.ones((9, 9), np.uint8), borderValue=0)
    corners = cv2.goodFeaturesToTrack(pair.left, _FEATURES, _QUALITY, _SPACING_PX, mask=mask)
    return np.empty((0, 2)) if corners is None else corners.reshape(-1, 2).astype(np.float64)


def _find_inliers(pair: RectifiedPair, points: Points3, pixels: Points2, predicted: RigidTransform) -> Flags:
    """Find the points whose pixels in the second image agree with one motion (RANSAC over poses from three points)."""
    axes = np.stack([pair.camera.right, pair.camera.down, pair.camera.a])
    focal, (column, row) = pair.camera.focal_lengths[0], pair.camera.image_centre
    matrix = np.array([[focal, 0.0, column], [0.0, focal, row], [0.0, 0.0, 1.0]])
    # pose of the first rover frame in the second camera's axes
    rotation = Rotation.from_matrix(axes) * predicted.inv().rotation
    translation = axes @ (predicted.inv().translation - pair.camera.c)
    is_solved, _, _, inliers = cv2.solvePnPRansac(
        points, pixels, matrix, None, rotation.as_rotvec().reshape(3, 1), translation.reshape(3, 1), True,
        _RANSAC_ITERATIONS, _INLIER_PX, _RANSAC_CONFIDENCE, flags=cv2.SOLVEPNP_ITERATIVE,
    )  # fmt: skip
    flags = np.zeros(len(points), dtype=np.bool_)
    if is_solved and inliers is not None:
        flags[inliers.ravel()] = True
    return flags


def _compute_whitening(
    covariances: tuple[Float64[np.ndarray, "n 3 3"], Float64[np.ndarray, "n 3 3"]], motion: RigidTransform
) -> Float64[np.ndarray, "n 3 3"]:
    """Compute the matrices that normalise the differences of both sets of points."""
    rotation = rotation_matrix(motion)
    total = covariances[0] + rotation @ covariances[1] @ rotation.T
    return np.asarray(np.linalg.inv(np.linalg.cholesky(total)))


def _residuals(
    points: Points3,
    second_points: Points3,
    whitening: Float64[np.ndarray, "n 3 3"],
    rotation: Float64[np.ndarray, "3 3"],
    translation: Float64[np.ndarray, "3"],
) -> Points3:
    """Compute the normalised differences between the first pair's points and the second pair's transformed points."""
    difference = points - (second_points @ rotation.T + translation)
    return np.asarray((whitening @ difference[..., None])[..., 0])


def _refine_motion(
    points: Points3,
    second_points: Points3,
    whitening: Float64[np.ndarray, "n 3 3"],
    inliers: Flags,
    start: RigidTransform,
) -> tuple[RigidTransform, float]:
    """Minimise the normalised distances of the inliers; return the motion and the position's standard deviation."""
    first, second, weights = points[inliers], second_points[inliers], whitening[inliers]
    start_rotation, start_translation = rotation_matrix(start), start.translation
    # a small rotation w moves a point q by w x q
    crosses = np.cross(np.eye(3)[None], second[:, None]).transpose(0, 2, 1)

    # a correction is a rotation vector and a translation
    def correct_motion(
        correction: Float64[np.ndarray, "6"],
    ) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]:
        turn = Rotation.from_rotvec(correction[:3]).as_matrix()
        return start_rotation @ turn, start_translation + correction[3:]

    def compute_residuals(correction: Float64[np.ndarray, "6"]) -> Float64[np.ndarray, "n"]:
        return _residuals(first, second, weights, *correct_motion(correction)).ravel()

    def compute_jacobian(correction: Float64[np.ndarray, "6"]) -> Float64[np.ndarray, "n 6"]:
        rotation_jacobian = correct_motion(correction)[0] @ crosses
        columns = np.concatenate([rotation_jacobian, np.broadcast_to(np.eye(3), rotation_jacobian.shape)], axis=2)
        return np.asarray(-(weights @ columns).reshape(-1, 6))

    solution = least_squares(compute_residuals, np.zeros(6), jac=compute_jacobian, loss="huber")
    jacobian = np.asarray(solution.jac)
    covariance = np.linalg.pinv(jacobian.T @ jacobian)
    # residuals larger than the assumed match error increase the uncertainty
    variance = max(float(np.mean(compute_residuals(solution.x) ** 2)), 1.0)
    sigma = np.sqrt(variance * np.linalg.eigvalsh(covariance[3:, 3:])[-1])
    return rigid_from_axes(*correct_motion(solution.x)), float(sigma)


def _check_motion(motion: RigidTransform, sigma_m: float, predicted: RigidTransform) -> VisualOdometryOutcome:
    """Return the outcome of an estimated motion: accuracy, and agreement with the prediction."""
    if not sigma_m <= _MAX_SIGMA_M:
        return VisualOdometryOutcome.INACCURATE
    path_m = float(np.linalg.norm(predicted.translation))
    excess_m = float(np.linalg.norm(motion.translation - predicted.translation))
    turn_error_rad = (predicted.rotation.inv() * motion.rotation).magnitude()
    if excess_m > _MAX_EXCESS * path_m + _MAX_EXCESS_M or turn_error_rad > _MAX_TURN_ERROR_RAD:
        return VisualOdometryOutcome.INCONSISTENT
    return VisualOdometryOutcome.CONVERGED
