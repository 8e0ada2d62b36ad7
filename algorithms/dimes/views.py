"""Binned descent images with their cameras above the ground plane, for DIMES and its baselines."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from marsyard.algorithms.arrays import Raster, Vector3
from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DescentMeasurements, DetectorCalibration, DetectorImage

#: Range of usable camera heights above the ground: from the size of the airbags to above the atmosphere.
HEIGHT_RANGE_M = (1.0, 1e6)
#: Number of images of a descent.
_IMAGE_COUNT = 3


def bin_factors(shape: tuple[int, int], binned_size: tuple[int, int]) -> tuple[int, int]:
    """Software binning factors (columns, rows) from a delivered image of `shape` to `binned_size` (columns, rows).

    Raises ValueError if the delivered size is not a multiple of the binned size.
    """
    rows, columns = shape
    if columns % binned_size[0] or rows % binned_size[1]:
        binned = f"{binned_size[0]} x {binned_size[1]}"
        raise ValueError(f"an image of {columns} x {rows} pixels cannot be binned to {binned} pixels")
    return columns // binned_size[0], rows // binned_size[1]


def check_binning(binned_size: tuple[int, int], delivered_size: tuple[int, int]) -> None:
    """Raise ValueError if DIMES cannot bin a delivered image to this size; both are (columns, rows)."""
    if delivered_size[0] % binned_size[0] or delivered_size[1] % binned_size[1]:
        raise ValueError(
            f"dimes.binned_size {list(binned_size)} does not divide the delivered image of {delivered_size[0]} x "
            f"{delivered_size[1]} pixels; allowed: sizes that do, such as {list(binned_size_for(*delivered_size))}"
        )


def binned_size_for(columns: int, rows: int) -> tuple[int, int]:
    """Return a binned size for DIMES: square bins, and the smallest possible width of at least 256 columns."""
    candidates = range(1, max(columns // 256, 1) + 1)
    factors = [factor for factor in candidates if columns % factor == 0 and rows % factor == 0]
    return columns // factors[-1], rows // factors[-1]


def bin_mean(image: Raster, columns: int, rows: int) -> Float[np.ndarray, "binned_rows binned_columns"]:
    """Average blocks of `columns` x `rows` pixels; the image size must be a multiple of the block size."""
    size = (image.shape[1] // columns, image.shape[0] // rows)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


@dataclass(frozen=True)
class BinnedView:
    """One binned image, and its camera's position above the ground plane.

    - signal: Counts above the offset, averaged over the pixels binned by software; not corrected
    - flat_field: Relative response, binned in the same way
    - camera: Camera model of the binned image in the view's ground frame: axes east, north, up; the ground is the plane
      z = 0 at the measured altitude below the body's origin, and the origin is the camera's nadir point
    - centre: The camera's position in that frame, metres: (0, 0, height)
    - sun_direction: Vector to the sun at the image, world axes
    - time_s: Time tag at mid-exposure
    - calibration: Calibration of the detector, for the corrections of `correct_patch`
    - rows_summed: Physical rows in one row of `signal`, binned on the chip and by software
    """

    signal: Raster
    flat_field: Raster
    camera: CameraModel
    centre: Vector3
    sun_direction: Vector3
    time_s: float
    calibration: DetectorCalibration
    rows_summed: int

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows of the binned image."""
        return (self.signal.shape[1], self.signal.shape[0])


def place_camera(camera: CameraModel, world_from_body: Rotation, altitude_m: float) -> tuple[CameraModel, Vector3]:
    """Transform a camera from the body frame to a view's ground frame; return it and its position.

    The altitude is that of the body's origin; the camera's height follows from its lever arm.
    """
    lever_arm = world_from_body.as_matrix() @ camera.c
    camera_pose = rigid(world_from_body, np.array([-lever_arm[0], -lever_arm[1], altitude_m]))
    return camera.transform(camera_pose), np.array([0.0, 0.0, altitude_m + lever_arm[2]])


def build_view(
    image: DetectorImage,
    world_from_body: Rotation,
    altitude_m: float,
    sun_direction: Vector3,
    binned_size: tuple[int, int],
    previous: BinnedView | None = None,
) -> BinnedView:
    """Bin an image and place its camera above the ground; with the calibration of `previous`, reuse its flat field."""
    columns, rows = bin_factors(image.counts.shape, binned_size)
    detector = image.calibration
    camera, centre = place_camera(image.camera.bin(columns, rows), world_from_body, altitude_m)
    shared_flat_field = previous.flat_field if previous is not None and previous.calibration is detector else None
    return BinnedView(
        signal=bin_mean(image.counts.astype(np.float32), columns, rows) - np.float32(detector.offset_dn),
        flat_field=bin_mean(detector.flat_field, columns, rows) if shared_flat_field is None else shared_flat_field,
        camera=camera,
        centre=centre,
        sun_direction=sun_direction,
        time_s=image.time_s,
        calibration=detector,
        rows_summed=detector.rows_summed * rows,
    )


def altitudes_at_images(measurements: DescentMeasurements) -> Float[np.ndarray, "images"]:
    """Propagate measured altitudes (metres) from their own time tags to the images' time tags.

    The vertical velocity is that of the IMU: for the first and the last image, of the first and the last interval; for
    an image between them, the mean of both adjacent intervals.
    """
    vertical = measurements.interval_velocities_m_s[:, 2]
    rates = np.concatenate([vertical[:1], 0.5 * (vertical[:-1] + vertical[1:]), vertical[-1:]])
    image_times_s = np.array([image.time_s for image in measurements.images])
    altitudes_m = np.array([altitude.altitude_m for altitude in measurements.altitudes], dtype=np.float64)
    altitude_times_s = np.array([altitude.time_s for altitude in measurements.altitudes])
    return np.asarray(altitudes_m + rates * (image_times_s - altitude_times_s))


def build_views(
    measurements: DescentMeasurements, binned_size: tuple[int, int]
) -> tuple[BinnedView, BinnedView, BinnedView] | None:
    """Build the views of the three images, each above its own ground plane.

    None if altitudes or times are not finite, times do not increase, or a height is outside `HEIGHT_RANGE_M`. Raises
    ValueError unless there are three images.
    """
    if len(measurements.images) != _IMAGE_COUNT:
        raise ValueError(f"{len(measurements.images)} images are given; this estimator requires {_IMAGE_COUNT}")
    altitudes = altitudes_at_images(measurements)
    times = np.array([image.time_s for image in measurements.images])
    if not (np.all(np.isfinite(altitudes)) and np.all(np.isfinite(times)) and np.all(np.diff(times) > 0.0)):
        return None
    views: list[BinnedView] = []
    per_image = zip(measurements.images, measurements.attitudes, altitudes, measurements.suns(), strict=True)
    for image, attitude, altitude, sun in per_image:
        previous = views[-1] if views else None
        views.append(build_view(image, attitude.world_from_body, float(altitude), sun, binned_size, previous))
    in_range = all(HEIGHT_RANGE_M[0] <= view.centre[2] <= HEIGHT_RANGE_M[1] for view in views)
    return (views[0], views[1], views[2]) if in_range else None
