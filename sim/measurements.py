"""What instruments deliver to flight software: the only thing that an algorithm is given; and what it asks of wheels.

Nothing here holds truth. Cameras are as calibrated, times are as tagged, attitudes and altitudes are as measured.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, UInt16
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import rigid_from_axes


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

    `world_from_body` rotates body axes into the local level world frame (see `marsyard.sim.frames`); `time_s` is its
    time tag.
    """

    world_from_body: Rotation
    time_s: float


@dataclass(frozen=True)
class AltitudeMeasurement:
    """Altitude above the ground, metres, and its time tag, seconds."""

    altitude_m: float
    time_s: float


@dataclass(frozen=True)
class DescentFrame:
    """What the lander's computer gets with one descent picture, and with nothing that comes after it.

    The inertial unit's increments come as its navigation has added them up: attitude and velocity at the picture, mean
    velocity since the one before. Both velocities carry the same unknown error of the navigation's initial velocity.

    Attributes
    ----------
    image, attitude, altitude
        The picture, with its camera in the body frame, and what was measured with it.
    sun_direction
        Unit vector to the sun, world axes.
    inertial_velocity_m_s
        Velocity of the camera at the picture's tag, world axes (east, north, up), m/s, shape (3,); None where it was
        not recorded.
    interval_velocity_m_s
        Mean velocity of the camera since the picture before, likewise; None with the first picture.
    """

    image: DetectorImage
    attitude: AttitudeMeasurement
    altitude: AltitudeMeasurement
    sun_direction: Float[np.ndarray, "3"]
    inertial_velocity_m_s: Float[np.ndarray, "3"] | None = None
    interval_velocity_m_s: Float[np.ndarray, "3"] | None = None


@dataclass(frozen=True)
class DescentMeasurements:
    """What the lander's computer holds when the last descent picture has arrived: the third, for DIMES.

    Attributes
    ----------
    images, attitudes, altitudes
        As many of each, in the order of exposure.
    interval_velocities_m_s
        Mean velocity of the camera over the intervals between pictures as the inertial navigation has it, world
        axes (east, north, up), m/s, one fewer than pictures, shape (n - 1, 3). All carry the same unknown error of the
        navigation's initial velocity; only their differences are accurate (the paper's "biased IMU horizontal
        velocities").
    sun_direction
        Unit vector to the sun, world axes.
    inertial_velocities_m_s
        Velocity at the pictures' tags, with the same error, shape (n, 3); None where it was not recorded.
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
        """The same picture by picture, as it came."""
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

    def chosen(self, places: tuple[int, ...]) -> DescentMeasurements:
        """Some of the pictures, by their places from 0 in ascending order, with the mean velocities between them."""
        at = self.inertial_velocities_m_s
        intervals = [self._mean_velocity(first, second) for first, second in pairwise(places)]
        return DescentMeasurements(
            images=tuple(self.images[place] for place in places),
            attitudes=tuple(self.attitudes[place] for place in places),
            altitudes=tuple(self.altitudes[place] for place in places),
            interval_velocities_m_s=np.array(intervals, dtype=np.float64).reshape(-1, 3),
            sun_direction=self.sun_direction,
            inertial_velocities_m_s=None if at is None else at[list(places)],
        )

    def _mean_velocity(self, first: int, second: int) -> Float[np.ndarray, "3"]:
        """Mean inertial velocity between two pictures."""
        between = self.interval_velocities_m_s[first:second]
        if len(between) == 1:
            return np.asarray(between[0])
        return np.asarray(np.average(between, axis=0, weights=np.diff(self.tags_s[first : second + 1])))


@dataclass(frozen=True)
class MastGeometry:
    """Where a mast of two axes carries its head, as surveyed before flight.

    The mast turns about the rover's z axis and, above that, about the head's y axis; roll it cannot. With both angles
    zero the head's axes are the rover's: x forward, y to the left, z up.

    Attributes
    ----------
    base_m
        A point of the azimuth axis in the rover (body) frame, metres, shape (3,).
    elbow_m
        From there to the elevation axis, in axes that turn with the azimuth, metres, shape (3,).
    head_m
        From there to the head frame's origin, in the head's own axes, metres, shape (3,).
    azimuth_limits_rad
        Least and largest azimuth, positive to the right (clockwise seen from above), radians.
    elevation_limits_rad
        Least and largest elevation, positive upwards, radians.
    """

    base_m: Float[np.ndarray, "3"]
    elbow_m: Float[np.ndarray, "3"]
    head_m: Float[np.ndarray, "3"]
    azimuth_limits_rad: tuple[float, float] = (-np.pi, np.pi)
    elevation_limits_rad: tuple[float, float] = (-0.5 * np.pi, 0.5 * np.pi)

    def rover_from_head(self, azimuth_rad: float, elevation_rad: float) -> RigidTransform:
        """The head's pose in the rover frame at these angles, within the limits or not."""
        (sa, ca), (se, ce) = ((math.sin(angle), math.cos(angle)) for angle in (azimuth_rad, elevation_rad))
        pan = np.array([[ca, sa, 0.0], [-sa, ca, 0.0], [0.0, 0.0, 1.0]])
        turn = pan @ np.array([[ce, 0.0, -se], [0.0, 1.0, 0.0], [se, 0.0, ce]])
        return rigid_from_axes(turn, self.base_m + pan @ self.elbow_m + turn @ self.head_m)


@dataclass(frozen=True)
class MastCalibration:
    """A mast and the stereo pair on its head, as calibrated.

    Attributes
    ----------
    geometry
        The mast.
    left, right
        Camera models of the full frames, in the head frame.
    """

    geometry: MastGeometry
    left: CameraModel
    right: CameraModel


@dataclass(frozen=True)
class MastImage:
    """A picture, or the part of it that was read out, of one camera on the mast.

    Attributes
    ----------
    counts
        Detector counts, shape (rows, columns).
    corner
        Column and row in the full frame of the upper left pixel.
    """

    counts: UInt16[np.ndarray, "rows columns"]
    corner: tuple[int, int] = (0, 0)


@dataclass(frozen=True)
class RoverMeasurements:
    """What the rover's computer holds when it has stopped, pointed its mast and taken a stereo pair.

    Attributes
    ----------
    left, right
        The pictures, taken together.
    mast
        The mast and its cameras as calibrated.
    azimuth_rad, elevation_rad
        The mast's angles as its encoders read them.
    world_from_rover
        Pose of the rover as estimated on board, in the local level world frame: right at the start by definition,
        wrong by slip and drift later.
    """

    left: MastImage
    right: MastImage
    mast: MastCalibration
    azimuth_rad: float
    elevation_rad: float
    world_from_rover: RigidTransform


@dataclass(frozen=True)
class DriveCommand:
    """A motion asked of a rover's wheels: a constant velocity and rate of turn, held until the motion is done.

    Straight ahead is ``(d, 0, 0)``, backward ``(-d, 0, 0)``, crabbing ``(0, d, 0)``, a turn in place ``(0, 0, t)``, an
    arc of radius d / t ``(d, 0, t)``; ``(0, -r * t, t)`` moves sideways around a point that stays r ahead.

    Attributes
    ----------
    forward_m, left_m
        Path along the rover's x and y axes, metres; both axes turn with the rover.
    turn_left_rad
        Turn about the rover's z axis, counterclockwise seen from above, radians.
    """

    forward_m: float = 0.0
    left_m: float = 0.0
    turn_left_rad: float = 0.0

    @property
    def length_m(self) -> float:
        """Length of the rover's path, metres."""
        return float(np.hypot(self.forward_m, self.left_m))

    @property
    def displacement_m(self) -> Float[np.ndarray, "2"]:
        """Where the motion ends, in the axes of its start (forward, left), metres, if the wheels do not slip."""
        # chord of an arc: the path, shortened by sin(t/2) / (t/2) and turned by t/2
        half = 0.5 * self.turn_left_rad
        shortened = float(np.sinc(half / np.pi))
        sine, cosine = np.sin(half), np.cos(half)
        path = np.array([[cosine, -sine], [sine, cosine]]) @ np.array([self.forward_m, self.left_m])
        return np.asarray(shortened * path)

    def part(self, share: float) -> DriveCommand:
        """The motion over a share of its time."""
        return DriveCommand(share * self.forward_m, share * self.left_m, share * self.turn_left_rad)


@dataclass(frozen=True)
class PixelTarget:
    """A target picked in a picture of the left camera from where the rover still stands.

    Attributes
    ----------
    pixel
        (u, v) in the full frame, shape (2,).
    azimuth_rad, elevation_rad
        The mast's angles when the picture was taken.
    """

    pixel: Float[np.ndarray, "2"]
    azimuth_rad: float
    elevation_rad: float


@dataclass(frozen=True)
class RoverTarget:
    """A target given in the rover frame (as it lies when the target is designated), metres, shape (3,)."""

    position_rover: Float[np.ndarray, "3"]


@dataclass(frozen=True)
class SiteTarget:
    """A target given in the site frame (north, east, down from the world's origin), metres, shape (3,)."""

    position_site: Float[np.ndarray, "3"]


#: The three ways in which the ground may name a target (tracking paper, section 3).
TargetDesignation = PixelTarget | RoverTarget | SiteTarget


@dataclass(frozen=True)
class PoseMeasurement:
    """Position and attitude as the on-board filter has them.

    Attributes
    ----------
    world_from_body
        The body's pose in the local level world frame, metres.
    time_s
        Its time tag, seconds.
    """

    world_from_body: RigidTransform
    time_s: float


@dataclass(frozen=True)
class LandingMeasurements:
    """What the helicopter's computer holds when it looks for a place to land.

    Attributes
    ----------
    images
        Two pictures of overlapping ground, the first and the second, each with its camera in the body frame.
    poses
        The on-board filter's pose at each picture.
    slant_range_m
        The laser altimeter's range at the first picture, metres: from its camera's centre along the camera's optical
        axis to the ground. NaN where nothing was returned.
    up_body
        Upwards at the first picture as the inclinometers have it, unit vector in body axes.
    apriori_site_world
        Where to land if no better place is known: a point in the world frame, metres.
    """

    images: tuple[DetectorImage, DetectorImage]
    poses: tuple[PoseMeasurement, PoseMeasurement]
    slant_range_m: float
    up_body: Float[np.ndarray, "3"]
    apriori_site_world: Float[np.ndarray, "3"]
