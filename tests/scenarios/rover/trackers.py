"""Custom trackers for tests: a biased tracker, a tracker that loses the target, and a tracker without answers."""

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.interface import MastAim, TargetLoss, TargetUpdate, TrackingState
from marsyard.algorithms.vtt import VisualTargetTracker
from marsyard.sim.measurements import MastCalibration, RoverMeasurements, TargetDesignation


class OffsetTracker:
    """The paper's tracker with positions that are 0.3 m too far to the left, reported as tracked."""

    def __init__(self) -> None:
        self.paper_tracker = VisualTargetTracker()

    @property
    def state(self) -> TrackingState:
        """See `TargetTracker`."""
        return self.paper_tracker.state

    def designate(self, target: TargetDesignation, world_from_rover: RigidTransform) -> None:
        """See `TargetTracker`."""
        self.paper_tracker.designate(target, world_from_rover)

    def aim(self, world_from_rover: RigidTransform, mast: MastCalibration) -> MastAim | None:
        """See `TargetTracker`."""
        return self.paper_tracker.aim(world_from_rover, mast)

    def update(self, measurements: RoverMeasurements) -> TargetUpdate:
        """See `TargetTracker`."""
        update = self.paper_tracker.update(measurements)
        assert update.position_rover is not None
        return replace(update, position_rover=update.position_rover + np.array([0.0, 0.3, 0.0]), details=None)

    def clear(self) -> None:
        """See `TargetTracker`."""
        self.paper_tracker.clear()


class LosingTracker(OffsetTracker):
    """Tracker that reports the target as lost after the first update."""

    def update(self, measurements: RoverMeasurements) -> TargetUpdate:
        """See `TargetTracker`."""
        # At the first update the target is designated, but not yet seen.
        if self.paper_tracker.track is not None and self.paper_tracker.track.sighting is None:
            return self.paper_tracker.update(measurements)
        position = np.array([3.0, 0.0, 0.3])
        return TargetUpdate(TrackingState.FAILURE, (TargetLoss.LOW_MATCH_SCORE,), position)


class SilentTracker(OffsetTracker):
    """Tracker that returns None for each update."""

    def update(self, measurements: RoverMeasurements) -> Any:
        """See `TargetTracker`."""
        self.paper_tracker.update(measurements)


class UnaimedTracker(OffsetTracker):
    """A tracker that never points the mast."""

    def aim(self, world_from_rover: RigidTransform, mast: MastCalibration) -> MastAim | None:
        """Return no aim."""
        return None
