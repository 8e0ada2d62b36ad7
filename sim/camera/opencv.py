"""Conversion of OpenCV's camera models to CAHVOR and CAHVORE, with the residual.

OpenCV's camera looks along z with x right and y down; its pixels count as ours. Its pinhole model distorts about the
direction z with k1, k2, k3 (radial) and p1, p2 (tangential):

    r^2 = x^2 + y^2        x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
                           y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

Its rational model divides the radial factor by 1 + k4 r^2 + k5 r^4 + k6 r^6. Its fisheye model moves a ray at the
angle theta from z to the distance theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) (Kannala & Brandt
2006).

CAHVOR about O = A equals the pinhole model with k3 = p1 = p2 = 0; others are fitted by tilting O. CAHVORE about O = A
with linearity 0 and a fixed pupil equals the fisheye model with k3 = k4 = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.camera.base import CameraModel
from marsyard.sim.camera.models import Cahv, Cahvor, Cahvore

Array = NDArray[np.float64]
C = TypeVar("C", bound=CameraModel)

#: Samples along each side of the frame, including its outer edge.
_SAMPLES = 33
#: A closed form with a smaller residual is exact and is not fitted.
_EXACT_PX = 1e-9
#: Residual of a pixel that is not visible in a camera during the fit.
_INVISIBLE_PX = 1e3


@dataclass(frozen=True)
class Residual:
    """Root mean square and maximum of the distance between two cameras' pixels over the frame."""

    rms_px: float
    max_px: float


def from_opencv(
    matrix: Float[np.ndarray, "3 3"],
    distortion: Float[np.ndarray, "coefficients"],
    size: tuple[int, int],
    camera_from_world: RigidTransform | None = None,
) -> tuple[Cahvor, Residual]:
    """Fit the CAHVOR camera nearest to OpenCV's pinhole camera; return it with its residual over the frame.

    Exact if all coefficients but k1 and k2 are zero; otherwise fitted by least squares.

    - matrix: camera matrix, pixels; may have a skew
    - distortion: none, (k1, k2, p1, p2), (k1, k2, p1, p2, k3) or (k1, k2, p1, p2, k3, k4, k5, k6)
    - camera_from_world: transform from the new camera's frame of reference to OpenCV's axes; identity by default

    Raises ValueError if the matrix is no camera matrix, the number of coefficients differs, or the distortion is not
    one-to-one within the frame.
    """
    coefficients = _eight_coefficients(distortion)
    linear = _linear(matrix, size, RigidTransform.identity() if camera_from_world is None else camera_from_world)
    pixels = _frame_samples(size)
    axes = np.stack([_perpendicular(linear.a), np.cross(linear.a, _perpendicular(linear.a)), linear.a])
    points = _undistorted(_normalised(pixels, matrix), coefficients)
    directions = _in_world(np.concatenate([points, np.ones((len(points), 1))], axis=1), camera_from_world)
    start = Cahvor.from_cahv(linear, r=(0.0, coefficients[0], coefficients[1]))
    scales = np.array([1e-3, 1e-3, 1e-2, 1e-2, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1.0, 1.0])
    return _fit(start, lambda change: _vary_pinhole(start, axes, change), (directions, pixels), scales, method="lm")


def from_opencv_fisheye(
    matrix: Float[np.ndarray, "3 3"],
    distortion: Float[np.ndarray, "coefficients"],
    size: tuple[int, int],
    camera_from_world: RigidTransform | None = None,
) -> tuple[Cahvore, Residual]:
    """Fit the CAHVORE camera nearest to OpenCV's fisheye (Kannala & Brandt); return it with its residual.

    Exact if k3 and k4 are zero; otherwise scale, radial terms and linearity are fitted by least squares. `distortion`
    is (k1, k2, k3, k4); the other parameters and the errors are those of `from_opencv`.
    """
    if len(distortion) != 4 or not np.all(np.isfinite(distortion)):
        raise ValueError(f"distortion of a fisheye must be (k1, k2, k3, k4), finite, not {distortion}")
    linear = _linear(matrix, size, RigidTransform.identity() if camera_from_world is None else camera_from_world)
    pixels = _frame_samples(size)
    directions = _in_world(_fisheye_directions(_normalised(pixels, matrix), distortion), camera_from_world)
    start = Cahvore.from_cahv(linear, r=(0.0, distortion[0], distortion[1]), linearity=0.0)
    limits, scales = np.array([0.5, 10.0, 10.0, 1.0]), np.array([1e-3, 1e-3, 1e-3, 1e-1])
    bounds = (-limits, limits)
    return _fit(start, lambda change: _vary_fisheye(start, change), (directions, pixels), scales, bounds=bounds)


def _fit(
    start: C, vary: Callable[[Array], C], samples: tuple[Array, Array], scales: Array, **options: Any
) -> tuple[C, Residual]:
    """Fit a camera to samples (directions, pixels) from `start`; `scales` are typical sizes of the parameters."""
    directions, pixels = samples
    residual = _residual(_far_pixels(start, directions) - pixels)
    if residual.max_px <= _EXACT_PX:
        return start, residual

    def differences(change: Array) -> Array:
        projected = _far_pixels(vary(change), directions)
        return np.nan_to_num(projected - pixels, nan=_INVISIBLE_PX).ravel()

    fit = least_squares(differences, np.zeros(len(scales)), x_scale=scales, xtol=1e-14, ftol=1e-14, **options)
    camera = vary(np.asarray(fit.x))
    return camera, _residual(_far_pixels(camera, directions) - pixels)


def _eight_coefficients(distortion: Array) -> Array:
    if len(distortion) not in (0, 4, 5, 8) or not np.all(np.isfinite(distortion)):
        raise ValueError(
            f"distortion must be none, (k1, k2, p1, p2), (k1, k2, p1, p2, k3) or (k1, k2, p1, p2, k3, k4, k5, k6), "
            f"finite, not {distortion}"
        )
    return np.concatenate([distortion, np.zeros(8 - len(distortion))])


def _linear(matrix: Array, size: tuple[int, int], camera_from_world: RigidTransform) -> Cahv:
    allowed = matrix[1, 0] == 0 and np.array_equal(matrix[2], [0.0, 0.0, 1.0])
    if not (allowed and matrix[0, 0] > 0 and matrix[1, 1] > 0):
        raise ValueError("matrix must be ((fx, skew, cx), (0, fy, cy), (0, 0, 1)) with fx and fy positive")
    world_from_camera = camera_from_world.inv().as_matrix()
    rotation = world_from_camera[:3, :3]
    return Cahv(world_from_camera[:3, 3], rotation[:, 2], rotation @ matrix[0], rotation @ matrix[1], size)


def _vary_pinhole(start: Cahvor, axes: Array, change: Array) -> Cahvor:
    """A camera near `start`: image plane turned, H and V rescaled and shifted, O tilted, rho1 and rho2 changed."""
    (tilt_x, tilt_y, *rho), turn, (scale_u, scale_v, shift_u, shift_v) = change[:4], change[4:7], change[7:11]
    rotation = Rotation.from_rotvec(turn).as_matrix()
    o = start.o + tilt_x * axes[0] + tilt_y * axes[1]
    return Cahvor(
        start.c,
        rotation @ start.a,
        rotation @ (start.h * (1 + scale_u) + shift_u * start.a),
        rotation @ (start.v * (1 + scale_v) + shift_v * start.a),
        o / np.linalg.norm(o),
        start.r + np.array([0.0, *rho]),
        start.size,
    )


def _vary_fisheye(start: Cahvore, change: Array) -> Cahvore:
    """A fisheye near `start`: its scale, rho1, rho2 and linearity changed."""
    scale, rho1, rho2, linearity = (float(one) for one in change)
    (hc, vc), a = start.image_centre, start.a
    h, v = start.h + scale * (start.h - hc * a), start.v + scale * (start.v - vc * a)
    r = start.r + np.array([0.0, rho1, rho2])
    return Cahvore(start.c, a, h, v, start.o, r, start.e, linearity=linearity, size=start.size)


def _fisheye_directions(points: Array, coefficients: Array) -> Array:
    """Invert OpenCV's fisheye: directions (z along the axis) of its points (x, y), shape (n, 2); Newton's method."""
    distance = np.hypot(points[:, 0], points[:, 1])
    theta = np.minimum(distance, np.pi)
    for _ in range(50):
        gain, slope = _fisheye_gain(theta, coefficients)
        step = (theta * gain - distance) / slope
        theta = np.clip(theta - step, 0.0, np.pi)
        if np.max(np.abs(step)) < 1e-14:
            break
    angles = np.linspace(0.0, float(theta.max()), 1000)
    reached = theta * _fisheye_gain(theta, coefficients)[0]
    if not (np.max(np.abs(reached - distance)) < 1e-9 and np.all(_fisheye_gain(angles, coefficients)[1] > 0)):
        raise ValueError("the distortion folds over within the frame: some pixels have no direction, or several")
    across = np.divide(np.sin(theta), distance, out=np.ones_like(theta), where=distance > 0)
    return np.stack([points[:, 0] * across, points[:, 1] * across, np.cos(theta)], axis=-1)


def _in_world(directions: Array, camera_from_world: RigidTransform | None) -> Array:
    """Rotate directions from OpenCV's axes to the camera's frame of reference."""
    return directions if camera_from_world is None else directions @ camera_from_world.as_matrix()[:3, :3]


def _far_pixels(camera: CameraModel, directions: Array) -> Array:
    return camera.project(camera.c + directions)[0]


def _normalised(pixels: Array, matrix: Array) -> Array:
    y = (pixels[:, 1] - matrix[1, 2]) / matrix[1, 1]
    return np.stack([(pixels[:, 0] - matrix[0, 2] - matrix[0, 1] * y) / matrix[0, 0], y], axis=-1)


def _undistorted(distorted: Array, coefficients: Array) -> Array:
    """Invert the pinhole distortion by Newton's method in two dimensions."""
    points = distorted.copy()
    for _ in range(50):
        image, slope = _distorted(points, coefficients)
        step = np.linalg.solve(slope, (image - distorted)[..., np.newaxis])[..., 0]
        points -= step
        if np.max(np.abs(step)) < 1e-14:
            break
    image, slope = _distorted(points, coefficients)
    if not (np.max(np.abs(image - distorted)) < 1e-9 and np.all(np.linalg.det(slope) > 0)):
        raise ValueError("the distortion folds over within the frame: some pixels have no direction, or several")
    return points


def _distorted(points: Array, coefficients: Array) -> tuple[Array, Array]:
    """OpenCV's pinhole distortion of (x, y), shape (n, 2), and its derivative, shape (n, 2, 2)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    x, y = points.T
    square = x * x + y * y
    over = 1 + square * (k1 + square * (k2 + square * k3))
    under = 1 + square * (k4 + square * (k5 + square * k6))
    gain = over / under
    slope = (k1 + square * (2 * k2 + square * 3 * k3) - gain * (k4 + square * (2 * k5 + square * 3 * k6))) / under
    across = 2 * (x * y * slope + p1 * x + p2 * y)
    distorted = np.stack(
        [x * gain + 2 * p1 * x * y + p2 * (square + 2 * x * x), y * gain + p1 * (square + 2 * y * y) + 2 * p2 * x * y],
        axis=-1,
    )
    by_x = np.stack([gain + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x, across], axis=-1)
    by_y = np.stack([across, gain + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x], axis=-1)
    return distorted, np.stack([by_x, by_y], axis=-2)


def _fisheye_gain(theta: Array, coefficients: Array) -> tuple[Array, Array]:
    """Distance over angle of OpenCV's fisheye, and the derivative of the distance."""
    k1, k2, k3, k4 = coefficients
    square = theta * theta
    gain = 1 + square * (k1 + square * (k2 + square * (k3 + square * k4)))
    return gain, 1 + square * (3 * k1 + square * (5 * k2 + square * (7 * k3 + square * 9 * k4)))


def _frame_samples(size: tuple[int, int]) -> Array:
    columns, rows = (np.linspace(-0.5, extent - 0.5, _SAMPLES) for extent in size)
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)


def _residual(differences: Array) -> Residual:
    squares = np.sum(differences * differences, axis=-1)
    return Residual(rms_px=float(np.sqrt(np.mean(squares))), max_px=float(np.sqrt(np.max(squares))))


def _perpendicular(axis: Array) -> Array:
    """A unit vector perpendicular to a unit vector."""
    vector = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    return np.asarray(vector / np.linalg.norm(vector))
