"""Algorithms that record their inputs, and scores that record the truth of the same case."""

from __future__ import annotations

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

#: Inputs of algorithms and scored cases, in call order.
GIVEN: list[Any] = []
TRUE: list[Any] = []


class VelocitySpy:
    """A velocity estimator without a valid answer."""

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """See `VelocityEstimator`."""
        GIVEN.append(measurements)
        return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None)


class SiteSpy:
    """A site estimator that does not converge."""

    def estimate(self, measurements: LandingMeasurements) -> SiteEstimate:
        """See `SiteEstimator`."""
        GIVEN.append(measurements)
        return SiteEstimate(SiteOutcome.NO_STRUCTURE, np.array(measurements.apriori_site_world))


class TrackerSpy:
    """The paper's tracker; records (pose, mast) of each aim and the measurements of each update."""

    def __init__(self) -> None:
        self.inner = VisualTargetTracker()

    @property
    def state(self) -> TrackingState:
        """See `TargetTracker`."""
        return self.inner.state

    def designate(self, target: TargetDesignation, world_from_rover: RigidTransform) -> None:
        """See `TargetTracker`."""
        self.inner.designate(target, world_from_rover)

    def aim(self, world_from_rover: RigidTransform, mast: MastCalibration) -> MastAim | None:
        """See `TargetTracker`."""
        GIVEN.append((world_from_rover, mast))
        return self.inner.aim(world_from_rover, mast)

    def update(self, measurements: RoverMeasurements) -> TargetUpdate:
        """See `TargetTracker`."""
        GIVEN.append(measurements)
        return self.inner.update(measurements)

    def clear(self) -> None:
        """See `TargetTracker`."""
        self.inner.clear()


def keep(case: ScoredVelocity | ScoredSite) -> dict[str, float]:
    """A score that records the case."""
    TRUE.append(case)
    return {"kept": 1.0}


def _blacken(picture: Any, how: str) -> None:
    if how == "by force":
        picture.counts.setflags(write=True)
    picture.counts[:] = 0


class WritingVelocity(VelocitySpy):
    """Writes to its images."""

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """See `VelocityEstimator`."""
        _blacken(measurements.images[0], "as if it could")
        return super().estimate(measurements)


class SpoilingVelocity(VelocitySpy):
    """Makes its images writable before it writes."""

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """See `VelocityEstimator`."""
        _blacken(measurements.images[0], "by force")
        return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None)


class SpoilingSite(SiteSpy):
    """Makes site images writable before it writes."""

    def estimate(self, measurements: LandingMeasurements) -> SiteEstimate:
        """See `SiteEstimator`."""
        _blacken(measurements.images[0], "by force")
        return SiteEstimate(SiteOutcome.NO_STRUCTURE, np.array(measurements.apriori_site_world))


class SpoilingTracker(TrackerSpy):
    """Makes tracker images writable before it writes."""

    def update(self, measurements: RoverMeasurements) -> TargetUpdate:
        """See `TargetTracker`."""
        update = self.inner.update(measurements)
        _blacken(measurements.left, "by force")
        return update


class RaisingTracker(TrackerSpy):
    """Raises at its second stop."""

    def update(self, measurements: RoverMeasurements) -> TargetUpdate:
        """See `TargetTracker`."""
        if any(isinstance(one, RoverMeasurements) for one in GIVEN):
            raise RuntimeError("the tracker raised")
        return super().update(measurements)


class Leaving:
    """An algorithm that ends its process for any task, simulated within a test."""

    def _leave(self, *_: object) -> None:
        raise SystemExit("left")

    estimate = designate = aim = update = clear = state = _leave
