"""Flight interface: measurements, which are the only input of an algorithm, and commands: targets and drives.

Measurements contain no ground truth: camera models are calibrated ones, times are time tags, and attitudes and
altitudes contain measurement errors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar, TypeVar

import numpy as np
from jaxtyping import Float, UInt16
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import rigid_from_axes

Measurement = TypeVar("Measurement")


@dataclass(frozen=True)
class DetectorCalibration:
    """Calibration of a detector, determined before flight and used by the algorithms.

    - flat_field: relative response of each image pixel (maximum 1)
    - exposure_s: exposure time
    - transfer_row_s: time per physical row during the charge transfer to the storage area
    - clear_row_s: time per physical row while the detector is cleared before the exposure
    - rows_summed: number of physical rows that are summed on the chip into one image row
    - offset_dn: counts without light
    - full_scale_dn: maximum count (4095 for 12 bits)
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
    """An image as read out from a camera.

    Row 0 is next to the storage area and is shifted out first. The charge of row r passes the rows r-1, r-2, ... 0.

    - counts: detector counts, after summing on the chip
    - time_s: time tag of the middle of the exposure
    - camera: the calibrated camera model of this image, in the body frame
    """

    counts: UInt16[np.ndarray, "rows columns"]
    time_s: float
    camera: CameraModel
    calibration: DetectorCalibration


@dataclass(frozen=True)
class AttitudeMeasurement:
    """Attitude estimated on board: rotation from body axes to world axes, with its time tag."""

    world_from_body: Rotation
    time_s: float


@dataclass(frozen=True)
class AltitudeMeasurement:
    """Altitude above the ground with its time tag: range of a radar to the nearest ground; NaN without a reading."""

    altitude_m: float
    time_s: float


@dataclass(frozen=True)
class ImuIncrements:
    """Increments measured by an inertial unit.

    - times_s: time tags of the sample boundaries, non-decreasing; one more than samples
    - period_s: nominal time between boundaries
    - delta_angles_rad: rotation vectors from the body axes at the start of each interval to the body axes at its end
    - delta_velocities_m_s: integrals of specific force over each interval, body axes at the start of the interval
    """

    times_s: Float[np.ndarray, "m"]
    period_s: float
    delta_angles_rad: Float[np.ndarray, "n 3"]
    delta_velocities_m_s: Float[np.ndarray, "n 3"]

    def merge(self, tagged: Sequence[tuple[float, Measurement]]) -> list[ImuIncrements | Measurement]:
        """Merge with other measurements, each given with its time tag, into the order of their time tags.

        The increments before a measurement end with the first boundary that is not earlier than its tag. Measurements
        outside of the increments come before or after all of them.
        """
        first, last = 0, self.times_s.size - 1
        merged: list[ImuIncrements | Measurement] = []
        for tag, measurement in sorted(tagged, key=lambda item: item[0]):
            end = min(int(np.searchsorted(self.times_s, tag)), last)
            merged += [self._part(first, end)] if end > first else []
            merged.append(measurement)
            first = end
        return [*merged, self._part(first, last)] if last > first else merged

    def _part(self, first: int, last: int) -> ImuIncrements:
        """Return the increments between two boundaries."""
        angles, velocities = self.delta_angles_rad[first:last], self.delta_velocities_m_s[first:last]
        return ImuIncrements(self.times_s[first : last + 1], self.period_s, angles, velocities)


@dataclass(frozen=True)
class DescentFrame:
    """Measurements available to the lander's computer when one descent image is taken.

    Both velocities contain the same unknown error, which is the error of inertial navigation's initial velocity.

    - sun_direction: unit vector to the sun, world axes
    - inertial_velocity_m_s: inertial velocity of the camera at the image, world axes; None if not recorded
    - interval_velocity_m_s: mean inertial velocity since the previous image, world axes; None at the first image
    - gravity_m_s2: gravity of the site, along world -z; None without inertial increments
    """

    image: DetectorImage
    attitude: AttitudeMeasurement
    altitude: AltitudeMeasurement
    sun_direction: Float[np.ndarray, "3"]
    inertial_velocity_m_s: Float[np.ndarray, "3"] | None = None
    interval_velocity_m_s: Float[np.ndarray, "3"] | None = None
    gravity_m_s2: float | None = None


@dataclass(frozen=True)
class DescentMeasurements:
    """Measurements available to the lander's computer after the last descent image (DIMES takes three).

    - images, attitudes, altitudes: one of each per image, in the order of exposure
    - interval_velocities_m_s: mean inertial velocities of the camera between successive images, world axes. All
      contain the unknown error of the initial velocity of inertial navigation; only their differences are accurate
      (the paper's "biased IMU horizontal velocities")
    - sun_direction: unit vector to the sun, world axes
    - inertial_velocities_m_s: inertial velocities at the images, with the same error; None if not recorded
    - sun_directions: unit vectors to the sun at the images, if the sun moves between them (the field test's triples);
      None: `sun_direction` at all images
    - increments: inertial increments of a unit of the vision system, from before the first image to after the last
      image; None without this unit. Its errors are independent of those of the inertial velocities.
    - gravity_m_s2: gravity of the site, along world -z; None without increments
    """

    images: tuple[DetectorImage, ...]
    attitudes: tuple[AttitudeMeasurement, ...]
    altitudes: tuple[AltitudeMeasurement, ...]
    interval_velocities_m_s: Float[np.ndarray, "intervals 3"]
    sun_direction: Float[np.ndarray, "3"]
    inertial_velocities_m_s: Float[np.ndarray, "images 3"] | None = None
    increments: ImuIncrements | None = None
    gravity_m_s2: float | None = None
    sun_directions: Float[np.ndarray, "images 3"] | None = None
    #: Arguments of the method `start` of an algorithm that receives the measurements one by one.
    start_inputs: ClassVar[tuple[()]] = ()

    @property
    def tags_s(self) -> tuple[float, ...]:
        """Time tags of the images."""
        return tuple(image.time_s for image in self.images)

    @property
    def last_interval_s(self) -> tuple[float, float]:
        """Time tags of the last two images."""
        return self.images[-2].time_s, self.images[-1].time_s

    def suns(self) -> Float[np.ndarray, "images 3"]:
        """Return the unit vectors to the sun at the images, world axes."""
        if self.sun_directions is not None:
            return self.sun_directions
        return np.tile(self.sun_direction, (len(self.images), 1))

    def frames(self) -> tuple[DescentFrame, ...]:
        """Return the measurements of each image."""
        velocities, suns = self.inertial_velocities_m_s, self.suns()
        return tuple(
            DescentFrame(
                image=image,
                attitude=self.attitudes[number],
                altitude=self.altitudes[number],
                sun_direction=suns[number],
                inertial_velocity_m_s=None if velocities is None else velocities[number],
                interval_velocity_m_s=self.interval_velocities_m_s[number - 1] if number else None,
                gravity_m_s2=self.gravity_m_s2,
            )
            for number, image in enumerate(self.images)
        )

    def events(self) -> list[ImuIncrements | AltitudeMeasurement | DescentFrame]:
        """Return increments, altitudes and frames in the order of their time tags, up to the last image.

        The increments are split at each altitude and image (`ImuIncrements.merge`). Missing altitudes and altitudes
        before the first increment are omitted. Without increments, only the frames are returned.
        """
        frames = self.frames()
        if self.increments is None or not frames:
            return list(frames)
        start_s, end_s = float(self.increments.times_s[0]), frames[-1].image.time_s
        # several images can have the same reading of the altimeter
        readings = {reading.time_s: reading for reading in self.altitudes if not math.isnan(reading.altitude_m)}
        tagged: list[tuple[float, AltitudeMeasurement | DescentFrame]] = [
            *((tag, reading) for tag, reading in readings.items() if start_s <= tag <= end_s),
            *((frame.image.time_s, frame) for frame in frames),
        ]
        events = self.increments.merge(tagged)
        # increments after the last image
        return events[:-1] if isinstance(events[-1], ImuIncrements) else events

    def select(self, indices: tuple[int, ...]) -> DescentMeasurements:
        """Select images by ascending indices; the mean velocities are those between the selected images."""
        velocities = self.inertial_velocities_m_s
        mean_velocities = [self._mean_velocity(first, second) for first, second in pairwise(indices)]
        return replace(
            self,
            images=tuple(self.images[index] for index in indices),
            attitudes=tuple(self.attitudes[index] for index in indices),
            altitudes=tuple(self.altitudes[index] for index in indices),
            interval_velocities_m_s=np.array(mean_velocities, dtype=np.float64).reshape(-1, 3),
            inertial_velocities_m_s=None if velocities is None else velocities[list(indices)],
            sun_directions=None if self.sun_directions is None else self.sun_directions[list(indices)],
        )

    def _mean_velocity(self, first: int, second: int) -> Float[np.ndarray, "3"]:
        velocities = self.interval_velocities_m_s[first:second]
        if len(velocities) == 1:
            return np.asarray(velocities[0])
        return np.asarray(np.average(velocities, axis=0, weights=np.diff(self.tags_s[first : second + 1])))


@dataclass(frozen=True)
class MastGeometry:
    """Geometry of a pan-tilt mast, as surveyed before flight.

    The azimuth axis is parallel to the rover's z axis. The elevation axis is the y axis of the camera head. If both
    angles are zero, the head's axes are parallel to the rover's: x forward, y left, z up.

    - base_m: a point of the azimuth axis in the rover (body) frame
    - elbow_m: vector from the base to the elevation axis, in axes that rotate with the azimuth
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
        """Compute the pose of the head in the rover frame for these angles; the limits are not checked."""
        (sa, ca), (se, ce) = ((math.sin(angle), math.cos(angle)) for angle in (azimuth_rad, elevation_rad))
        pan = np.array([[ca, sa, 0.0], [-sa, ca, 0.0], [0.0, 0.0, 1.0]])
        rotation = pan @ np.array([[ce, 0.0, -se], [0.0, 1.0, 0.0], [se, 0.0, ce]])
        return rigid_from_axes(rotation, self.base_m + pan @ self.elbow_m + rotation @ self.head_m)


@dataclass(frozen=True)
class MastCalibration:
    """Mast geometry and the camera models of the stereo pair on its head, for full frames, in the head frame."""

    geometry: MastGeometry
    left: CameraModel
    right: CameraModel


@dataclass(frozen=True)
class MastImage:
    """A full frame or subframe of a mast camera; `corner` is the column and row of its upper left pixel."""

    counts: UInt16[np.ndarray, "rows columns"]
    corner: tuple[int, int] = (0, 0)


@dataclass(frozen=True)
class StereoMeasurement:
    """A stereo pair of the rover's navigation cameras, taken at one stop.

    - left, right: counts of both images
    - cameras: calibrated models of the left and the right camera in the rover frame, at the measured mast angles
    """

    left: UInt16[np.ndarray, "rows columns"]
    right: UInt16[np.ndarray, "rows columns"]
    cameras: tuple[CameraModel, CameraModel]


@dataclass(frozen=True)
class RoverMeasurements:
    """Measurements available to the rover's computer at a stop: a stereo pair of the mast cameras.

    - left, right: the images, taken at the same time
    - azimuth_rad, elevation_rad: angles of the mast measured by its encoders
    - world_from_rover: pose of the rover as estimated on board; exact at the start, later with slip and drift errors
    """

    left: MastImage
    right: MastImage
    mast: MastCalibration
    azimuth_rad: float
    elevation_rad: float
    world_from_rover: RigidTransform


@dataclass(frozen=True)
class DriveCommand:
    """A drive command: motion with constant velocity and turn rate over a path.

    Examples: ``(d, 0, 0)`` straight ahead, ``(-d, 0, 0)`` backward, ``(0, d, 0)`` sideways (crabbing), ``(0, 0, t)`` a
    turn in place, ``(d, 0, t)`` an arc of radius d / t, ``(0, -r * t, t)`` an arc about a point r straight ahead.

    - forward_m, left_m: path along the rover's x and y axes, which rotate with the rover
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
        """Displacement without slip, in the rover's axes at the start (forward, left)."""
        # chord of an arc: the path length times sin(t/2) / (t/2), rotated by t/2
        half_turn = 0.5 * self.turn_left_rad
        sine, cosine = np.sin(half_turn), np.cos(half_turn)
        path = np.array([[cosine, -sine], [sine, cosine]]) @ np.array([self.forward_m, self.left_m])
        return np.asarray(float(np.sinc(half_turn / np.pi)) * path)

    def part(self, fraction: float) -> DriveCommand:
        """Return the command for a fraction of this motion."""
        return DriveCommand(fraction * self.forward_m, fraction * self.left_m, fraction * self.turn_left_rad)


@dataclass(frozen=True)
class PixelTarget:
    """A target designated by a full-frame pixel (u, v) in an image of the left camera at the rover's current position.

    The angles are the mast's azimuth and elevation when the image was taken.
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

    - images: two overlapping images of the ground, in order of exposure, each with its camera in the body frame
    - poses: the on-board filter's pose at each image
    - slant_range_m: laser altimeter range at the first image, from the camera's centre along the optical axis to the
      ground; NaN without a return
    - up_body: unit vector upwards at the first image as measured by the inclinometers, body axes
    - apriori_site_world: landing site used if no better one is detected; world frame, metres
    """

    images: tuple[DetectorImage, DetectorImage]
    poses: tuple[PoseMeasurement, PoseMeasurement]
    slant_range_m: float
    up_body: Float[np.ndarray, "3"]
    apriori_site_world: Float[np.ndarray, "3"]
