"""The protocols that algorithms under test implement, and the answers they give."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform

from marsyard.sim.measurements import (
    DescentFrame,
    DescentMeasurements,
    LandingMeasurements,
    MastCalibration,
    RoverMeasurements,
    TargetDesignation,
)


class VelocityOutcome(Enum):
    """How a velocity estimation ended. Every member but VALID is an expected failure: no velocity is reported."""

    VALID = "a velocity is reported"
    NO_TEMPLATE_AREA = "no place in an image pair has room for a template and its search window"
    NO_VALID_TRACK = "in an image pair no template passed the validity checks"
    IMU_MISMATCH = "no combination of tracks agrees with the change of velocity measured by the IMU"


@dataclass(frozen=True)
class VelocityEstimate:
    """An answer to "how fast does the lander move over the ground".

    - outcome: How the estimation ended
    - velocity_m_s: Horizontal velocity (east, north) in m/s: the mean velocity of the camera over `span_s`; None unless
      the outcome is VALID
    - details: The algorithm's intermediate products for figures and diagnosis; None where it keeps none
    - covariance_m2_s2: Covariance of the velocity's error as the algorithm has it, (east, north), m2/s2; None where it
      states none. Errors are then held against it as well.
    - span_s: Begin and end of what the velocity is the mean of, as time tags, from the first picture's to the last
      one's that the algorithm has; equal ones mean the velocity at that instant. None: the last interval, which is from
      the second to the third picture where there are three.
    - after_pictures: Of a stream (`VelocityStream`) what it answered after each picture, None where nothing; filled in
      by whoever runs it. Empty of others.
    """

    outcome: VelocityOutcome
    velocity_m_s: Float[np.ndarray, "2"] | None
    details: object | None = None
    covariance_m2_s2: Float[np.ndarray, "2 2"] | None = None
    span_s: tuple[float, float] | None = None
    after_pictures: tuple[VelocityEstimate | None, ...] = ()


class VelocityEstimator(Protocol):
    """Estimates horizontal velocity from three descent pictures and the measurements taken with them."""

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """The estimate; never raises for a picture, attitude or altitude that an instrument can deliver."""
        ...


@runtime_checkable
class VelocityStream(Protocol):
    """Estimates horizontal velocity from any number of descent pictures, given one by one as they are taken.

    `marsyard.algorithms.streams.StreamedEstimator` makes it a `VelocityEstimator`.
    """

    def start(self) -> None:
        """A new descent begins: forgets all of the one before."""
        ...

    def picture(self, frame: DescentFrame) -> VelocityEstimate | None:
        """Takes the next picture; what is known by now, or None. Never raises, as `VelocityEstimator.estimate`."""
        ...

    def finish(self) -> VelocityEstimate:
        """The answer to the descent; no further picture comes. A failure where there were too few."""
        ...


class TrackingState(Enum):
    """Where a target tracker stands (tracking paper, Fig. 6)."""

    NO_TARGET = "no target is designated, or it was cleared"
    NORMAL = "a target is designated and, since it was first seen, tracked"
    LOST = "the target is lost and may yet be found again"
    FAILURE = "the target stayed lost; only clearing it ends this"


class TargetLoss(Enum):
    """Why an update lost the target. Each is an expected failure."""

    LOW_MATCH_SCORE = "the template matches nowhere well enough"
    LOW_STEREO_SCORE = "the target is not found in the right picture"
    DISTANCE_JUMP = "the target's distance changed by more than pose and stereo errors explain"
    POSITION_JUMP = "the target has moved too far from where it was first seen"
    OUT_OF_VIEW = "the place where the target should be is not in the picture"
    NO_RANGE = "the two lines of sight do not meet before the cameras"


@dataclass(frozen=True)
class PixelBox:
    """A part of a full frame: its upper left pixel (column, row) and its size (columns, rows)."""

    corner: tuple[int, int]
    size: tuple[int, int]


@dataclass(frozen=True)
class MastAim:
    """Where a tracker wants the mast to look and which pixels it needs.

    - azimuth_rad, elevation_rad: Mast angles to command (see `marsyard.sim.measurements.MastGeometry`)
    - left, right: The parts of the full frames to deliver; their exposure is best set for them too
    """

    azimuth_rad: float
    elevation_rad: float
    left: PixelBox
    right: PixelBox


@dataclass(frozen=True)
class TargetUpdate:
    """An answer to "where is the target now".

    - state: State after the update
    - losses: Why the target was not found, in the order of `TargetLoss`; empty when it was, or was not looked for (no
      target, failure)
    - position_rover: The target in the rover frame of this stop, metres: triangulated when it was found, else carried
      along by the pose estimate; None before it was seen for the first time
    - details: The algorithm's intermediate products for figures and diagnosis; None where it keeps none
    """

    state: TrackingState
    losses: tuple[TargetLoss, ...]
    position_rover: Float[np.ndarray, "3"] | None
    details: object | None = None

    @property
    def found(self) -> bool:
        """Whether this update found the target."""
        return self.state is TrackingState.NORMAL


class TargetTracker(Protocol):
    """Follows one designated target from stop to stop of a rover.

    At each stop: `aim`, point the mast, take pictures, `update`. The first update after `designate` seeds the template.
    """

    @property
    def state(self) -> TrackingState:
        """Where the tracker stands."""
        ...

    def designate(self, target: TargetDesignation, world_from_rover: RigidTransform) -> None:
        """Takes a target, with the rover's estimated pose, in place of any other."""
        ...

    def aim(self, world_from_rover: RigidTransform, mast: MastCalibration) -> MastAim | None:
        """Where to look from this pose; None where the mast cannot show the target.

        Pictures taken at any other angles then make an update that loses it.
        """
        ...

    def update(self, measurements: RoverMeasurements) -> TargetUpdate:
        """Finds the target; never raises for pictures, angles or poses that the rover can deliver."""
        ...

    def clear(self) -> None:
        """Forgets the target."""
        ...


class SiteOutcome(Enum):
    """How the search for a place to land ended.

    With SAFE_SITE a site is reported, with NO_SAFE_SITE none: the ground was mapped and no part of it is safe. Every
    other member means that the algorithm did not converge: the a-priori site is what is left, and nothing is known of
    it.
    """

    SAFE_SITE = "a safe site is reported"
    NO_SAFE_SITE = "the mapped ground has no safe site"
    NO_RANGE = "the altimeter gave no range"
    NO_FEATURES = "the first picture has too few features"
    NO_TRACKS = "too few features were found again in the second picture"
    NO_MOTION = "no rigid motion explains the tracks"
    NO_BASELINE = "the camera has not moved enough for depths"
    NO_STRUCTURE = "too few points were matched for an elevation map"

    @property
    def converged(self) -> bool:
        """Whether the ground was mapped."""
        return self in (SiteOutcome.SAFE_SITE, SiteOutcome.NO_SAFE_SITE)


@dataclass(frozen=True)
class SiteEstimate:
    """An answer to "where can one land".

    - outcome: How the search ended
    - site_world: Where to land, in the world frame of the on-board poses, metres; the a-priori site where the algorithm
      did not converge, None where the ground has no safe site
    - details: The algorithm's intermediate products for figures and diagnosis; None where it keeps none
    """

    outcome: SiteOutcome
    site_world: Float[np.ndarray, "3"] | None
    details: object | None = None


class SiteEstimator(Protocol):
    """Finds a safe place to land from two pictures and the measurements taken with them."""

    def estimate(self, measurements: LandingMeasurements) -> SiteEstimate:
        """The estimate; never raises for pictures, poses or a range that instruments can deliver."""
        ...
