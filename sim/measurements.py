"""What instruments deliver to flight software: the only thing that an algorithm is given.

Nothing here holds truth. Cameras are as calibrated, times are as tagged, attitudes and altitudes are as measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt16
from scipy.spatial.transform import Rotation

from sim.camera import CameraModel


@dataclass(frozen=True)
class DetectorCalibration:
    """What the ground knows of an image detector before flight.

    Attributes
    ----------
    flat_field
        Relative response of each delivered pixel (1 at the brightest), shape (rows, columns) of the delivered image.
    exposure_s
        Exposure time, seconds.
    transfer_row_s
        Time a charge packet spends under each physical row while the picture is shifted out, seconds.
    clear_row_s
        Time a charge packet spends under each physical row while the detector is cleared before the exposure, seconds.
    rows_summed
        Physical rows summed on the chip into one delivered row.
    offset_dn
        Counts delivered for no light.
    full_scale_dn
        The largest count (4095 for 12 bits).
    """

    flat_field: Float[np.ndarray, "rows columns"]
    exposure_s: float
    transfer_row_s: float
    clear_row_s: float
    rows_summed: int
    offset_dn: float
    full_scale_dn: int


@dataclass(frozen=True)
class DetectorImage:
    """One picture as delivered by a camera.

    Row 0 is the row nearest to the storage area: it is shifted out first, and a packet of row r passes under the rows
    r-1, r-2, ... 0 on its way out.

    Attributes
    ----------
    counts
        Detector counts, shape (rows, columns) as delivered, after summing on the chip.
    time_s
        Time tag of the middle of the exposure, seconds.
    camera
        The calibrated camera model of the delivered picture (its size is that of `counts`), in the body frame.
    calibration
        The detector's calibration.
    """

    counts: UInt16[np.ndarray, "rows columns"]
    time_s: float
    camera: CameraModel
    calibration: DetectorCalibration


@dataclass(frozen=True)
class AttitudeMeasurement:
    """Attitude as propagated on board.

    `world_from_body` rotates body axes into the local level world frame (see `sim.frames`); `time_s` is its time tag.
    """

    world_from_body: Rotation
    time_s: float


@dataclass(frozen=True)
class AltitudeMeasurement:
    """Altitude above the ground, metres, and its time tag, seconds."""

    altitude_m: float
    time_s: float


@dataclass(frozen=True)
class DescentMeasurements:
    """What the lander's computer holds when the third descent picture has arrived.

    Attributes
    ----------
    images, attitudes, altitudes
        Three of each, in the order of exposure.
    interval_velocities_m_s
        Mean velocity of the camera over the two intervals between pictures as the inertial navigation has it, world
        axes (east, north, up), m/s, shape (2, 3). Both carry the same unknown error of the navigation's initial
        velocity; only their difference is accurate (the paper's "biased IMU horizontal velocities").
    sun_direction
        Unit vector to the sun, world axes.
    """

    images: tuple[DetectorImage, DetectorImage, DetectorImage]
    attitudes: tuple[AttitudeMeasurement, AttitudeMeasurement, AttitudeMeasurement]
    altitudes: tuple[AltitudeMeasurement, AltitudeMeasurement, AltitudeMeasurement]
    interval_velocities_m_s: Float[np.ndarray, "2 3"]
    sun_direction: Float[np.ndarray, "3"]
