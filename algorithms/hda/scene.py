"""Images and measurements of a landing in the cameras' frames, and the level surface frame of the map.

In a camera frame, z is the optical axis, x runs along columns and y along rows. Normalised image coordinates are
(x / z, y / z). The surface frame is level, with its origin at the first camera: z is up, x is the horizontal direction
of increasing image columns, y is the cross product of z and x. The options select the source of the vertical. The
azimuth of the surface frame in the world comes from the on-board pose. Equations are those of Johnson, Montgomery &
Matthies, "Vision Guided Landing".
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt16
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.arrays import Flags, Points2, Points3, Vector, Vector3
from marsyard.algorithms.hda.kernels.elevation import INLIER_DEVIATIONS, SIGMA_PER_MEDIAN
from marsyard.algorithms.hda.options import HdaOptions, SurfaceFrame
from marsyard.algorithms.image.frame_transfer import remove_frame_transfer
from marsyard.sim.camera import CameraModel, camera_pose
from marsyard.sim.measurements import DetectorImage, LandingMeasurements, PoseMeasurement

#: Lower limit of the flat field before division; dead pixels are below it.
MIN_RESPONSE = 0.05
#: Number of random point triples for the robust plane through all points.
PLANE_TRIALS = 200


@dataclass(frozen=True)
class CameraView:
    """One corrected image with its camera.

    - counts: Detector counts corrected for frame transfer, pixel response and lens fall-off
    - camera: Camera model in the camera frame
    - world_from_camera: Camera pose estimated on board
    """

    counts: UInt16[np.ndarray, "rows columns"]
    camera: CameraModel
    world_from_camera: RigidTransform

    @property
    def focal_px(self) -> float:
        """Mean focal length: pixels per unit of undistorted coordinates."""
        return float(np.mean(self.camera.focal_lengths))


#: The two images of an estimate.
Views = tuple[CameraView, CameraView]


def build_view(image: DetectorImage, pose: PoseMeasurement) -> CameraView:
    """Build the view of an image taken at a pose. Raises ValueError if the image's size differs from its camera's."""
    if image.counts.shape != image.camera.size[::-1]:
        raise ValueError(f"the image has (rows, columns) {image.counts.shape}, its camera {image.camera.size[::-1]}")
    body_from_camera = camera_pose(image.camera)
    camera = image.camera.transform(body_from_camera.inv())
    return CameraView(apply_flat_field(image), camera, pose.world_from_body * body_from_camera)


def apply_flat_field(image: DetectorImage) -> UInt16[np.ndarray, "rows columns"]:
    """Correct counts for offset, frame transfer and response variations.

    Image corners receive a third less light than the centre. This biases sums of absolute differences (Eq. 9) between
    image centre and border. Over rendered rocks seen from 15 m, 20 % of the points were wrong without this correction
    and 0.5 % with it. Frame transfer is removed first: at an exposure time of 10 ms its signal in the last of the MER
    camera's 1,024 rows is half of the exposure's signal.
    """
    detector = image.calibration
    response = np.maximum(detector.flat_field, MIN_RESPONSE).astype(np.float32)
    signal = image.counts - np.float32(detector.offset_dn)
    signal = remove_frame_transfer(signal, detector, detector.rows_summed).astype(np.float32, copy=False)
    return np.asarray(np.rint(np.clip(signal / response, 0.0, 65535.0)).astype(np.uint16))


def undistort(camera: CameraModel, pixels: Points2) -> Points2:
    """Convert pixels (u, v) to normalised image coordinates (x / z, y / z); NaN if the ray does not point forward."""
    directions = camera.rays(pixels)[1]
    with np.errstate(divide="ignore", invalid="ignore"):
        coordinates: Points2 = directions[:, :2] / directions[:, 2:]
    coordinates[~(directions[:, 2] > 0.0)] = np.nan
    return coordinates


def points_at_depth(coordinates: Points2, depths: Vector) -> Points3:
    """Convert normalised image coordinates and depths to points in the camera frame (Eq. 6)."""
    return np.asarray(np.column_stack([coordinates, np.ones(len(coordinates))]) * depths[:, None])


def project_points(camera: CameraModel, points: Points3) -> tuple[Points2, Flags]:
    """Project points in the camera frame to pixels (u, v); also return whether the pixels lie inside the image."""
    pixels, visible = camera.project(points)
    return pixels, visible & camera.in_frame(pixels)


@dataclass(frozen=True)
class LandingScene:
    """Two views, and the measurements at the time of the first view.

    - range_m: Depth of the ground on the first camera's optical axis; NaN if unknown
    - up_camera: Unit vector upwards measured by the inclinometers, in the first camera's frame
    - apriori_site_world: Default landing site
    """

    views: Views
    range_m: float
    up_camera: Vector3
    apriori_site_world: Vector3

    @property
    def second_from_first(self) -> RigidTransform:
        """Relative camera pose from the on-board poses."""
        return self.views[1].world_from_camera.inv() * self.views[0].world_from_camera


def build_scene(measurements: LandingMeasurements) -> LandingScene:
    """Transform the measurements to the cameras' frames. Raises the same error as `build_view`."""
    pairs = zip(measurements.images, measurements.poses, strict=True)
    first, second = (build_view(image, pose) for image, pose in pairs)
    body_from_camera = camera_pose(measurements.images[0].camera)
    up_camera = body_from_camera.rotation.inv().apply(np.array(measurements.up_body))
    return LandingScene((first, second), measurements.slant_range_m, up_camera, measurements.apriori_site_world)


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
        *_, principal_axes = np.linalg.svd(inliers - inliers.mean(axis=0), full_matrices=False)
        normal = principal_axes[-1]  # of least variance
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
