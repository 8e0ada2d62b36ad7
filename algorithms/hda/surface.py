"""The surface frame: level, its origin at the first camera, its azimuth the camera's (section II.D).

z is up, x runs along the picture's columns as seen from above, y = z x x. Only its azimuth in the world comes from the
on-board pose, and its roll and pitch from wherever the options say.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from marsyard.algorithms.hda.options import HdaOptions, SurfaceFrame
from marsyard.algorithms.hda.view import View

#: Trials of the robust plane through all points.
PLANE_TRIALS = 200


def upwards(
    first: View,
    up_camera: Float[np.ndarray, "3"],
    points: Float[np.ndarray, "n 3"],
    options: HdaOptions,
) -> Float[np.ndarray, "3"]:
    """Unit vector upwards in the first camera's frame, from where the options say.

    `up_camera` is the inclinometers', `points` are in the first camera's frame.
    """
    if options.surface_frame is SurfaceFrame.INCLINOMETER:
        return up_camera
    if options.surface_frame is SurfaceFrame.STATE:
        return np.asarray(first.world_from_camera.rotation.inv().apply(np.array([0.0, 0.0, 1.0])))
    return plane_normal(points, options.seed)


def plane_normal(points: Float[np.ndarray, "n 3"], seed: int) -> Float[np.ndarray, "3"]:
    """Unit normal, towards the origin, of the least-median-of-squares plane through at least four points.

    Of the planes through random triples that from which the median distance is least, refined by least squares over
    the points within 2.5 standard deviations, as the median gives them for a normal distribution (Rousseeuw & Leroy
    1987).
    """
    rng = np.random.default_rng(seed)
    corners = points[rng.integers(0, len(points), (PLANE_TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    real = lengths > 1e-9 * float(np.mean(points**2))
    normals, corners = normals[real] / lengths[real, None], corners[real]
    if len(normals) == 0:
        return np.array([0.0, 0.0, -1.0])
    distances = np.abs(points @ normals.T - np.sum(normals * corners[:, 0], axis=1))
    medians = np.median(distances, axis=0)
    best = int(np.argmin(medians))
    near = points[distances[:, best] <= 2.5 * 1.4826 * (1.0 + 5.0 / max(len(points) - 3, 1)) * medians[best]]
    normal = np.linalg.svd(near - near.mean(axis=0), full_matrices=False)[2][2] if len(near) >= 3 else normals[best]
    return np.asarray(-np.sign(normal @ points.mean(axis=0)) * normal)


def surface_from_camera(up_camera: Float[np.ndarray, "3"]) -> Rotation:
    """The rotation from the camera's frame to the surface frame; upwards must not run along the columns."""
    x = np.array([1.0, 0.0, 0.0]) - up_camera[0] * up_camera
    x /= np.linalg.norm(x)
    return Rotation.from_matrix(np.stack([x, np.cross(up_camera, x), up_camera]))


def world_from_surface(world_from_camera: Rotation, surface_from_first: Rotation) -> Rotation:
    """The rotation about the vertical that takes the surface frame's azimuth to that of the on-board pose."""
    x = (world_from_camera * surface_from_first.inv()).apply(np.array([1.0, 0.0, 0.0]))
    return Rotation.from_euler("z", float(np.arctan2(x[1], x[0])))
