"""Measurements: the only input of an algorithm; and commands to the wheels.

Nothing here is ground truth. Cameras are as calibrated, times as tagged, attitudes and altitudes as measured.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float, UInt16
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import rigid_from_axes


@dataclass(frozen=True)
class DetectorCalibration:
    """Calibration of an image detector before flight.

    - flat_field: relative response of each delivered pixel (1 at the brightest)
    - exposure_s: exposure time
    - transfer_row_s: time of a charge packet under each physical row during the transfer to the storage area
    - clear_row_s: time of a charge packet under each physical row during the clearing before the exposure
    - rows_summed: physical rows summed on the chip into one delivered row
    - offset_dn: counts without light
    - full_scale_dn: the largest count (4095 for 12 bits)
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
    """A picture as delivered by a camera.

    Row 0 is nearest to the storage area and is shifted out first. A packet of row r passes the rows r-1, r-2, ... 0.

    - counts: detector counts, after summing on the chip
    - time_s: time tag of the middle of the exposure
    - camera: the calibrated camera model of the delivered picture, in the body frame
    """

    counts: UInt16[np.ndarray, "rows columns"]
    time_s: float
    camera: CameraModel
    calibration: DetectorCalibration


@dataclass(frozen=True)
class AttitudeMeasurement:
    """Attitude as propagated on board: rotation from body axes to the world frame, with its time tag."""

    world_from_body: Rotation
    time_s: float


@dataclass(frozen=True)
class AltitudeMeasurement:
    """Altitude above the ground, with its time tag."""

    altitude_m: float
    time_s: float


@dataclass(frozen=True)
class DescentFrame:
    """Measurements available to the lander's computer at one descent picture; without later ones.

    Both velocities contain the same unknown error of the navigation's initial velocity.

    - sun_direction: unit vector to the sun, world axes
    - inertial_velocity_m_s: inertial velocity of the camera at the picture, world axes; None if not recorded
    - interval_velocity_m_s: mean inertial velocity since the previous picture, world axes; None at the first picture
    """

    image: DetectorImage
    attitude: AttitudeMeasurement
    altitude: AltitudeMeasurement
    sun_direction: Float[np.ndarray, "3"]
    inertial_velocity_m_s: Float[np.ndarray, "3"] | None = None
    interval_velocity_m_s: Float[np.ndarray, "3"] | None = None


@dataclass(frozen=True)
class DescentMeasurements:
    """Measurements available to the lander's computer at the last descent picture: the third, for DIMES.

    - images, attitudes, altitudes: as many of each, in the order of exposure
    - interval_velocities_m_s: mean inertial velocities of the camera between successive pictures, world axes. All
      contain the same unknown error of the navigation's initial velocity; only their differences are accurate (the
      paper's "biased IMU horizontal velocities")
    - sun_direction: unit vector to the sun, world axes
    - inertial_velocities_m_s: inertial velocities at the pictures, with the same error; None if not recorded
    """

    images: tuple[DetectorImage, ...]
    attitudes: tuple[AttitudeMeasurement, ...]
    altitudes: tuple[AltitudeMeasurement, ...]
    interval_velocities_m_s: Float[np.ndarray, "intervals 3"]
    sun_direction: Float[np.ndarray, "3"]
    inertial_velocities_m_s: Float[np.ndarray, "pictures 3"] | None = None

    @property
    def tags_s(self) -> tuple[float, ...]:
        """The pictures' time tags."""
        return tuple(image.time_s for image in self.images)

    @property
    def last_interval_s(self) -> tuple[float, float]:
        """Time tags of the last two pictures."""
        return self.images[-2].time_s, self.images[-1].time_s

    def frames(self) -> tuple[DescentFrame, ...]:
        """The same measurements, picture by picture."""
        at = self.inertial_velocities_m_s
        return tuple(
            DescentFrame(
                image=image,
                attitude=self.attitudes[number],
                altitude=self.altitudes[number],
                sun_direction=self.sun_direction,
                inertial_velocity_m_s=None if at is None else at[number],
                interval_velocity_m_s=self.interval_velocities_m_s[number - 1] if number else None,
            )
            for number, image in enumerate(self.images)
        )

    def select(self, indices: tuple[int, ...]) -> DescentMeasurements:
        """Select pictures by ascending indices, with the mean velocities between them."""
        at = self.inertial_velocities_m_s
        intervals = [self._mean_velocity(first, second) for first, second in pairwise(indices)]
        return replace(
            self,
            images=tuple(self.images[index] for index in indices),
            attitudes=tuple(self.attitudes[index] for index in indices),
            altitudes=tuple(self.altitudes[index] for index in indices),
            interval_velocities_m_s=np.array(intervals, dtype=np.float64).reshape(-1, 3),
            inertial_velocities_m_s=None if at is None else at[list(indices)],
        )

    def _mean_velocity(self, first: int, second: int) -> Float[np.ndarray, "3"]:
        between = self.interval_velocities_m_s[first:second]
        if len(between) == 1:
            return np.asarray(between[0])
        return np.asarray(np.average(between, axis=0, weights=np.diff(self.tags_s[first : second + 1])))


@dataclass(frozen=True)
class MastGeometry:
    """Geometry of a pan-tilt mast, as surveyed before flight.

    The azimuth axis is parallel to the rover's z axis; the elevation axis, above it, is the head's y axis. With both
    angles zero the head's axes are parallel to the rover's: x forward, y left, z up.

    - base_m: a point of the azimuth axis in the rover (body) frame
    - elbow_m: vector from the base to the elevation axis, in axes that turn with the azimuth
    - head_m: vector from the elevation axis to the head frame's origin, in the head's axes
    - azimuth_limits_rad: minimum and maximum azimuth, positive to the right (clockwise seen from above)
    - elevation_limits_rad: minimum and maximum elevation, positive upwards
    """

    base_m: Float[np.ndarray, "3"]
    elbow_m: Float[np.ndarray, "3"]
    head_m: Float[np.ndarray, "3"]
    azimuth_limits_rad: tuple[float, float] = (-np.pi, np.pi)
    elevation_limits_rad: tuple[float, float] = (-0.5 * np.pi, 0.5 * np.pi)

    def rover_from_head(self, azimuth_rad: float, elevation_rad: float) -> RigidTransform:
        """Pose of the head in the rover frame at these angles; the limits are not checked."""
        (sa, ca), (se, ce) = ((math.sin(angle), math.cos(angle)) for angle in (azimuth_rad, elevation_rad))
        pan = np.array([[ca, sa, 0.0], [-sa, ca, 0.0], [0.0, 0.0, 1.0]])
        turn = pan @ np.array([[ce, 0.0, -se], [0.0, 1.0, 0.0], [se, 0.0, ce]])
        return rigid_from_axes(turn, self.base_m + pan @ self.elbow_m + turn @ self.head_m)


@dataclass(frozen=True)
class MastCalibration:
    """A mast and the calibrated stereo pair on its head; camera models of the full frames, in the head frame."""

    geometry: MastGeometry
    left: CameraModel
    right: CameraModel


@dataclass(frozen=True)
class MastImage:
    """A full frame or subframe of a camera on the mast; `corner` is column and row of its upper left pixel."""

    counts: UInt16[np.ndarray, "rows columns"]
    corner: tuple[int, int] = (0, 0)


@dataclass(frozen=True)
class RoverMeasurements:
    """Measurements available to the rover's computer at a stop: a stereo pair taken from the pointed mast.

    - left, right: the pictures, taken at the same time
    - azimuth_rad, elevation_rad: the mast's angles as read by its encoders
    - world_from_rover: pose of the rover as estimated on board: exact at the start by definition, later with errors by
      slip and drift
    """

    left: MastImage
    right: MastImage
    mast: MastCalibration
    azimuth_rad: float
    elevation_rad: float
    world_from_rover: RigidTransform


@dataclass(frozen=True)
class DriveCommand:
    """A motion command to a rover's wheels: constant velocity and turn rate until the path is driven.

    Straight ahead is ``(d, 0, 0)``, backward ``(-d, 0, 0)``, crabbing ``(0, d, 0)``, a turn in place ``(0, 0, t)``, an
    arc of radius d / t ``(d, 0, t)``; ``(0, -r * t, t)`` moves sideways around a point that stays r ahead.

    - forward_m, left_m: path along the rover's x and y axes; both axes turn with the rover
    - turn_left_rad: turn about the rover's z axis, counterclockwise seen from above
    """

    forward_m: float = 0.0
    left_m: float = 0.0
    turn_left_rad: float = 0.0

    @property
    def length_m(self) -> float:
        """Length of the rover's path."""
        return float(np.hypot(self.forward_m, self.left_m))

    @property
    def displacement_m(self) -> Float[np.ndarray, "2"]:
        """End position without slip, in the rover's axes at the start (forward, left)."""
        # chord of an arc: the path, shortened by sin(t/2) / (t/2) and rotated by t/2
        half = 0.5 * self.turn_left_rad
        sine, cosine = np.sin(half), np.cos(half)
        path = np.array([[cosine, -sine], [sine, cosine]]) @ np.array([self.forward_m, self.left_m])
        return np.asarray(float(np.sinc(half / np.pi)) * path)

    def part(self, fraction: float) -> DriveCommand:
        """The motion over a fraction of its duration."""
        return DriveCommand(fraction * self.forward_m, fraction * self.left_m, fraction * self.turn_left_rad)


@dataclass(frozen=True)
class PixelTarget:
    """A target designated by a full-frame pixel (u, v) of the left camera, from the rover's current position.

    The angles are those of the mast when the picture was taken.
    """

    pixel: Float[np.ndarray, "2"]
    azimuth_rad: float
    elevation_rad: float


@dataclass(frozen=True)
class RoverTarget:
    """A target designated by its position in the rover frame at the time of designation, metres."""

    position_rover: Float[np.ndarray, "3"]


@dataclass(frozen=True)
class SiteTarget:
    """A target designated by its position in the site frame (north, east, down from the world's origin), metres."""

    position_site: Float[np.ndarray, "3"]


#: The three forms of target designation by ground operators (tracking paper, section 3).
TargetDesignation = PixelTarget | RoverTarget | SiteTarget


@dataclass(frozen=True)
class PoseMeasurement:
    """Pose of the body in the world frame as estimated by the on-board filter, with its time tag."""

    world_from_body: RigidTransform
    time_s: float


@dataclass(frozen=True)
class LandingMeasurements:
    """Measurements available to the helicopter's computer for the selection of a landing site.

    - images: two pictures of overlapping ground, in order, each with its camera in the body frame
    - poses: the on-board filter's pose at each picture
    - slant_range_m: laser altimeter range at the first picture, from its camera's centre along the optical axis to the
      ground; NaN without a return
    - up_body: unit vector upwards at the first picture as measured by the inclinometers, body axes
    - apriori_site_world: landing site used if no better one is detected: a point in the world frame, metres
    """

    images: tuple[DetectorImage, DetectorImage]
    poses: tuple[PoseMeasurement, PoseMeasurement]
    slant_range_m: float
    up_body: Float[np.ndarray, "3"]
    apriori_site_world: Float[np.ndarray, "3"]
