"""Binning, rectification and correction of descent images for DIMES and its baselines.

The virtual camera looks straight down. Its pixels are squares of ground, `gsd_m` on a side, in the plane at the
measured altitude; rows run south and columns east. Both views of a pair are rectified to the same virtual camera,
assuming no horizontal motion. A patch is identified by the ground point at its centre, east and north of the camera's
nadir point. The paper (Johnson et al., "Field Testing of the MER DIMES", section II.A) uses a homography. This module
can also project each point with the full camera model. It interpolates between pixels by a cubic spline.

Dark current is not corrected, as in the paper. It is a ramp along the columns. Over the 31 rows of a template it is
0.05 counts at -34 deg C (flight) and 2.5 counts at 0 deg C (field test). Both are below a pixel's noise of 6 counts and
do not affect velocities, even over terrain of 2 % contrast. At +23 deg C the ramp is 36 counts: over terrain of 2 %
contrast few tracks are valid and no velocity is reported; over terrain of 15 % contrast errors double to 0.07 m/s.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.spatial.transform import Rotation

from marsyard.algorithms.arrays import Flags, Points2, Raster, Vector2, Vector3
from marsyard.algorithms.image.frame_transfer import remove_frame_transfer
from marsyard.algorithms.image.kernels import cubic as kernels
from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DescentMeasurements, DetectorCalibration, DetectorImage

#: Range of usable camera heights above the ground: from the size of the airbags to above the atmosphere.
HEIGHT_RANGE_M = (1.0, 1e6)
#: Number of images of a descent.
_IMAGE_COUNT = 3


@dataclass(frozen=True)
class BinnedView:
    """One binned image, and its camera's position above the ground plane.

    - signal: Counts above the offset, averaged over the pixels binned by software; not corrected
    - flat_field: Relative response, binned in the same way
    - camera: Camera model of the binned image in the view's ground frame: axes east, north, up; the ground is the plane
      z = 0 at the measured altitude below the body's origin, and the origin is the camera's nadir point
    - centre: The camera's position in that frame, metres: (0, 0, height)
    - time_s: Time tag at mid-exposure
    - calibration: Calibration of the detector, for the corrections of `correct_patch`
    - rows_summed: Physical rows in one row of `signal`, binned on the chip and by software
    """

    signal: Raster
    flat_field: Raster
    camera: CameraModel
    centre: Vector3
    time_s: float
    calibration: DetectorCalibration
    rows_summed: int

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows of the binned image."""
        return (self.signal.shape[1], self.signal.shape[0])


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
    for image, attitude, altitude in zip(measurements.images, measurements.attitudes, altitudes, strict=True):
        previous = views[-1] if views else None
        views.append(build_view(image, attitude.world_from_body, float(altitude), binned_size, previous))
    in_range = all(HEIGHT_RANGE_M[0] <= view.centre[2] <= HEIGHT_RANGE_M[1] for view in views)
    return (views[0], views[1], views[2]) if in_range else None


def ground_from_pixels(view: BinnedView, pixels: Points2, max_off_nadir_rad: float) -> tuple[Points2, Flags]:
    """Intersect the rays of pixels (u, v) with the ground: (east, north) in the ground frame, metres.

    A ray farther from the nadir than `max_off_nadir_rad` is replaced by the ray at that angle with the same azimuth.
    This bounds the outline of an image with a horizon. The mask is true for unchanged rays.
    """
    origins, directions = view.camera.rays(pixels)
    horizontal = np.hypot(directions[:, 0], directions[:, 1])
    max_slope = np.tan(max_off_nadir_rad)
    down = -directions[:, 2]
    within_limit = (down > 0.0) & (horizontal <= max_slope * down)
    slope = np.where(within_limit, horizontal / np.where(within_limit, down, 1.0), max_slope)
    azimuths = directions[:, :2] / np.maximum(horizontal, np.finfo(np.float64).tiny)[:, None]
    return origins[:, :2] + (origins[:, 2] * slope)[:, None] * azimuths, within_limit


def pixels_from_ground(
    view: BinnedView, ground: Float[np.ndarray, "*shape 2"]
) -> tuple[Float[np.ndarray, "*shape 2"], Bool[np.ndarray, "*shape"]]:
    """Project ground points (east, north) to pixels (u, v), also outside the frame; False where projection fails."""
    points = np.zeros((*ground.shape[:-1], 3))
    points[..., :2] = ground
    pixels, visible = view.camera.project(points)
    return pixels, visible


def inside_frame(
    view: BinnedView, ground: Float[np.ndarray, "*shape 2"], border_px: float, max_off_nadir_rad: float
) -> Bool[np.ndarray, "*shape"]:
    """Whether ground points lie at least `border_px` inside the image and within the off-nadir limit; False for NaN."""
    pixels, visible = pixels_from_ground(view, ground)
    in_frame = ((pixels >= border_px) & (pixels <= np.array(view.size) - 1 - border_px)).all(axis=-1)
    off_nadir = np.hypot(ground[..., 0], ground[..., 1]) / view.centre[2]
    return np.asarray(visible & in_frame & (off_nadir <= np.tan(max_off_nadir_rad)))


def square_lattice(half_m: float, per_side: int) -> Points2:
    """Lattice of `per_side` x `per_side` points (east, north) over a square of half side `half_m`."""
    steps = np.linspace(-half_m, half_m, per_side)
    east, north = np.meshgrid(steps, steps)
    return np.column_stack([east.ravel(), north.ravel()])


def square_outline(half_m: float, per_side: int) -> Points2:
    """Points of `square_lattice` on the outline of the square."""
    points = square_lattice(half_m, per_side)
    return np.asarray(points[np.abs(points).max(axis=1) == half_m])


#: Lower limit of the flat field before division.
MIN_RESPONSE = 0.02


def correct_patch(view: BinnedView, rows: slice, columns: slice) -> Float[np.ndarray, "_ _"]:
    """Correct part of a view for the frame-transfer smear and the flat field, counts, float64."""
    exposure_signal = remove_frame_transfer(view.signal[:, columns], view.calibration, view.rows_summed)
    return np.asarray(exposure_signal[rows] / np.maximum(view.flat_field[rows, columns], MIN_RESPONSE))


#: Margin of the spline around a patch, pixels. The influence of a pixel decreases by 2 - sqrt(3) = 0.268 per pixel:
#: pixels outside the margin change the result by about 1e-6 of their value.
SPLINE_MARGIN = 10


def ground_lattice(centre: Vector2, side_px: int, gsd_m: float) -> Float[np.ndarray, "side side 2"]:
    """Ground points (east, north) of the pixels of a square patch around `centre`, metres."""
    steps = (np.arange(side_px) - 0.5 * (side_px - 1)) * gsd_m
    lattice = np.empty((side_px, side_px, 2))
    lattice[..., 0] = centre[0] + steps
    lattice[..., 1] = (centre[1] - steps)[:, np.newaxis]
    return lattice


def _pixel_range(smallest: float, largest: float, size: int) -> slice:
    """Slice of whole pixels from `smallest` to `largest` with the spline's margin, clipped to 0 .. size."""
    low, high = max(int(smallest - SPLINE_MARGIN), 0), min(int(largest + SPLINE_MARGIN + 1), size)
    return slice(min(low, size - 1), max(high, 1))


def homography_lattice(
    view: BinnedView, lattice: Float[np.ndarray, "side side 2"]
) -> tuple[Float[np.ndarray, "side side 2"], Bool[np.ndarray, "side side"]]:
    """Map a lattice of ground points to pixels by the homography of its corners, which are projected exactly.

    Returns pixels and visibility like `pixels_from_ground`; if one corner is invisible, all points are.
    """
    corners, visible = pixels_from_ground(view, lattice[[0, 0, -1, -1], [0, -1, 0, -1]])
    flags = np.full(lattice.shape[:2], bool(visible.all()))
    if not visible.all():
        return np.zeros(lattice.shape), flags
    last = lattice.shape[0] - 1.0
    square = np.array([[0.0, 0.0], [last, 0.0], [0.0, last], [last, last]], dtype=np.float32)
    homography = cv2.getPerspectiveTransform(square, corners.astype(np.float32))
    steps = np.arange(lattice.shape[0], dtype=np.float64)
    positions = np.stack(np.meshgrid(steps, steps), axis=-1)
    return cv2.perspectiveTransform(positions, homography), flags


def rectify_patch(
    view: BinnedView, centre: Vector2, side_px: int, gsd_m: float, *, full_camera: bool = True
) -> Float[np.ndarray, "side side"]:
    """Rectify and correct a patch of `side_px` pixels around the ground point `centre` (east, north), counts.

    Each pixel is projected with the full camera model, or mapped by the homography of the patch's corners.
    Points outside the image get the value of the nearest border pixel. Points that the camera model cannot project get
    the value of the image's upper left pixel. Template candidates contain no such points.
    """
    lattice = ground_lattice(centre, side_px, gsd_m)
    pixels, visible = pixels_from_ground(view, lattice) if full_camera else homography_lattice(view, lattice)
    columns, rows = view.size
    left, right, top, bottom = kernels.clamp(pixels, visible, columns, rows)
    row_range, column_range = _pixel_range(top, bottom, rows), _pixel_range(left, right, columns)
    patch = correct_patch(view, row_range, column_range)
    coefficients = ndimage.spline_filter(patch, order=3, mode="mirror")
    values = np.empty((side_px, side_px))
    kernels.sample(coefficients, pixels, row_range.start, column_range.start, values)
    return values
