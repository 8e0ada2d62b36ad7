"""Protocols that algorithms under test implement (velocity, target tracking, landing site), and their answer types."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import ParamSpec, Protocol, TypeVar

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

StartInputs = ParamSpec("StartInputs")
Image = TypeVar("Image", contravariant=True)
Answer = TypeVar("Answer", covariant=True)


class VelocityOutcome(Enum):
    """Outcome of a velocity estimate. All members except VALID are expected failures: no velocity is reported."""

    VALID = "a velocity is reported"
    NO_TEMPLATE_AREA = "an image pair has no feasible overlap for a template"
    NO_VALID_TRACK = "in an image pair no template passed the validity checks"
    IMU_MISMATCH = "no combination of tracks agrees with the change of velocity measured by the IMU"
    INCLINED_GROUND = "the ground is more inclined than slopes and attitude errors explain"


@dataclass(frozen=True)
class VelocityEstimate:
    """Answer of a velocity estimator: horizontal velocity of the lander over the ground, or a failure.

    - outcome: Result of the estimation
    - velocity_m_s: Mean horizontal velocity of the camera (east, north) over `span_s`; None unless the outcome is VALID
    - details: Intermediate products for figures and diagnosis, or None
    - covariance_m2_s2: Covariance of the velocity error (east, north) estimated by the algorithm, or None. The
      evaluation also tests whether the errors agree with this covariance.
    - span_s: Start and end of the averaging interval, within the time tags of the images. Equal values mean the
      velocity at that instant. None: the last interval, from the second to the third of three images.
    - attitude_error_rad: Estimated rotation vector from the true to the measured attitudes, common to all images, world
      axes; None if the algorithm does not estimate it. The propagation of the velocity by the inertial unit uses it.
    - after_images: Answers of a stream (`VelocityStream`) after each image, None for no answer; set by the caller.
      Empty for other estimators.
    """

    outcome: VelocityOutcome
    velocity_m_s: Float[np.ndarray, "2"] | None
    details: object | None = None
    covariance_m2_s2: Float[np.ndarray, "2 2"] | None = None
    span_s: tuple[float, float] | None = None
    after_images: tuple[VelocityEstimate | None, ...] = ()
    attitude_error_rad: Float[np.ndarray, "3"] | None = None


class VelocityEstimator(Protocol):
    """Protocol: estimate the horizontal velocity from descent images (three for DIMES) and their measurements."""

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """Estimate the velocity; never raises for an image, attitude or altitude that an instrument can deliver."""


class ImageStream(Protocol[StartInputs, Image, Answer]):
    """Protocol of a stream: an estimator that receives any number of images of a descent one by one.

    A stream can also have one or both of two optional methods, which are called in descents with inertial increments.
    All measurements arrive in the order of their time tags:

    - ``process_increments(increments: ImuIncrements) -> None``: receives the increments since the last call. Before an
      altitude or an image, they end at the first boundary that is not earlier than its time tag.
    - ``process_altitude(measurement: AltitudeMeasurement) -> None``: receives each altitude once.

    No method raises for a measurement that an instrument can deliver.
    """

    def start(self, *inputs: StartInputs.args, **named: StartInputs.kwargs) -> None:
        """Reset the state for a new descent."""

    def process_image(self, image: Image) -> Answer | None:
        """Process the next image; return an estimate, or None."""

    def finish(self) -> Answer:
        """Return the final estimate of the descent; a failure outcome if there were too few images."""


#: Stream that estimates the horizontal velocity. `start` has no arguments; the last increments end at the last image.
VelocityStream = ImageStream[[], DescentFrame, VelocityEstimate]


class TrackingState(Enum):
    """State of a target tracker (tracking paper, Fig. 6)."""

    NO_TARGET = "no target is designated, or it was cleared"
    NORMAL = "a target is designated and, after its first match, tracked"
    LOST = "the target is lost and can be recovered"
    FAILURE = "the target was not recovered; it must be cleared"


class TargetLoss(Enum):
    """Reason for the loss of the target in an update; all are expected failures."""

    LOW_MATCH_SCORE = "the match score of the template is too low"
    LOW_STEREO_SCORE = "the stereo match score in the right image is too low"
    DISTANCE_JUMP = "the target's distance changed by more than pose and stereo errors explain"
    POSITION_JUMP = "the target's position is too far from its first position"
    OUT_OF_VIEW = "the predicted target position is outside the image"
    NO_RANGE = "the two lines of sight do not intersect in front of the cameras"


@dataclass(frozen=True)
class PixelBox:
    """Rectangular region of a full image frame: upper left pixel (column, row) and size (columns, rows)."""

    corner: tuple[int, int]
    size: tuple[int, int]


@dataclass(frozen=True)
class MastAim:
    """Mast angles and image regions that a target tracker requests for its next images.

    - azimuth_rad, elevation_rad: Mast angles to command (see `marsyard.sim.measurements.MastGeometry`)
    - left, right: Regions of the full frames to deliver; the exposure should be controlled for these regions
    """

    azimuth_rad: float
    elevation_rad: float
    left: PixelBox
    right: PixelBox


@dataclass(frozen=True)
class TargetUpdate:
    """Answer of a target tracker to the images of one rover stop.

    - state: State of the tracker after the update
    - losses: Reasons of the loss, in the order of `TargetLoss`; empty after a match or without a search (states
      NO_TARGET and FAILURE)
    - position_rover: The target in the rover frame of this stop, metres: triangulated, or propagated by the pose
      estimate after a loss; None before the first match.
    - details: Intermediate products for figures and diagnosis, or None
    """

    state: TrackingState
    losses: tuple[TargetLoss, ...]
    position_rover: Float[np.ndarray, "3"] | None
    details: object | None = None

    @property
    def tracked(self) -> bool:
        """Whether this update matched the target."""
        return self.state is TrackingState.NORMAL


class TargetTracker(Protocol):
    """Protocol: track one designated target over the stops of a rover.

    At each stop the caller calls `aim`, points the mast, takes images and calls `update`. The first update after
    `designate` sets the template.
    """

    @property
    def state(self) -> TrackingState:
        """State of the tracker."""

    def designate(self, target: TargetDesignation, world_from_rover: RigidTransform) -> None:
        """Set the target, which replaces the previous target; `world_from_rover` is the rover's estimated pose."""

    def aim(self, world_from_rover: RigidTransform, mast: MastCalibration) -> MastAim | None:
        """Compute the mast aim for this rover pose; None if the mast cannot point at the target.

        Images taken at different angles may not show the target, which is then lost in the update.
        """

    def update(self, measurements: RoverMeasurements) -> TargetUpdate:
        """Find the target in new images; never raises for images, angles or poses that the rover can deliver."""

    def clear(self) -> None:
        """Clear the target."""


class SiteOutcome(Enum):
    """Outcome of the search for a landing site.

    SAFE_SITE: a site is reported. NO_SAFE_SITE: no site is reported, because no part of the mapped ground is safe. All
    other members mean that the algorithm did not converge: the a-priori site is reported, although it was not checked.
    """

    SAFE_SITE = "a safe site is reported"
    NO_SAFE_SITE = "the algorithm finds no safe site in its map"
    NO_RANGE = "the altimeter measured no range"
    NO_FEATURES = "the first image has too few features"
    NO_TRACKS = "too few features were tracked to the second image"
    NO_MOTION = "no rigid motion explains the tracks"
    NO_BASELINE = "the camera motion is too small for depth estimation"
    NO_STRUCTURE = "too few points were matched for an elevation map"

    @property
    def converged(self) -> bool:
        """Whether the ground was mapped."""
        return self in (SiteOutcome.SAFE_SITE, SiteOutcome.NO_SAFE_SITE)


@dataclass(frozen=True)
class SiteEstimate:
    """Answer of a landing site estimator.

    - outcome: Result of the search
    - site_world: Site in the world frame of the on-board poses, metres; None if there is no safe site. If the algorithm
      did not converge, it must be the a-priori site: another one is a BAD_ANSWER.
    - details: Intermediate products for figures and diagnosis, or None
    """

    outcome: SiteOutcome
    site_world: Float[np.ndarray, "3"] | None
    details: object | None = None


class SiteEstimator(Protocol):
    """Protocol: select a safe landing site from two images and their measurements."""

    def estimate(self, measurements: LandingMeasurements) -> SiteEstimate:
        """Select the site; never raises for images, poses or a range that instruments can deliver."""
