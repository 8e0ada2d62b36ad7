"""Kernel of structure from motion (section II.B): robust Levenberg-Marquardt with the inverse depths eliminated.

Sections are those of Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Levenberg-Marquardt damping: initial value, lower limit, and value above which the iteration ends unconverged.
START_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-3, 1e-12, 1e12
#: Regularisation added to the Hessian diagonal of each inverse depth, as a fraction of the squared focal length. It
#: keeps inverse depths fixed that are not observable because the camera does not move.
DEPTH_CURVATURE = 1e-14
#: The same for rotation and translation.
MOTION_CURVATURE = 1e-15
#: Smallest component along the optical axis of a projected feature; below it the feature is behind the camera.
MIN_FORWARD = 1e-6


class MatchArrays(NamedTuple):
    """Features in both images, normalised image coordinates (n, 2); focal length and scale of Cauchy's cost, pixels."""

    first: Array
    second: Array
    focal: float
    scale: float


class MotionArrays(NamedTuple):
    """Rotation (unit quaternion w, x, y, z), translation, and the features' inverse depths in the first camera."""

    q: Array
    t: Array
    inverse_depths: Array


@njit(cache=True)
def rotation_matrix(q: Array) -> Array:
    """Rotation matrix of a unit quaternion (w, x, y, z)."""
    w, x, y, z = q
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


@njit(cache=True)
def rotate_quaternion(q: Array, step: Array) -> Array:
    """Rotate a quaternion by a small rotation vector and normalise it."""
    p = np.array([1.0, 0.5 * step[0], 0.5 * step[1], 0.5 * step[2]])
    result = np.array(
        [
            p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
            p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
            p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
            p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
        ]
    )
    return result / math.sqrt(np.sum(result * result))


@njit(cache=True)
def residuals(matches: MatchArrays, motion: MotionArrays) -> Array:
    """Reprojection minus measurement in the second image, pixels, shape (n, 2); inf behind the camera.

    A feature (x, y) with inverse depth rho is projected along R (x, y, 1) + rho t.
    """
    first, second, focal, _ = matches
    q, t, inverse_depths = motion
    R = rotation_matrix(q)
    result = np.empty_like(second)
    for i in range(first.shape[0]):
        x, y, rho = first[i, 0], first[i, 1], inverse_depths[i]
        px = R[0, 0] * x + R[0, 1] * y + R[0, 2] + rho * t[0]
        py = R[1, 0] * x + R[1, 1] * y + R[1, 2] + rho * t[1]
        pz = R[2, 0] * x + R[2, 1] * y + R[2, 2] + rho * t[2]
        if pz <= MIN_FORWARD:
            result[i, 0] = result[i, 1] = math.inf
            continue
        result[i, 0] = focal * (px / pz - second[i, 0])
        result[i, 1] = focal * (py / pz - second[i, 1])
    return result


@njit(cache=True)
def cauchy_cost(r: Array, scale: float) -> float:
    """Sum of scale^2 / 2 log(1 + (|r| / scale)^2) over the residuals r of the features, shape (n, 2)."""
    total = 0.0
    for i in range(r.shape[0]):
        total += math.log1p((r[i, 0] ** 2 + r[i, 1] ** 2) / scale**2)
    return 0.5 * scale**2 * total


@njit(cache=True)
def _jacobian(x: float, y: float, rho: float, focal: float, R: Array, t: Array, Jm: Array, Jd: Array) -> None:
    """Jacobian of one residual: rotation (left perturbation) and translation (`Jm`, 2 x 6), inverse depth (`Jd`, 2).

    (ax, ay, az) is R (x, y, 1), the feature's direction in the second camera's frame; pz is rho times the feature's
    depth in that frame.
    """
    ax = R[0, 0] * x + R[0, 1] * y + R[0, 2]
    ay = R[1, 0] * x + R[1, 1] * y + R[1, 2]
    az = R[2, 0] * x + R[2, 1] * y + R[2, 2]
    pz = az + rho * t[2]
    gain = focal / pz
    image_point = ((ax + rho * t[0]) / pz, (ay + rho * t[1]) / pz)
    # d(step x a) = (sy az - sz ay, sz ax - sx az, sx ay - sy ax)
    Jm[0, 0] = -gain * image_point[0] * ay
    Jm[0, 1] = gain * (az + image_point[0] * ax)
    Jm[0, 2] = -gain * ay
    Jm[1, 0] = -gain * (az + image_point[1] * ay)
    Jm[1, 1] = gain * image_point[1] * ax
    Jm[1, 2] = gain * ax
    for k in range(2):
        Jm[k, 3] = Jm[k, 4] = 0.0
        Jm[k, 3 + k] = gain * rho
        Jm[k, 5] = -gain * image_point[k] * rho
        Jd[k] = gain * (t[k] - image_point[k] * t[2])


@njit(cache=True)
def _compute_step(
    matches: MatchArrays, r: Array, motion: MotionArrays, damping: float, with_depths: bool
) -> tuple[Array, Array]:
    """Damped Gauss-Newton step of rotation and translation (6,) and of inverse depths, by the Schur complement.

    S and g are the Hessian and the gradient of rotation and translation after elimination of the inverse depths.
    `curvature` and `slope` are those of each inverse depth; `mixed` are its second derivatives with rotation and
    translation. NaN if the normal equations are not finite.
    """
    first, focal, scale = matches.first, matches.focal, matches.scale
    n = first.shape[0]
    R = rotation_matrix(motion.q)
    Jm, Jd = np.empty((2, 6)), np.empty(2)
    S, g, diagonal = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    mixed, curvature, slope = np.empty((n, 6)), np.empty(n), np.empty(n)
    for i in range(n):
        weight = 1.0 / (1.0 + (r[i, 0] ** 2 + r[i, 1] ** 2) / scale**2)
        _jacobian(first[i, 0], first[i, 1], motion.inverse_depths[i], focal, R, motion.t, Jm, Jd)
        curvature[i] = weight * (Jd[0] ** 2 + Jd[1] ** 2) * (1.0 + damping) + DEPTH_CURVATURE * focal**2
        slope[i] = weight * (Jd[0] * r[i, 0] + Jd[1] * r[i, 1])
        for a in range(6):
            mixed[i, a] = weight * (Jm[0, a] * Jd[0] + Jm[1, a] * Jd[1])
        inverse_curvature = 1.0 / curvature[i] if with_depths else 0.0
        for a in range(6):
            g[a] += weight * (Jm[0, a] * r[i, 0] + Jm[1, a] * r[i, 1]) - mixed[i, a] * slope[i] * inverse_curvature
            diagonal[a] += weight * (Jm[0, a] ** 2 + Jm[1, a] ** 2)
            for b in range(6):
                S[a, b] += weight * (Jm[0, a] * Jm[0, b] + Jm[1, a] * Jm[1, b])
                S[a, b] -= mixed[i, a] * mixed[i, b] * inverse_curvature
    # damping, and a small regularisation of unknowns that are not observable
    for a in range(6):
        S[a, a] += damping * diagonal[a] + MOTION_CURVATURE * focal**2
    step, depth_steps = np.full(6, math.nan), np.zeros(n)
    if np.all(np.isfinite(S)) and np.all(np.isfinite(g)):
        step = -np.linalg.solve(S, g)
    if with_depths:
        for i in range(n):
            depth_steps[i] = -(slope[i] + np.sum(mixed[i] * step)) / curvature[i]
    return step, depth_steps


@njit(cache=True)
def solve(
    matches: MatchArrays, start: MotionArrays, with_depths: bool, iterations: int, tolerance: float
) -> tuple[MotionArrays, float, bool]:
    """Minimise Cauchy's cost from the motion `start`; inverse depths have the inverse unit of the translation.

    Returns the motion with inverse depths, its cost, and whether the iteration converged: whether the norm of the step
    of rotation (radians) and translation is below `tolerance`. With `with_depths` the inverse depths are estimated;
    otherwise they are fixed.
    """
    motion = start
    r = residuals(matches, motion)
    cost = cauchy_cost(r, matches.scale)
    damping = START_DAMPING
    for _ in range(iterations):
        step, depth_steps = _compute_step(matches, r, motion, damping, with_depths)
        trial = MotionArrays(
            rotate_quaternion(motion.q, step[:3]), motion.t + step[3:], motion.inverse_depths + depth_steps
        )
        new_r = residuals(matches, trial)
        new_cost = cauchy_cost(new_r, matches.scale)
        step_length = math.sqrt(np.sum(step * step))
        if new_cost <= cost:
            motion, r, cost = trial, new_r, new_cost
            damping = max(damping * 0.1, MIN_DAMPING)
            if step_length < tolerance:
                return motion, cost, True
        elif step_length < tolerance:
            return motion, cost, True
        else:
            damping *= 10.0
            if damping > MAX_DAMPING:
                return motion, cost, False
    return motion, cost, False
