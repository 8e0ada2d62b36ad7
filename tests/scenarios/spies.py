"""Algorithms and a score for tests: some record their inputs, others write to images, raise or exit."""

from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.interface import (
    MastAim,
    SiteEstimate,
    SiteOutcome,
    TargetUpdate,
    TrackingState,
    VelocityEstimate,
    VelocityOutcome,
)
from marsyard.algorithms.vtt import VisualTargetTracker
from marsyard.scenarios.parts.scores import ScoredSite, ScoredVelocity
from marsyard.sim.measurements import (
    DescentMeasurements,
    LandingMeasurements,
    MastCalibration,
    RoverMeasurements,
    TargetDesignation,
)

#: Inputs of the algorithms, in call order.
RECORDED_INPUTS: list[Any] = []
#: Cases that the score receives, with the truth, in call order.
RECORDED_CASES: list[Any] = []


class VelocitySpy:
    """Velocity estimator that records its inputs and has no valid answer."""

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        RECORDED_INPUTS.append(measurements)
        return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None)


class SiteSpy:
    """Site estimator that records its inputs and does not converge."""

    def estimate(self, measurements: LandingMeasurements) -> SiteEstimate:
        RECORDED_INPUTS.append(measurements)
        return SiteEstimate(SiteOutcome.NO_STRUCTURE, np.array(measurements.apriori_site_world))


class WrappedTracker:
    """The paper's tracker; subclasses change some of its methods."""

    def __init__(self) -> None:
        self.paper_tracker = VisualTargetTracker()

    @property
    def state(self) -> TrackingState:
        return self.paper_tracker.state

    def designate(self, target: TargetDesignation, world_from_rover: RigidTransform) -> None:
        self.paper_tracker.designate(target, world_from_rover)

    def aim(self, world_from_rover: RigidTransform, mast: MastCalibration) -> MastAim | None:
        return self.paper_tracker.aim(world_from_rover, mast)

    def update(self, measurements: RoverMeasurements) -> TargetUpdate:
        return self.paper_tracker.update(measurements)

    def clear(self) -> None:
        self.paper_tracker.clear()


class TrackerSpy(WrappedTracker):
    """Tracker that records (pose, mast) of each `aim` call and the measurements of each update."""

    def aim(self, world_from_rover: RigidTransform, mast: MastCalibration) -> MastAim | None:
        RECORDED_INPUTS.append((world_from_rover, mast))
        return super().aim(world_from_rover, mast)

    def update(self, measurements: RoverMeasurements) -> TargetUpdate:
        RECORDED_INPUTS.append(measurements)
        return super().update(measurements)


def record_case(case: ScoredVelocity | ScoredSite) -> dict[str, float]:
    """Custom score that records the case."""
    RECORDED_CASES.append(case)
    return {"recorded": 1.0}


def _set_counts_to_zero(image: Any, *, make_writable: bool) -> None:
    if make_writable:
        image.counts.setflags(write=True)
    image.counts[:] = 0


class VelocityWriter(VelocitySpy):
    """Velocity estimator that writes to its read-only image."""

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        _set_counts_to_zero(measurements.images[0], make_writable=False)
        return super().estimate(measurements)


class ForcedVelocityWriter(VelocitySpy):
    """Velocity estimator that makes an image writable and overwrites it."""

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        _set_counts_to_zero(measurements.images[0], make_writable=True)
        return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None)


class ForcedSiteWriter(SiteSpy):
    """Site estimator that makes an image writable and overwrites it."""

    def estimate(self, measurements: LandingMeasurements) -> SiteEstimate:
        _set_counts_to_zero(measurements.images[0], make_writable=True)
        return SiteEstimate(SiteOutcome.NO_STRUCTURE, np.array(measurements.apriori_site_world))


class ForcedTrackerWriter(TrackerSpy):
    """Tracker that makes an image writable and overwrites it."""

    def update(self, measurements: RoverMeasurements) -> TargetUpdate:
        update = self.paper_tracker.update(measurements)
        _set_counts_to_zero(measurements.left, make_writable=True)
        return update


class RaisingTracker(TrackerSpy):
    """Tracker that raises an exception at the second stop."""

    def update(self, measurements: RoverMeasurements) -> TargetUpdate:
        if any(isinstance(inputs, RoverMeasurements) for inputs in RECORDED_INPUTS):
            raise RuntimeError("the tracker raised")
        return super().update(measurements)
