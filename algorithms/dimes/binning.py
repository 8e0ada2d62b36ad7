"""From delivered pictures to the binned views that DIMES works on (section II.A, first sentence)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DescentMeasurements, DetectorCalibration, DetectorImage

#: Heights outside of which nothing is tried: lower than the airbags are large, higher than the atmosphere.
HEIGHTS_M = (1.0, 1e6)
_PICTURES = 3


@dataclass(frozen=True)
class View:
    """One binned picture and where it was taken from.

    Attributes
    ----------
    signal
        Counts above the offset, averaged over the pixels binned by software, shape (rows, columns); not yet corrected.
    flat_field
        Relative response, binned likewise.
    camera
        Camera model of the binned picture in the view's ground frame: axes east, north, up; the ground is the plane
        z = 0 at the measured altitude below the body's origin, and the origin lies straight below the camera.
    centre
        The camera's place in that frame, metres: (0, 0, height).
    time_s
        Time tag of the middle of the exposure.
    calibration
        The detector's calibration.
    rows_summed
        Physical rows in one row of `signal`, on the chip and by software together.
    """

    signal: Float[np.ndarray, "rows columns"]
    flat_field: Float[np.ndarray, "rows columns"]
    camera: CameraModel
    centre: Float[np.ndarray, "3"]
    time_s: float
    calibration: DetectorCalibration
    rows_summed: int

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows of the binned picture."""
        return (self.signal.shape[1], self.signal.shape[0])


def bin_factors(shape: tuple[int, int], binned_size: tuple[int, int]) -> tuple[int, int]:
    """Columns and rows to average by software for a delivered picture of `shape` to get `binned_size` (columns, rows).

    Raises
    ------
    ValueError
        If the delivered picture is no whole multiple of the binned one.
    """
    rows, columns = shape
    if columns % binned_size[0] or rows % binned_size[1]:
        raise ValueError(
            f"a delivered picture of {columns} x {rows} pixels does not bin to {binned_size[0]} x {binned_size[1]}"
        )
    return columns // binned_size[0], rows // binned_size[1]


def bin_mean(
    image: Float[np.ndarray, "rows columns"], columns: int, rows: int
) -> Float[np.ndarray, "binned_rows binned_columns"]:
    """Averages over blocks of `columns` x `rows` pixels, which divide the image."""
    size = (image.shape[1] // columns, image.shape[0] // rows)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def placed_camera(
    camera: CameraModel, world_from_body: Rotation, altitude_m: float
) -> tuple[CameraModel, Float[np.ndarray, "3"]]:
    """A body's camera above the ground plane by attitude and altitude, in a view's ground frame, and its place there.

    The altitude is taken as that of the body's origin; the camera's own height follows from its place in the body.
    """
    lever = world_from_body.as_matrix() @ camera.c
    placed = rigid(world_from_body, np.array([-lever[0], -lever[1], altitude_m]))
    return camera.moved(placed), np.array([0.0, 0.0, altitude_m + lever[2]])


def view(
    image: DetectorImage,
    world_from_body: Rotation,
    altitude_m: float,
    binned_size: tuple[int, int],
    before: View | None = None,
) -> View:
    """The binned picture, with its camera placed above the ground plane by measured attitude and altitude.

    The view `before` lends its flat field where both have one calibration.
    """
    columns, rows = bin_factors(image.counts.shape, binned_size)
    known = image.calibration
    camera, centre = placed_camera(image.camera.binned(columns, rows), world_from_body, altitude_m)
    shared = before if before is not None and before.calibration is known else None
    return View(
        signal=bin_mean(image.counts.astype(np.float32), columns, rows) - np.float32(known.offset_dn),
        flat_field=bin_mean(known.flat_field, columns, rows) if shared is None else shared.flat_field,
        camera=camera,
        centre=centre,
        time_s=image.time_s,
        calibration=known,
        rows_summed=known.rows_summed * rows,
    )


def altitudes_at_images(measurements: DescentMeasurements) -> Float[np.ndarray, "pictures"]:
    """Measured altitudes carried from their own time tags to those of the pictures, metres.

    The vertical velocity is the inertial one: that of the first interval for the first picture, of the last for the
    last, and the mean of both neighbours for those between.
    """
    vertical = measurements.interval_velocities_m_s[:, 2]
    rates = np.concatenate([vertical[:1], 0.5 * (vertical[:-1] + vertical[1:]), vertical[-1:]])
    lags = np.array([i.time_s - a.time_s for i, a in zip(measurements.images, measurements.altitudes, strict=True)])
    return np.asarray(np.array([a.altitude_m for a in measurements.altitudes], dtype=np.float64) + rates * lags)


def usable_views(measurements: DescentMeasurements, binned_size: tuple[int, int]) -> tuple[View, View, View] | None:
    """The three binned pictures, each above its own ground plane.

    None where altitudes or times are not finite, the pictures do not follow each other, or a height is out of
    `HEIGHTS_M`.

    Raises
    ------
    ValueError
        Where there are not three of them.
    """
    if len(measurements.images) != _PICTURES:
        raise ValueError(f"{len(measurements.images)} pictures are given; this estimator takes {_PICTURES}")
    altitudes = altitudes_at_images(measurements)
    times = np.array([image.time_s for image in measurements.images])
    if not (np.all(np.isfinite(altitudes)) and np.all(np.isfinite(times)) and np.all(np.diff(times) > 0.0)):
        return None
    views: list[View] = []
    for image, attitude, altitude in zip(measurements.images, measurements.attitudes, altitudes, strict=True):
        before = views[-1] if views else None
        views.append(view(image, attitude.world_from_body, float(altitude), binned_size, before))
    first, second, third = views
    lowest, highest = HEIGHTS_M
    in_range = all(lowest <= one.centre[2] <= highest for one in views)
    return (first, second, third) if in_range else None
