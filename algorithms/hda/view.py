"""Measurements in the cameras' own frames, and the geometry of a pixel at a depth.

The camera frame has its origin in the centre of projection C, z along the optical axis A, x to the right along the
image columns and y = z x x. Depth is z: the component along A, as in Eqs. 6-8. Undistorted (unit focal length)
coordinates of a pixel are (x / z, y / z) of its line of sight. The motion of CAHVORE's entrance pupil is neglected.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt16
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.arrays import Flags, Points2, Points3, Values, Vector3
from marsyard.algorithms.image.frame_transfer import remove_frame_transfer
from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DetectorImage, LandingMeasurements, PoseMeasurement

#: Minimum relative response for the division; dead pixels have less.
MIN_RESPONSE = 0.05


@dataclass(frozen=True)
class View:
    """One image in its camera's frame.

    - counts: Detector counts without frame transfer, pixel response and lens fall-off
    - camera: Its camera, in the camera frame
    - world_from_camera: The camera's pose by the on-board filter
    """

    counts: UInt16[np.ndarray, "rows columns"]
    camera: CameraModel
    world_from_camera: RigidTransform

    @property
    def focal_px(self) -> float:
        """Mean focal length: pixels per unit of undistorted coordinates."""
        return float(np.mean(self.camera.focal_lengths))


#: The two images of an estimate.
Views = tuple[View, View]


def build_view(image: DetectorImage, pose: PoseMeasurement) -> View:
    """The view of an image taken at a pose. Raises ValueError if the image's size is not its camera's."""
    if image.counts.shape != image.camera.size[::-1]:
        raise ValueError(f"the picture has (rows, columns) {image.counts.shape}, its camera {image.camera.size[::-1]}")
    body_from_camera = camera_pose(image.camera)
    camera = image.camera.moved(body_from_camera.inv())
    return View(flat_fielded(image), camera, pose.world_from_body * body_from_camera)


def flat_fielded(image: DetectorImage) -> UInt16[np.ndarray, "rows columns"]:
    """Counts without offset, frame transfer and response variations.

    A lens passes a third less light in its corners, which biases sums of absolute differences (Eq. 9) of the same
    ground seen in the middle and near the border. Over rendered rocks from 15 m a fifth of the points was wrong without
    this correction, and half a per cent with it. Frame transfer is removed first: at 10 ms it is half of the exposure's
    light in the last of the MER camera's 1,024 rows.
    """
    known = image.calibration
    response = np.maximum(known.flat_field, MIN_RESPONSE).astype(np.float32)
    signal = image.counts - np.float32(known.offset_dn)
    signal = remove_frame_transfer(signal, known, known.rows_summed).astype(np.float32, copy=False)
    return np.asarray(np.rint(np.clip(signal / response, 0.0, 65535.0)).astype(np.uint16))


def camera_pose(camera: CameraModel) -> RigidTransform:
    """The transform from the camera frame to the frame of the camera model."""
    axes = np.column_stack([camera.right, np.cross(camera.a, camera.right), camera.a])
    return rigid(Rotation.from_matrix(axes), np.array(camera.c))


def undistort(camera: CameraModel, pixels: Points2) -> Points2:
    """Unit focal length coordinates of pixels; NaN without a forward ray."""
    directions = camera.rays(pixels)[1]
    with np.errstate(divide="ignore", invalid="ignore"):
        places: Points2 = directions[:, :2] / directions[:, 2:]
    places[~(directions[:, 2] > 0.0)] = np.nan
    return places


def points_at_depth(places: Points2, depths: Values) -> Points3:
    """Points (camera frame) of undistorted coordinates at depths (Eq. 6)."""
    return np.asarray(np.column_stack([places, np.ones(len(places))]) * depths[:, None])


def project_points(camera: CameraModel, points: Points3) -> tuple[Points2, Flags]:
    """Pixels of points in the camera frame and whether they lie in the picture."""
    pixels, visible = camera.project(points)
    return pixels, visible & camera.in_frame(pixels)


@dataclass(frozen=True)
class LandingScene:
    """Two views and the measurements taken with the first.

    - range_m: Depth of the ground on the first camera's optical axis; NaN if unknown
    - up_camera: Unit vector upwards by the inclinometers, in the first camera's frame
    - apriori_site_world: Default landing site
    """

    views: Views
    range_m: float
    up_camera: Vector3
    apriori_site_world: Vector3

    @property
    def second_from_first(self) -> RigidTransform:
        """The camera's motion by the on-board poses."""
        return self.views[1].world_from_camera.inv() * self.views[0].world_from_camera


def build_scene(measurements: LandingMeasurements) -> LandingScene:
    """Transform the measurements to the cameras' frames. Raises ValueError if an image's size is not its camera's."""
    pairs = zip(measurements.images, measurements.poses, strict=True)
    first, second = (build_view(image, pose) for image, pose in pairs)
    body_from_camera = camera_pose(measurements.images[0].camera)
    up_camera = body_from_camera.rotation.inv().apply(np.array(measurements.up_body))
    return LandingScene((first, second), measurements.slant_range_m, up_camera, measurements.apriori_site_world)
