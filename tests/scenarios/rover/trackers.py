"""Custom trackers for tests: a biased tracker, a tracker that loses the target, and a tracker without answers."""

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.interface import MastAim, TargetLoss, TargetUpdate, TrackingState
from marsyard.sim.measurements import MastCalibration, RoverMeasurements
from tests.scenarios.spies import WrappedTracker


class OffsetTracker(WrappedTracker):
    """Tracker with positions that are 0.3 m too far to the left, reported as tracked with the right details."""

    def update(self, measurements: RoverMeasurements) -> TargetUpdate:
        update = super().update(measurements)
        assert update.position_rover is not None
        return replace(update, position_rover=update.position_rover + np.array([0.0, 0.3, 0.0]))


class BehindTracker(WrappedTracker):
    """Tracker that reports a position 2 m behind the rover as tracked."""

    def update(self, measurements: RoverMeasurements) -> TargetUpdate:
        return replace(super().update(measurements), position_rover=np.array([-2.0, 0.0, 0.3]))


class LosingTracker(WrappedTracker):
    """Tracker that reports the target as lost after the first update."""

    def update(self, measurements: RoverMeasurements) -> TargetUpdate:
        # At the first update the target is designated, but not yet seen.
        if self.paper_tracker.track is not None and self.paper_tracker.track.sighting is None:
            return self.paper_tracker.update(measurements)
        position = np.array([3.0, 0.0, 0.3])
        return TargetUpdate(TrackingState.FAILURE, (TargetLoss.LOW_MATCH_SCORE,), position)


class SilentTracker(WrappedTracker):
    """Tracker that returns None for each update."""

    def update(self, measurements: RoverMeasurements) -> Any:
        self.paper_tracker.update(measurements)


class UnaimedTracker(WrappedTracker):
    """A tracker that never points the mast."""

    def aim(self, world_from_rover: RigidTransform, mast: MastCalibration) -> MastAim | None:
        return None
