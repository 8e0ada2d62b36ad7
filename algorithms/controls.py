"""Negative controls: algorithms for all four tasks that cannot meet the requirements of a meaningful campaign.

A requirement that a control meets does not depend on the images, or does not require an answer. Each class implements
the protocols `VelocityEstimator`, `SiteEstimator`, `TargetTracker` and `PositionEstimator`. Images are not used, except
those of the designation of a target: without them the tracker does not know what it is to follow.
"""

import time
from typing import NoReturn

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.interface import (
    MastAim,
    SiteEstimate,
    SiteOutcome,
    TargetLoss,
    TargetUpdate,
    TrackingState,
    VelocityEstimate,
    VelocityOutcome,
)
from marsyard.algorithms.localisation.baselines import InertialEstimator
from marsyard.algorithms.localisation.interface import InitialState, MapProduct, PositionEstimate, PositionOutcome
from marsyard.algorithms.vtt import VisualTargetTracker
from marsyard.algorithms.vtt.tracker import expected_position
from marsyard.sim.measurements import (
    AltitudeMeasurement,
    DescentMeasurements,
    DetectorImage,
    ImuIncrements,
    LandingMeasurements,
    MastCalibration,
    RoverMeasurements,
    TargetDesignation,
)

#: Position that `Constant` reports for a target in the rover frame: on level ground, 2 m in front of the rover.
_TARGET_ROVER_M = (2.0, 0.0, 0.0)
#: Offset of the site that `Constant` reports from the a-priori site (east, north, up).
_SITE_OFFSET_M = (1.0, 0.0, 0.0)
#: Standard deviation of `Constant`: m for positions, m/s for velocities, rad for attitudes.
_CONSTANT_SD = 0.01


class NoImage:
    """Plausible answers without images: inertial velocity, a-priori site, target by odometry, inertial position."""

    def __init__(self) -> None:
        self._tracker = VisualTargetTracker()
        self._navigation = InertialEstimator()

    def estimate(self, measurements: DescentMeasurements | LandingMeasurements) -> VelocityEstimate | SiteEstimate:
        """Return the velocity of a descent, or the site of a landing."""
        if isinstance(measurements, LandingMeasurements):
            return self._site(measurements)
        return self._velocity(measurements)

    def _velocity(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """Return the inertial velocity of the last interval."""
        return VelocityEstimate(VelocityOutcome.VALID, np.array(measurements.interval_velocities_m_s[-1][:2]))

    def _site(self, measurements: LandingMeasurements) -> SiteEstimate:
        """Return the a-priori site, the centre of the first image."""
        return SiteEstimate(SiteOutcome.SAFE_SITE, np.array(measurements.apriori_site_world))

    @property
    def state(self) -> TrackingState:
        """See `TargetTracker`."""
        return self._tracker.state

    def designate(self, target: TargetDesignation, world_from_rover: RigidTransform) -> None:
        """Set the target."""
        self._tracker.designate(target, world_from_rover)

    def aim(self, world_from_rover: RigidTransform, mast: MastCalibration) -> MastAim | None:
        """Aim at the position that odometry predicts."""
        return self._tracker.aim(world_from_rover, mast)

    def update(self, measurements: RoverMeasurements) -> TargetUpdate:
        """Triangulate the target in the first images; later return its position propagated by odometry."""
        track = self._tracker.track
        if track is None or track.sighting is None:
            return self._tracker.update(measurements)
        return TargetUpdate(TrackingState.NORMAL, (), expected_position(track, measurements.world_from_rover))

    def clear(self) -> None:
        """Clear the target."""
        self._tracker.clear()

    def start(self, initial: InitialState, map_product: MapProduct) -> None:
        """Reset the state for a new descent."""
        self._navigation.start(initial, map_product)

    def process_increments(self, increments: ImuIncrements) -> None:
        """Propagate the initial state."""
        self._navigation.process_increments(increments)

    def process_altitude(self, measurement: AltitudeMeasurement) -> None:
        """Ignore altitudes."""

    def process_image(self, image: DetectorImage) -> PositionEstimate:
        """Return the answer at the time of an image."""
        return self._position(self._navigation.process_image(image))

    def finish(self) -> PositionEstimate:
        """Return the answer at the time of the last increment."""
        return self._position(self._navigation.finish())

    def _position(self, inertial: PositionEstimate) -> PositionEstimate:
        """Return the answer at the time of the inertial state."""
        return inertial


class Refusal(NoImage):
    """Refuses every answer."""

    def _velocity(self, measurements: DescentMeasurements) -> VelocityEstimate:
        return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None)

    def _site(self, measurements: LandingMeasurements) -> SiteEstimate:
        return SiteEstimate(SiteOutcome.NO_SAFE_SITE, None)

    def update(self, measurements: RoverMeasurements) -> TargetUpdate:
        """Lose the target."""
        return TargetUpdate(TrackingState.FAILURE, (TargetLoss.LOW_MATCH_SCORE,), None)

    def _position(self, inertial: PositionEstimate) -> PositionEstimate:
        return PositionEstimate(PositionOutcome.NO_COARSE_FIX, inertial.time_s)


class Constant(NoImage):
    """Always the same answer, with a small covariance: no motion, a site next to the a-priori site, a target at 2 m.

    The position of a descent is the initial one.
    """

    def _velocity(self, measurements: DescentMeasurements) -> VelocityEstimate:
        covariance = _CONSTANT_SD**2 * np.eye(2)
        return VelocityEstimate(VelocityOutcome.VALID, np.zeros(2), covariance_m2_s2=covariance)

    def _site(self, measurements: LandingMeasurements) -> SiteEstimate:
        return SiteEstimate(SiteOutcome.SAFE_SITE, measurements.apriori_site_world + np.array(_SITE_OFFSET_M))

    def update(self, measurements: RoverMeasurements) -> TargetUpdate:
        """Report the target at the same position in the rover frame."""
        return TargetUpdate(TrackingState.NORMAL, (), np.array(_TARGET_ROVER_M))

    def start(self, initial: InitialState, map_product: MapProduct) -> None:
        """Store the initial state."""
        super().start(initial, map_product)
        self._initial = initial

    def _position(self, inertial: PositionEstimate) -> PositionEstimate:
        initial, covariance = self._initial, _CONSTANT_SD**2 * np.eye(9)
        state = np.array(initial.position_m), np.array(initial.velocity_m_s), initial.world_from_body
        return PositionEstimate(PositionOutcome.VALID, inertial.time_s, *state, covariance)


class NotANumber(NoImage):
    """Answers that contain NaN."""

    def _velocity(self, measurements: DescentMeasurements) -> VelocityEstimate:
        return VelocityEstimate(VelocityOutcome.VALID, np.full(2, np.nan))

    def _site(self, measurements: LandingMeasurements) -> SiteEstimate:
        return SiteEstimate(SiteOutcome.SAFE_SITE, np.full(3, np.nan))

    def update(self, measurements: RoverMeasurements) -> TargetUpdate:
        """Report a target at NaN."""
        return TargetUpdate(TrackingState.NORMAL, (), np.full(3, np.nan))

    def _position(self, inertial: PositionEstimate) -> PositionEstimate:
        nan, attitude = np.full(3, np.nan), inertial.world_from_body
        return PositionEstimate(PositionOutcome.VALID, inertial.time_s, nan, nan, attitude, np.full((9, 9), np.nan))


class Crash(NoImage):
    """Raises an exception instead of an answer."""

    def _velocity(self, measurements: DescentMeasurements) -> NoReturn:
        self._fail()

    def _site(self, measurements: LandingMeasurements) -> NoReturn:
        self._fail()

    def update(self, measurements: RoverMeasurements) -> NoReturn:
        """Raise an exception."""
        self._fail()

    def _position(self, inertial: PositionEstimate) -> NoReturn:
        self._fail()

    def _fail(self) -> NoReturn:
        raise RuntimeError("negative control: an exception instead of an answer")


class Hang(Crash):
    """Never returns: sleeps until the process is stopped."""

    def _fail(self) -> NoReturn:
        while True:
            time.sleep(3600.0)
