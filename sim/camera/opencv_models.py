"""OpenCV's pinhole and fisheye cameras, converted to the nearest cameras of the CAHV family.

OpenCV's axes are z forward, x right, y down; the centre of the upper left pixel is (0, 0), as in Marsyard.

OpenCV's pinhole model distorts about the direction z with k1, k2, k3 (radial) and p1, p2 (tangential), for a point
(x, y) of the plane z = 1:

    r^2 = x^2 + y^2        x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
                           y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

Its rational model divides the radial factor by 1 + k4 r^2 + k5 r^4 + k6 r^6. Its fisheye model projects a ray at the
angle theta from z to the radius theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) (Kannala & Brandt 2006).

CAHVOR with O = A equals the pinhole model with k3 = p1 = p2 = 0; for other coefficients it is fitted, also by tilting
O. CAHVORE with O = A, linearity 0 and a fixed pupil equals the fisheye model with k3 = k4 = 0.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import cv2
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.camera.base import CameraModel
from marsyard.sim.camera.cahvore import Cahvore
from marsyard.sim.camera.models import Cahv, Cahvor

Array = NDArray[np.float64]
C = TypeVar("C", bound=CameraModel)

#: Number of pixels along each side of the frame, from edge to edge, at which cameras are compared.
_SAMPLES_PER_SIDE = 33
#: A start camera with a smaller residual is exact and is not fitted.
_EXACT_PX = 1e-9
#: Residual during the fit of a direction that is not visible in the camera.
_INVISIBLE_PX = 1e3
#: Inversion of a distortion by Newton's method: maximum number of steps, step that ends it, and accepted error, all in
#: units of the plane z = 1 or radians.
_NEWTON_STEPS, _STEP_TOLERANCE, _INVERSION_TOLERANCE = 50, 1e-14, 1e-9
#: Number of angles at which the fisheye's distortion is tested for a fold.
_FOLD_TEST_ANGLES = 1000


@dataclass(frozen=True)
class Residual:
    """Distance in pixels between the images of the same direction in two cameras: RMS and maximum over the frame."""

    rms_px: float
    max_px: float


def from_opencv(
    matrix: Float[np.ndarray, "3 3"],
    distortion: Float[np.ndarray, "coefficients"],
    size: tuple[int, int],
    camera_from_world: RigidTransform | None = None,
) -> tuple[Cahvor, Residual]:
    """Fit the CAHVOR camera nearest to OpenCV's pinhole camera; return it with its residual over the frame.

    Exact if all coefficients except k1 and k2 are zero; otherwise fitted by least squares.

    - matrix: camera matrix ((fx, skew, cx), (0, fy, cy), (0, 0, 1)), pixels
    - distortion: empty, (k1, k2, p1, p2), (k1, k2, p1, p2, k3) or (k1, k2, p1, p2, k3, k4, k5, k6)
    - camera_from_world: transform from the frame of the returned camera to OpenCV's axes; identity by default

    Raises ValueError if the matrix has another form, the number of coefficients is another, or the distortion is not
    one-to-one within the frame.
    """
    if len(distortion) not in (0, 4, 5, 8) or not np.all(np.isfinite(distortion)):
        raise ValueError(
            f"distortion must be none, (k1, k2, p1, p2), (k1, k2, p1, p2, k3) or (k1, k2, p1, p2, k3, k4, k5, k6), "
            f"finite, not {distortion}"
        )
    coefficients = np.concatenate([distortion, np.zeros(8 - len(distortion))])
    linear, pixels, distorted_points = _create_linear_camera(matrix, size, camera_from_world)
    perpendicular = np.cross(linear.a, np.eye(3)[np.argmin(np.abs(linear.a))])
    perpendicular /= np.linalg.norm(perpendicular)
    tilt_axes = np.stack([perpendicular, np.cross(linear.a, perpendicular)])
    points = _invert_pinhole_distortion(distorted_points, coefficients)
    directions = _rotate_to_world(np.concatenate([points, np.ones((len(points), 1))], axis=1), camera_from_world)
    start = Cahvor.from_cahv(linear, r=(0.0, coefficients[0], coefficients[1]))

    # numbers of tilts (rad), radial terms, rotations (rad), relative scales and shifts (pixels) in a change
    counts = (2, 2, 3, 2, 2)

    def modify_camera(change: Array) -> Cahvor:
        """Tilt O, change rho1 and rho2, rotate the image plane, scale and shift H and V."""
        tilt, radial, turn, (scale_u, scale_v), (shift_u, shift_v) = np.split(change, np.cumsum(counts)[:-1])
        rotation = Rotation.from_rotvec(turn).as_matrix()
        o = start.o + tilt[0] * tilt_axes[0] + tilt[1] * tilt_axes[1]
        return replace(
            start,
            a=rotation @ start.a,
            h=rotation @ (start.h * (1 + scale_u) + shift_u * start.a),
            v=rotation @ (start.v * (1 + scale_v) + shift_v * start.a),
            o=o / np.linalg.norm(o),
            r=start.r + np.array([0.0, *radial]),
        )

    scales = np.repeat([1e-3, 1e-2, 1e-3, 1e-3, 1.0], counts)
    return _fit_camera(start, modify_camera, (directions, pixels), scales, method="lm")


def from_opencv_fisheye(
    matrix: Float[np.ndarray, "3 3"],
    distortion: Float[np.ndarray, "coefficients"],
    size: tuple[int, int],
    camera_from_world: RigidTransform | None = None,
) -> tuple[Cahvore, Residual]:
    """Fit the CAHVORE camera nearest to OpenCV's fisheye (Kannala & Brandt); return it with its residual.

    Exact if k3 and k4 are zero; otherwise focal lengths, radial terms and linearity are fitted by least squares.
    `distortion` is (k1, k2, k3, k4); the other parameters and the errors are those of `from_opencv`.
    """
    if len(distortion) != 4 or not np.all(np.isfinite(distortion)):
        raise ValueError(f"distortion of a fisheye must be (k1, k2, k3, k4), finite, not {distortion}")
    linear, pixels, distorted_points = _create_linear_camera(matrix, size, camera_from_world)
    directions = _rotate_to_world(_invert_fisheye(distorted_points, distortion), camera_from_world)
    start = Cahvore.from_cahv(linear, r=(0.0, distortion[0], distortion[1]), linearity=0.0)

    def modify_camera(change: Array) -> Cahvore:
        """Scale the focal lengths, and change rho1, rho2 and the linearity."""
        (hc, vc), a, scale = start.image_centre, start.a, float(change[0])
        h, v = start.h + scale * (start.h - hc * a), start.v + scale * (start.v - vc * a)
        return replace(start, h=h, v=v, r=start.r + np.array([0.0, *change[1:3]]), linearity=float(change[3]))

    limits, scales = np.array([0.5, 10.0, 10.0, 1.0]), np.array([1e-3, 1e-3, 1e-3, 1e-1])  # of the changes
    return _fit_camera(start, modify_camera, (directions, pixels), scales, bounds=(-limits, limits))


def _fit_camera(
    start: C, modify_camera: Callable[[Array], C], samples: tuple[Array, Array], scales: Array, **options: Any
) -> tuple[C, Residual]:
    """Fit the changes of `modify_camera` to samples (directions, pixels); `scales`: typical sizes of changes."""
    directions, pixels = samples
    residual = _compute_residual(_project_directions(start, directions) - pixels)
    if residual.max_px <= _EXACT_PX:
        return start, residual

    def compute_differences(change: Array) -> Array:
        projected = _project_directions(modify_camera(change), directions)
        return np.nan_to_num(projected - pixels, nan=_INVISIBLE_PX).ravel()

    fit = least_squares(compute_differences, np.zeros(len(scales)), x_scale=scales, xtol=1e-14, ftol=1e-14, **options)
    camera = modify_camera(np.asarray(fit.x))
    return camera, _compute_residual(_project_directions(camera, directions) - pixels)


def _create_linear_camera(
    matrix: Array, size: tuple[int, int], camera_from_world: RigidTransform | None
) -> tuple[Cahv, Array, Array]:
    """Create the camera without distortion, a grid of pixels, and their points (x, y) in the plane z = 1."""
    has_allowed_form = matrix[1, 0] == 0 and np.array_equal(matrix[2], [0.0, 0.0, 1.0])
    if not (has_allowed_form and matrix[0, 0] > 0 and matrix[1, 1] > 0):
        raise ValueError("matrix must be ((fx, skew, cx), (0, fy, cy), (0, 0, 1)) with fx and fy positive")
    world_from_camera = np.eye(4) if camera_from_world is None else camera_from_world.inv().as_matrix()
    rotation = world_from_camera[:3, :3]
    columns, rows = (np.linspace(-0.5, extent - 0.5, _SAMPLES_PER_SIDE) for extent in size)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    y = (pixels[:, 1] - matrix[1, 2]) / matrix[1, 1]
    points = np.stack([(pixels[:, 0] - matrix[0, 2] - matrix[0, 1] * y) / matrix[0, 0], y], axis=-1)
    linear = Cahv(world_from_camera[:3, 3], rotation[:, 2], rotation @ matrix[0], rotation @ matrix[1], size)
    return linear, pixels, points


def _invert_fisheye(points: Array, coefficients: Array) -> Array:
    """Invert OpenCV's fisheye model by Newton's method: directions (z is the axis) of points (x, y), shape (n, 2)."""
    distance = np.hypot(points[:, 0], points[:, 1])
    theta = np.minimum(distance, np.pi)
    for _ in range(_NEWTON_STEPS):
        gain, slope = _compute_fisheye_gain(theta, coefficients)
        step = (theta * gain - distance) / slope
        theta = np.clip(theta - step, 0.0, np.pi)
        if np.max(np.abs(step)) < _STEP_TOLERANCE:
            break
    angles = np.linspace(0.0, float(theta.max()), _FOLD_TEST_ANGLES)
    recomputed_distance = theta * _compute_fisheye_gain(theta, coefficients)[0]
    if not (
        np.max(np.abs(recomputed_distance - distance)) < _INVERSION_TOLERANCE
        and np.all(_compute_fisheye_gain(angles, coefficients)[1] > 0)
    ):
        raise ValueError("the distortion folds over within the frame: some pixels have no direction, or several")
    scale = np.divide(np.sin(theta), distance, out=np.ones_like(theta), where=distance > 0)
    return np.stack([points[:, 0] * scale, points[:, 1] * scale, np.cos(theta)], axis=-1)


def _rotate_to_world(directions: Array, camera_from_world: RigidTransform | None) -> Array:
    return directions if camera_from_world is None else directions @ camera_from_world.as_matrix()[:3, :3]


def _project_directions(camera: CameraModel, directions: Array) -> Array:
    """Project the points C + direction; their distance has no effect, because the entrance pupil does not move."""
    return camera.project(camera.c + directions)[0]


def _invert_pinhole_distortion(distorted_points: Array, coefficients: Array) -> Array:
    """Invert the pinhole distortion by Newton's method in two dimensions."""
    points = distorted_points.copy()
    for _ in range(_NEWTON_STEPS):
        image, slope = _apply_pinhole_distortion(points, coefficients)
        step = np.linalg.solve(slope, (image - distorted_points)[..., np.newaxis])[..., 0]
        points -= step
        if np.max(np.abs(step)) < _STEP_TOLERANCE:
            break
    image, slope = _apply_pinhole_distortion(points, coefficients)
    if not (np.max(np.abs(image - distorted_points)) < _INVERSION_TOLERANCE and np.all(np.linalg.det(slope) > 0)):
        raise ValueError("the distortion folds over within the frame: some pixels have no direction, or several")
    return points


def _apply_pinhole_distortion(points: Array, coefficients: Array) -> tuple[Array, Array]:
    """Apply OpenCV's pinhole distortion to (x, y), shape (n, 2); return also its derivative, shape (n, 2, 2)."""
    rays = np.column_stack([points, np.ones(len(points))])
    distorted, jacobian = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), coefficients)
    # columns of the Jacobian: rotation, then translation; on the plane z = 1 a translation along x or y moves the point
    return distorted.reshape(-1, 2), jacobian.reshape(len(points), 2, -1)[..., 3:5]


def _compute_fisheye_gain(theta: Array, coefficients: Array) -> tuple[Array, Array]:
    """Compute d(theta) / theta for the image distance d of OpenCV's fisheye model, and the derivative of d."""
    k1, k2, k3, k4 = coefficients
    theta2 = theta * theta
    gain = 1 + theta2 * (k1 + theta2 * (k2 + theta2 * (k3 + theta2 * k4)))
    return gain, 1 + theta2 * (3 * k1 + theta2 * (5 * k2 + theta2 * (7 * k3 + theta2 * 9 * k4)))


def _compute_residual(differences: Array) -> Residual:
    """Compute RMS and maximum of the lengths of pixel differences, shape (n, 2)."""
    squares = np.sum(differences * differences, axis=-1)
    return Residual(rms_px=float(np.sqrt(np.mean(squares))), max_px=float(np.sqrt(np.max(squares))))
