"""Surface frame of the landing site estimator.

The surface frame is level, with its origin at the first camera: z is up, x is the horizontal direction of increasing
image columns, y is the cross product of z and x. The options select the source of the vertical. The azimuth of the
frame in the world comes from the on-board pose.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from marsyard.algorithms.arrays import Points3, Vector3
from marsyard.algorithms.hda.kernels.elevation import INLIER_DEVIATIONS, SIGMA_PER_MEDIAN
from marsyard.algorithms.hda.options import HdaOptions, SurfaceFrame
from marsyard.algorithms.hda.scene import CameraView

#: Number of random point triples for the robust plane through all points.
PLANE_TRIALS = 200


def up_direction(first: CameraView, up_camera: Vector3, points: Points3, options: HdaOptions) -> Vector3:
    """Unit vector upwards in the first camera's frame, from the source that the option `surface_frame` selects.

    `up_camera` is the inclinometers' measurement; `points` are in the first camera's frame, metres.
    """
    if options.surface_frame is SurfaceFrame.INCLINOMETER:
        return up_camera
    if options.surface_frame is SurfaceFrame.STATE:
        return np.asarray(first.world_from_camera.rotation.inv().apply(np.array([0.0, 0.0, 1.0])))
    return plane_normal(points, options.seed)


def plane_normal(points: Points3, seed: int) -> Vector3:
    """Unit normal, towards the origin, of the least-median-of-squares plane through at least four points.

    The best plane through random triples is refined by least squares over the points within `INLIER_DEVIATIONS`.
    The standard deviation is `SIGMA_PER_MEDIAN` (1 + 5 / (n - 3)) times the median distance (Rousseeuw & Leroy 1987).
    """
    rng = np.random.default_rng(seed)
    corners = points[rng.integers(0, len(points), (PLANE_TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    is_valid = lengths > 1e-9 * float(np.mean(points**2))  # excludes triples on one line
    normals, corners = normals[is_valid] / lengths[is_valid, None], corners[is_valid]
    if len(normals) == 0:
        return np.array([0.0, 0.0, -1.0])
    distances = np.abs(points @ normals.T - np.sum(normals * corners[:, 0], axis=1))
    medians = np.median(distances, axis=0)
    best = int(np.argmin(medians))
    sigma = SIGMA_PER_MEDIAN * (1.0 + 5.0 / max(len(points) - 3, 1)) * medians[best]
    inliers = points[distances[:, best] <= INLIER_DEVIATIONS * sigma]
    normal = normals[best]
    if len(inliers) >= 3:
        normal = np.linalg.svd(inliers - inliers.mean(axis=0), full_matrices=False)[2][2]
    return np.asarray(-np.sign(normal @ points.mean(axis=0)) * normal)


def surface_from_camera(up_camera: Vector3) -> Rotation:
    """Rotation from the camera's frame to the surface frame; up must not be parallel to the camera's x axis."""
    x = np.array([1.0, 0.0, 0.0]) - up_camera[0] * up_camera
    x /= np.linalg.norm(x)
    return Rotation.from_matrix(np.stack([x, np.cross(up_camera, x), up_camera]))


def world_from_surface(world_from_camera: Rotation, surface_from_first: Rotation) -> Rotation:
    """Rotation about the vertical that aligns the surface frame's azimuth with the on-board pose."""
    x = (world_from_camera * surface_from_first.inv()).apply(np.array([1.0, 0.0, 0.0]))
    return Rotation.from_euler("z", float(np.arctan2(x[1], x[0])))
