"""Binned images above their ground planes, and their rectified and corrected patches (section II.A).

The virtual camera looks straight down. Its pixels are squares of ground, `gsd_m` on a side, in the plane at the
measured altitude; rows run south and columns east. Both views of a pair are rectified to the same virtual camera,
assuming no horizontal motion: a patch is identified by the ground point in its middle, east and north of the camera's
nadir point. The paper uses a homography; here each point passes through the full camera model, with a cubic spline
between pixels.

Dark current is not corrected, as in the paper. It is a ramp along the columns: over the 31 rows of a template 0.05
counts at -34 deg C (flight) and 2.5 counts at 0 deg C (field test), below a pixel's noise of 6 and without effect on
velocities even over terrain of 2 % contrast. At +23 deg C it is 36 counts: over terrain of 2 % contrast few tracks are
valid and no velocity is reported; over terrain of 15 % contrast errors double to 0.07 m/s.
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

#: Range of usable heights: from the size of the airbags to above the atmosphere.
HEIGHTS_M = (1.0, 1e6)
_IMAGE_COUNT = 3


@dataclass(frozen=True)
class View:
    """One binned image above its ground plane.

    - signal: Counts above the offset, averaged over the pixels binned by software; not yet corrected
    - flat_field: Relative response, binned likewise
    - camera: Camera model of the binned image in the view's ground frame: axes east, north, up; the ground is the plane
      z = 0 at the measured altitude below the body's origin, and the origin is the camera's nadir point
    - centre: The camera's position in that frame, metres: (0, 0, height)
    - time_s: Time tag of the middle of the exposure
    - rows_summed: Physical rows in one row of `signal`, on the chip and by software together
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
        raise ValueError(f"a delivered picture of {columns} x {rows} pixels does not bin to {binned}")
    return columns // binned_size[0], rows // binned_size[1]


def bin_mean(image: Raster, columns: int, rows: int) -> Float[np.ndarray, "binned_rows binned_columns"]:
    """Averages over blocks of `columns` x `rows` pixels, which divide the image."""
    size = (image.shape[1] // columns, image.shape[0] // rows)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def place_camera(camera: CameraModel, world_from_body: Rotation, altitude_m: float) -> tuple[CameraModel, Vector3]:
    """A body's camera in a view's ground frame by attitude and altitude, and its position there.

    The altitude is that of the body's origin; the camera's height follows from its lever arm.
    """
    lever = world_from_body.as_matrix() @ camera.c
    camera_pose = rigid(world_from_body, np.array([-lever[0], -lever[1], altitude_m]))
    return camera.transform(camera_pose), np.array([0.0, 0.0, altitude_m + lever[2]])


def build_view(
    image: DetectorImage,
    world_from_body: Rotation,
    altitude_m: float,
    binned_size: tuple[int, int],
    before: View | None = None,
) -> View:
    """The binned image with its camera above the ground plane; the flat field of `before` is shared if its calibration
    is.
    """
    columns, rows = bin_factors(image.counts.shape, binned_size)
    detector = image.calibration
    camera, centre = place_camera(image.camera.bin(columns, rows), world_from_body, altitude_m)
    shared = before.flat_field if before is not None and before.calibration is detector else None
    return View(
        signal=bin_mean(image.counts.astype(np.float32), columns, rows) - np.float32(detector.offset_dn),
        flat_field=bin_mean(detector.flat_field, columns, rows) if shared is None else shared,
        camera=camera,
        centre=centre,
        time_s=image.time_s,
        calibration=detector,
        rows_summed=detector.rows_summed * rows,
    )


def altitudes_at_images(measurements: DescentMeasurements) -> Float[np.ndarray, "pictures"]:
    """Measured altitudes propagated from their own time tags to those of the images, metres.

    The vertical velocity is inertial: that of the first and of the last interval for the first and last image, the mean
    of both neighbours between.
    """
    vertical = measurements.interval_velocities_m_s[:, 2]
    rates = np.concatenate([vertical[:1], 0.5 * (vertical[:-1] + vertical[1:]), vertical[-1:]])
    lags = np.array([i.time_s - a.time_s for i, a in zip(measurements.images, measurements.altitudes, strict=True)])
    return np.asarray(np.array([a.altitude_m for a in measurements.altitudes], dtype=np.float64) + rates * lags)


def usable_views(measurements: DescentMeasurements, binned_size: tuple[int, int]) -> tuple[View, View, View] | None:
    """The three binned images, each above its own ground plane.

    None if altitudes or times are not finite, times do not increase, or a height is outside `HEIGHTS_M`. Raises
    ValueError unless there are three images.
    """
    if len(measurements.images) != _IMAGE_COUNT:
        raise ValueError(f"{len(measurements.images)} pictures are given; this estimator takes {_IMAGE_COUNT}")
    altitudes = altitudes_at_images(measurements)
    times = np.array([image.time_s for image in measurements.images])
    if not (np.all(np.isfinite(altitudes)) and np.all(np.isfinite(times)) and np.all(np.diff(times) > 0.0)):
        return None
    views: list[View] = []
    for image, attitude, altitude in zip(measurements.images, measurements.attitudes, altitudes, strict=True):
        before = views[-1] if views else None
        views.append(build_view(image, attitude.world_from_body, float(altitude), binned_size, before))
    in_range = all(HEIGHTS_M[0] <= one.centre[2] <= HEIGHTS_M[1] for one in views)
    return (views[0], views[1], views[2]) if in_range else None


def ground_from_pixels(view: View, pixels: Points2, max_off_nadir_rad: float) -> tuple[Points2, Flags]:
    """Intersections of the rays of pixels (u, v) with the ground: (east, north) in the ground frame, metres.

    A ray further from the nadir than `max_off_nadir_rad` is bent down to that angle in its azimuth, which bounds the
    outline of an image with a horizon; the mask is true for the other rays.
    """
    origins, directions = view.camera.rays(pixels)
    horizontal = np.hypot(directions[:, 0], directions[:, 1])
    steepest = np.tan(max_off_nadir_rad)
    down = -directions[:, 2]
    near = (down > 0.0) & (horizontal <= steepest * down)
    slope = np.where(near, horizontal / np.where(near, down, 1.0), steepest)
    azimuths = directions[:, :2] / np.maximum(horizontal, np.finfo(np.float64).tiny)[:, None]
    return origins[:, :2] + (origins[:, 2] * slope)[:, None] * azimuths, near


def pixels_from_ground(
    view: View, ground: Float[np.ndarray, "*shape 2"]
) -> tuple[Float[np.ndarray, "*shape 2"], Bool[np.ndarray, "*shape"]]:
    """Pixels (u, v) of ground points (east, north), and whether the optics can image them (in frame or not)."""
    points = np.zeros((*ground.shape[:-1], 3))
    points[..., :2] = ground
    pixels, visible = view.camera.project(points)
    return pixels, visible


def inside_frame(
    view: View, ground: Float[np.ndarray, "*shape 2"], border_px: float, max_off_nadir_rad: float
) -> Bool[np.ndarray, "*shape"]:
    """Whether ground points lie at least `border_px` inside the image and within the off-nadir limit; False for NaN."""
    pixels, visible = pixels_from_ground(view, ground)
    in_frame = ((pixels >= border_px) & (pixels <= np.array(view.size) - 1 - border_px)).all(axis=-1)
    off_nadir = np.hypot(ground[..., 0], ground[..., 1]) / view.centre[2]
    return np.asarray(visible & in_frame & (off_nadir <= np.tan(max_off_nadir_rad)))


def pixel_angle_rad(view: View) -> float:
    """Mean angle of one pixel along columns and rows in the middle of the image."""
    middle = (np.array(view.size) - 1) / 2.0
    _, directions = view.camera.rays(middle + np.array([[-0.5, 0.0], [0.5, 0.0], [0.0, -0.5], [0.0, 0.5]]))
    return float(np.linalg.norm(directions[[1, 3]] - directions[[0, 2]], axis=1).mean())


def square(half_m: float, per_side: int) -> Points2:
    """A lattice of `per_side` x `per_side` points (east, north) over a square of half side `half_m`."""
    steps = np.linspace(-half_m, half_m, per_side)
    east, north = np.meshgrid(steps, steps)
    return np.column_stack([east.ravel(), north.ravel()])


def square_outline(half_m: float, per_side: int) -> Points2:
    """The points of `square` on its outline."""
    points = square(half_m, per_side)
    return np.asarray(points[np.abs(points).max(axis=1) == half_m])


#: Minimum response for the division.
MIN_RESPONSE = 0.02


def correct_patch(view: View, rows: slice, columns: slice) -> Float[np.ndarray, "_ _"]:
    """Part of the view without frame-transfer ramp and fall-off, counts, float64."""
    exposed = remove_frame_transfer(view.signal[:, columns], view.calibration, view.rows_summed)
    return np.asarray(exposed[rows] / np.maximum(view.flat_field[rows, columns], MIN_RESPONSE))


#: Margin of pixels for the spline coefficients; pixels beyond change them by 1e-6.
SPLINE_MARGIN = 10


def ground_lattice(centre: Vector2, side_px: int, gsd_m: float) -> Float[np.ndarray, "side side 2"]:
    """Ground points (east, north) of the pixels of a square patch about `centre`, metres."""
    steps = (np.arange(side_px) - 0.5 * (side_px - 1)) * gsd_m
    lattice = np.empty((side_px, side_px, 2))
    lattice[..., 0] = centre[0] + steps
    lattice[..., 1] = (centre[1] - steps)[:, np.newaxis]
    return lattice


def _pixel_range(smallest: float, largest: float, size: int) -> slice:
    """Whole pixels around values from `smallest` to `largest`, with the spline's margin, within 0 .. size."""
    low, high = max(int(smallest - SPLINE_MARGIN), 0), min(int(largest + SPLINE_MARGIN + 1), size)
    return slice(min(low, size - 1), max(high, 1))


def rectify_patch(view: View, centre: Vector2, side_px: int, gsd_m: float) -> Float[np.ndarray, "side side"]:
    """The corrected patch of `side_px` pixels about the ground point `centre` (east, north), counts.

    Points outside the image take its border value, invisible points that of the upper left corner; candidates exclude
    both.
    """
    pixels, visible = pixels_from_ground(view, ground_lattice(centre, side_px, gsd_m))
    columns, rows = view.size
    left, right, top, bottom = kernels.hold(pixels, visible, columns, rows)
    in_rows, in_columns = _pixel_range(top, bottom, rows), _pixel_range(left, right, columns)
    patch = correct_patch(view, in_rows, in_columns)
    coefficients = ndimage.spline_filter(patch, order=3, mode="mirror")
    values = np.empty((side_px, side_px))
    kernels.sample(coefficients, pixels, in_rows.start, in_columns.start, values)
    return values
