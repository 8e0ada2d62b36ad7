"""Measurement updates of the navigation state: position, altitude above ground, and landmarks in an image.

All updates have one form. With the covariance P = L L', the Jacobian H, the noise covariance R and the residual r, the
whitened error y = L^-1 (error) has the posterior covariance and mean

    W^-1 = (I + (H L)' R^-1 (H L))^-1        y = W^-1 (H L)' R^-1 r        P+ = L W^-1 L'

This is the information form without the inverse of P; P+ is symmetric and positive definite by construction. The size
of W does not depend on the number of landmarks.

Landmarks of one image have an unknown common error of the map, which is not estimated but considered (Schmidt 1966):
three more errors of zero mean in the update, which are marginalised afterwards.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from jaxtyping import Bool, Float
from scipy import linalg
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from marsyard.algorithms.localisation.inertial_state import ATTITUDE, ERRORS, POSITION, ErrorMatrix, NavigationState
from marsyard.algorithms.localisation.matrices import cross_matrix, left_jacobian, symmetrise
from marsyard.sim.camera import CameraModel

#: Height (m) and slope (east, north) of the map's ground: at the estimated position, or as a function of (x, y).
GroundHeight = tuple[float, Float[np.ndarray, "2"]]
GroundModel = Callable[[Float[np.ndarray, "2"]], GroundHeight] | GroundHeight
#: Columns of the landmarks' Jacobian: position, attitude, common error of the points.
_POSITION, _ATTITUDE, _COMMON = slice(0, 3), slice(3, 6), slice(6, 9)
#: Unknowns of an update by landmarks: the errors of the state, and the common error (east, north, up).
_UNKNOWNS = ERRORS + 3
#: Independent components of the state that one image measures: position and attitude.
_OBSERVED = 6
#: Limits of the updates, all assumed. Probabilities to reject a correct position, altitude or landmark by its
#: innovation before the update; a correct landmark by its residual; a correct image by its correction of the state.
FALSE_REJECTION, OUTLIER_PROBABILITY, FALSE_INCONSISTENCY = 1e-4, 1e-3, 1e-5
#: Minimum number of landmarks that agree (six coordinates determine position and attitude), and minimum fraction of
#: visible landmarks that agree: chance agreement of outliers stays below it.
MIN_LANDMARKS, MIN_FRACTION = 8, 0.4
#: Maximum number of passes of the robust estimation, and of the outlier rejection.
MAX_PASSES = 50
#: Variances of position (100 km) and attitude (10 rad) that remove the prior knowledge of both if they are added.
_FREE_VARIANCES = np.zeros(ERRORS)
_FREE_VARIANCES[POSITION], _FREE_VARIANCES[ATTITUDE] = 1e5**2, 10.0**2


class UpdateOutcome(Enum):
    """Outcome of a measurement update. All members except APPLIED leave the state unchanged."""

    APPLIED = "the state is updated"
    REJECTED = "the innovation is above the gate"
    TOO_FEW = "too few landmarks agree"
    INCONSISTENT = "the landmarks contradict the navigation state"
    INVALID = "the measurement is not finite"
    OUTSIDE_HISTORY = "the time is before the stored history or after the last increments"


@dataclass(frozen=True)
class LandmarkResult:
    """Result of an update by landmarks.

    - inliers: landmarks that agree with each other and with the state; all False if the points are invalid
    - residuals_px: measured minus expected pixels with the estimated state and common error; NaN if not visible
    """

    outcome: UpdateOutcome
    inliers: Bool[np.ndarray, "n"]
    residuals_px: Float[np.ndarray, "n 2"]


@dataclass(frozen=True)
class LandmarkMeasurement:
    """Landmarks of an image.

    - camera: camera model in the body frame
    - points_world, pixels: positions from the map, metres, and measured pixels
    - pixel_sd: standard deviation of the measured pixels per axis
    - point_sd_m: independent error of the points (east, north, up)
    - common_sd_m: error of the points that is equal for all landmarks of the image (east, north, up). It is considered
      as independent between images.
    - is_rigid: whether the matching has found that one correction of position and attitude explains all pixels; then
      this correction is tested before landmarks are rejected one by one
    - alignment_sd_rad: error of the camera's alignment and calibration per axis, for the test of the rigid motion
    """

    camera: CameraModel
    points_world: Float[np.ndarray, "n 3"]
    pixels: Float[np.ndarray, "n 2"]
    pixel_sd: float
    point_sd_m: Float[np.ndarray, "3"]
    common_sd_m: Float[np.ndarray, "3"]
    is_rigid: bool = False
    alignment_sd_rad: float = 0.0


@dataclass(frozen=True)
class Linearisation:
    """Landmarks linearised at a pose.

    - visible: whether the point has a projection and the measured pixel is finite; residual and Jacobian are 0 if not
    - residuals: measured minus expected pixels
    - jacobian: derivatives of the expected pixels with respect to position, attitude error and common error
    - noise: covariance of pixel noise and independent point error
    """

    visible: Bool[np.ndarray, "n"]
    residuals: Float[np.ndarray, "n 2"]
    jacobian: Float[np.ndarray, "n 2 9"]
    noise: Float[np.ndarray, "n 2 2"]


def update_position(
    state: NavigationState, horizontal_position_m: Float[np.ndarray, "2"], covariance: Float[np.ndarray, "2 2"]
) -> tuple[NavigationState, UpdateOutcome]:
    """Update by a horizontal position (east, north) on the map."""
    residual = horizontal_position_m - state.position_m[:2]
    return _update_gated(state, np.eye(2, ERRORS), residual, covariance)


def update_altitude(
    state: NavigationState, altitude_m: float, ground: GroundModel, sd_m: float
) -> tuple[NavigationState, UpdateOutcome]:
    """Update by the altitude above the map's ground below the body frame's origin.

    `sd_m` contains the error of the map's elevation and of the slope's linear extrapolation to the true position.
    """
    height, slope = ground(state.position_m[:2]) if callable(ground) else ground
    jacobian = altitude_jacobian(slope)
    residual = np.array([altitude_m - (state.position_m[2] - height)])
    return _update_gated(state, jacobian, residual, np.array([[sd_m**2]]))


def altitude_jacobian(slope: Float[np.ndarray, "2"]) -> Float[np.ndarray, "1 15"]:
    """Compute the Jacobian of the altitude above ground with respect to the errors."""
    jacobian = np.zeros((1, ERRORS))
    jacobian[0, POSITION] = [-slope[0], -slope[1], 1.0]
    return jacobian


def linearise_landmarks(
    measurement: LandmarkMeasurement, position_m: Float[np.ndarray, "3"], world_from_body: Rotation
) -> Linearisation:
    """Linearise the projection of landmarks at a pose.

    A point P has the body coordinates q = R' exp(-e) (P - p), with the derivatives R' (points), -R' (position) and
    R' [P - p]x (attitude error e).
    """
    lines = measurement.points_world - position_m
    rotation = world_from_body.as_matrix()
    points_body = lines @ rotation
    expected, visible = measurement.camera.project(points_body)
    residuals = measurement.pixels - expected
    by_point = measurement.camera.projection_jacobian(points_body) @ rotation.T
    jacobian = np.concatenate([-by_point, by_point @ cross_matrix(lines), by_point], axis=-1)
    scaled = by_point * measurement.point_sd_m
    noise = scaled @ scaled.transpose(0, 2, 1) + measurement.pixel_sd * measurement.pixel_sd * np.eye(2)
    visible = visible & np.isfinite(residuals).all(axis=1) & np.isfinite(jacobian).all(axis=(1, 2))
    residuals[~visible], jacobian[~visible], noise[~visible] = 0.0, 0.0, np.eye(2)
    return Linearisation(visible, residuals, jacobian, noise)


def update_landmarks(
    state: NavigationState, measurement: LandmarkMeasurement
) -> tuple[NavigationState, LandmarkResult]:
    """Update by the landmarks of an image, with rejection of outliers.

    If one correction explains all landmarks (`is_rigid`), it is tested first against the covariance
    (`_test_rigid_motion`). Without this test, the steps below could reject the landmarks that contradict a wrong
    attitude most, and apply an update by the remaining ones.

    1. Landmarks whose innovation is improbable before the update are rejected.
    2. Robust estimation by graduated non-convexity with truncated least squares (Yang et al. 2020, "Graduated
       Non-Convexity for Robust Spatial Perception"): the limit on residuals decreases from the largest to its final
       value, so that the solution moves gradually from the fit of all landmarks to that of the inliers.
    3. Ordinary estimation by the inliers, which are selected again from all landmarks by their residuals until they do
       not change. Correct landmarks that step 1 rejected because of a large common error are thereby used again.

    Each estimation is iterated (Gauss-Newton), hence the update is that of an iterated Kalman filter.
    """
    problem = _LandmarkProblem(state, measurement)
    start = linearise_landmarks(measurement, state.position_m, state.world_from_body)
    max_shift = float(chdtri(_OBSERVED, FALSE_INCONSISTENCY))
    if measurement.is_rigid:
        motion, residuals = _test_rigid_motion(state, measurement, start.visible)
        if not motion < max_shift:
            return state, LandmarkResult(UpdateOutcome.INCONSISTENT, np.zeros_like(start.visible), residuals)
    factors = start.jacobian @ problem.factor
    innovation_squares = _normalise(start.residuals, start.noise + factors @ factors.transpose(0, 2, 1))
    candidates = start.visible & (innovation_squares < chdtri(2, FALSE_REJECTION))
    limit = float(chdtri(2, OUTLIER_PROBABILITY))
    whitened = np.zeros(_UNKNOWNS)
    if candidates.any():
        inliers, whitened = _estimate_robustly(problem, candidates, limit)
    else:
        inliers = candidates
    for _ in range(MAX_PASSES):
        solution = problem.solve(inliers.astype(np.float64), whitened)
        whitened, previous = solution.whitened, inliers
        inliers = solution.linearisation.visible & (solution.squares < limit)
        if np.array_equal(inliers, previous):
            break
    residuals = np.where(solution.linearisation.visible[:, None], solution.residuals, np.nan)
    # squared length of the whitened correction: about chi-square with 6 degrees of freedom if consistent
    shift = float(whitened @ whitened)
    min_count = max(MIN_LANDMARKS, MIN_FRACTION * int(start.visible.sum()))
    if int(inliers.sum()) < min_count:
        return state, LandmarkResult(UpdateOutcome.TOO_FEW, inliers, residuals)
    if not shift < max_shift:
        return state, LandmarkResult(UpdateOutcome.INCONSISTENT, inliers, residuals)
    updated = state.correct(problem.errors(whitened), problem.covariance(solution.information))
    return updated, LandmarkResult(UpdateOutcome.APPLIED, inliers, residuals)


def _test_rigid_motion(
    state: NavigationState, measurement: LandmarkMeasurement, visible: Bool[np.ndarray, "n"]
) -> tuple[float, Float[np.ndarray, "n 2"]]:
    """Compute the normalised square of the motion that all landmarks show, and the residuals of the expected motion.

    The motion x of the body frame is estimated without prior knowledge of position and attitude; C is its covariance.
    The minima of the least-squares problem with and without the prior covariance P differ by x' (P + C)^-1 x. If the
    state is consistent, this difference is chi-square with 6 degrees of freedom, however well the landmarks fit. P
    contains the error of the camera's alignment, which one image does not distinguish from an attitude error.
    """
    costs, weights = [], visible.astype(np.float64)
    alignment = np.zeros(ERRORS)
    alignment[ATTITUDE] = measurement.alignment_sd_rad**2
    for variances in (_FREE_VARIANCES, alignment):
        covariance = state.covariance + np.diag(variances)
        problem = _LandmarkProblem(replace(state, covariance=covariance), measurement)
        solution = problem.solve(weights, np.zeros(_UNKNOWNS))
        costs.append(float(solution.whitened @ solution.whitened + solution.squares @ weights))
    residuals = np.where(solution.linearisation.visible[:, None], solution.residuals, np.nan)
    return costs[1] - costs[0], residuals


@dataclass(frozen=True)
class _Solution:
    """Estimate by weighted landmarks: whitened errors, W, linearisation, and normalised squares of the residuals."""

    whitened: Float[np.ndarray, "18"]
    information: Float[np.ndarray, "18 18"]
    linearisation: Linearisation
    residuals: Float[np.ndarray, "n 2"]
    squares: Float[np.ndarray, "n"]


class _LandmarkProblem:
    """Least-squares problem of one image: the state's errors and the common error from residuals of landmarks."""

    def __init__(self, state: NavigationState, measurement: LandmarkMeasurement) -> None:
        self._state, self._measurement = state, measurement
        self._root = np.zeros((_UNKNOWNS, _UNKNOWNS))
        self._root[:ERRORS, :ERRORS] = square_root(state.covariance)
        self._root[ERRORS:, ERRORS:] = np.diag(measurement.common_sd_m)
        #: rows of the square root that the landmarks observe
        self.factor = self._root[np.r_[POSITION, ATTITUDE, ERRORS:_UNKNOWNS]]

    def errors(self, whitened: Float[np.ndarray, "18"]) -> Float[np.ndarray, "15"]:
        """Compute the errors of the state."""
        return np.asarray(self._root[:ERRORS] @ whitened)

    def covariance(self, information: Float[np.ndarray, "18 18"]) -> ErrorMatrix:
        """Compute the covariance of the state's errors after the update."""
        half = linalg.solve_triangular(np.linalg.cholesky(information), self._root[:ERRORS].T, lower=True)
        return np.asarray(half.T @ half)

    def linearise(self, whitened: Float[np.ndarray, "18"]) -> tuple[Linearisation, Float[np.ndarray, "n 2"]]:
        """Linearise at estimated errors; return also the residuals after subtraction of the common error."""
        errors = self.factor @ whitened
        attitude = Rotation.from_rotvec(errors[_ATTITUDE]) * self._state.world_from_body
        result = linearise_landmarks(self._measurement, self._state.position_m + errors[_POSITION], attitude)
        # from the derivative with respect to a further rotation to that with respect to the total rotation vector
        result.jacobian[..., _ATTITUDE] = result.jacobian[..., _ATTITUDE] @ left_jacobian(errors[_ATTITUDE])
        return result, result.residuals - result.jacobian[..., _COMMON] @ errors[_COMMON]

    def solve(
        self, weights: Float[np.ndarray, "n"], whitened: Float[np.ndarray, "18"], iterations: int = 4
    ) -> _Solution:
        """Estimate the whitened errors from landmarks with these weights, by Gauss-Newton from a first estimate."""
        identity = np.eye(_UNKNOWNS)
        linearisation, residuals = self.linearise(whitened)
        for _ in range(iterations):
            factors = linearisation.jacobian @ self.factor
            weighted = weights[:, None, None] * np.linalg.solve(linearisation.noise, factors)
            flat, flat_weighted = factors.reshape(-1, _UNKNOWNS), weighted.reshape(-1, _UNKNOWNS)
            information = symmetrise(identity + flat.T @ flat_weighted)
            target = flat_weighted.T @ (residuals.reshape(-1) + flat @ whitened)
            previous, whitened = whitened, np.linalg.solve(information, target)
            linearisation, residuals = self.linearise(whitened)
            # Whitened errors have the unit of one standard deviation before the update. A Gauss-Newton step is about
            # 1e-3 of the previous one, so the error after a step below 1e-4 is about 1e-7 standard deviations.
            if np.abs(whitened - previous).max() < 1e-4:
                break
        squares = _normalise(residuals, linearisation.noise)
        return _Solution(whitened, information, linearisation, residuals, squares)


def _estimate_robustly(
    problem: _LandmarkProblem, candidates: Bool[np.ndarray, "n"], limit: float
) -> tuple[Bool[np.ndarray, "n"], Float[np.ndarray, "18"]]:
    """Find the inliers among the candidates, and the whitened errors, by graduated non-convexity (Yang, Eq. 14)."""
    weights = candidates.astype(np.float64)
    solution = problem.solve(weights, np.zeros(_UNKNOWNS))
    largest = float(solution.squares[candidates].max())
    if largest < limit:
        return candidates, solution.whitened
    control = limit / (2.0 * largest - limit)
    for _ in range(MAX_PASSES):
        squares = np.maximum(solution.squares, np.finfo(float).tiny)
        between = np.sqrt(limit * control * (control + 1.0) / squares) - control
        weights = np.where(candidates & solution.linearisation.visible, np.clip(between, 0.0, 1.0), 0.0)
        solution = problem.solve(weights, solution.whitened, iterations=1)
        if np.all((weights == 0.0) | (weights == 1.0)):
            break
        control *= 1.4  # Yang et al., remark 5
    return weights > 0.5, solution.whitened


def _update_gated(
    state: NavigationState,
    jacobian: Float[np.ndarray, "m 15"],
    residual: Float[np.ndarray, "m"],
    noise: Float[np.ndarray, "m m"],
) -> tuple[NavigationState, UpdateOutcome]:
    """Update by a measurement with this Jacobian, unless its innovation is improbable."""
    if not (np.isfinite(residual).all() and np.isfinite(jacobian).all() and np.isfinite(noise).all()):
        return state, UpdateOutcome.INVALID
    root = square_root(state.covariance)
    factor = jacobian @ root
    square = float(residual @ np.linalg.solve(noise + factor @ factor.T, residual))
    if not square < chdtri(len(residual), FALSE_REJECTION):
        return state, UpdateOutcome.REJECTED
    weighted = np.linalg.solve(noise, factor)
    lower = np.linalg.cholesky(symmetrise(np.eye(ERRORS) + factor.T @ weighted))
    half = linalg.solve_triangular(lower, root.T, lower=True)
    errors = half.T @ linalg.solve_triangular(lower, weighted.T @ residual, lower=True)
    return state.correct(errors, half.T @ half), UpdateOutcome.APPLIED


def square_root(covariance: ErrorMatrix) -> ErrorMatrix:
    """Compute L with L L' = P. The matrix of correlations is factored, because the errors have different units."""
    deviations = np.sqrt(np.diag(covariance))
    scale = np.where(deviations > 0.0, deviations, 1.0)
    correlations = covariance / np.outer(scale, scale)
    try:
        return np.asarray(scale[:, None] * np.linalg.cholesky(correlations))
    except np.linalg.LinAlgError:
        # errors without variance, or fully correlated errors
        values, vectors = np.linalg.eigh(correlations)
        return np.asarray(scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def _normalise(residuals: Float[np.ndarray, "n 2"], covariances: Float[np.ndarray, "n 2 2"]) -> Float[np.ndarray, "n"]:
    """Compute r' C^-1 r of each residual."""
    return np.asarray(np.einsum("ni,ni->n", residuals, np.linalg.solve(covariances, residuals[..., None])[..., 0]))
