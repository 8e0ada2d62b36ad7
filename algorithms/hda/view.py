"""A picture with its camera in the camera's own frame, and the geometry of a pixel at a depth.

The camera frame has its origin in the centre of projection C, z along the optical axis A, x to the right along the
picture's columns and y = z x x. Depth is z: the component along A, as in Eqs. 6-8. Undistorted ("unit focal length")
coordinates of a pixel are (x / z, y / z) of its line of sight; the entrance pupil's motion in CAHVORE is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt16
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.image.frame_transfer import without_frame_transfer
from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DetectorImage, PoseMeasurement

#: Least relative response that is divided by: less is a dead pixel's.
LEAST_RESPONSE = 0.05


@dataclass(frozen=True)
class View:
    """One picture.

    Attributes
    ----------
    counts
        Detector counts that frame transfer, the pixels' response and the lens's fall-off are taken off, shape (rows,
        columns).
    camera
        Its camera, in the camera frame.
    world_from_camera
        The camera's pose by the on-board filter.
    """

    counts: UInt16[np.ndarray, "rows columns"]
    camera: CameraModel
    world_from_camera: RigidTransform

    @property
    def focal_px(self) -> float:
        """Mean focal length, pixels: what a change of undistorted coordinates is worth."""
        return float(np.mean(self.camera.focal_lengths))


def view(image: DetectorImage, pose: PoseMeasurement) -> View:
    """The view of a picture taken at a pose.

    Raises
    ------
    ValueError
        If the picture's size is not its camera's.
    """
    if image.counts.shape != image.camera.size[::-1]:
        raise ValueError(f"the picture has (rows, columns) {image.counts.shape}, its camera {image.camera.size[::-1]}")
    body_from_camera = camera_pose(image.camera)
    return View(
        flat_fielded(image), image.camera.moved(body_from_camera.inv()), pose.world_from_body * body_from_camera
    )


def flat_fielded(image: DetectorImage) -> UInt16[np.ndarray, "rows columns"]:
    """Counts without the offset, as pixels would give them that all respond like the brightest.

    A lens passes a third less light in its corners: sums of absolute differences (Eq. 9) of the same ground, seen once
    in the middle and once near the border, would be least at another place. Over rendered rocks from 15 m a fifth of
    the points was wrong without this, and half a per cent with it.

    What a camera without shutter gathers while rows are cleared and shifted out is taken off before, as it is of other
    ground than the pixel's: at 10 ms it is half of the exposure's light in the last of the MER camera's 1,024 rows.
    """
    known = image.calibration
    response = np.maximum(known.flat_field, LEAST_RESPONSE).astype(np.float32)
    signal = image.counts - np.float32(known.offset_dn)
    signal = without_frame_transfer(signal, known, known.rows_summed).astype(np.float32, copy=False)
    return np.asarray(np.rint(np.clip(signal / response, 0.0, 65535.0)).astype(np.uint16))


def camera_pose(camera: CameraModel) -> RigidTransform:
    """The transform from the camera frame to the frame that the camera is given in."""
    axes = np.column_stack([camera.right, np.cross(camera.a, camera.right), camera.a])
    return rigid(Rotation.from_matrix(axes), np.array(camera.c))


def undistorted(camera: CameraModel, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Unit focal length coordinates of pixels; NaN where no ray reaches them, or none that goes forwards."""
    directions = camera.rays(pixels)[1]
    with np.errstate(divide="ignore", invalid="ignore"):
        places: Float[np.ndarray, "n 2"] = directions[:, :2] / directions[:, 2:]
    places[~(directions[:, 2] > 0.0)] = np.nan
    return places


def points_at(places: Float[np.ndarray, "n 2"], depths: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
    """Points (camera frame) of undistorted coordinates at depths (Eq. 6)."""
    return np.asarray(np.column_stack([places, np.ones(len(places))]) * depths[:, None])


def pixels_of(
    camera: CameraModel, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, "n"]]:
    """Pixels of points in the camera frame and whether they lie in the picture."""
    pixels, visible = camera.project(points)
    return pixels, visible & camera.in_frame(pixels)
