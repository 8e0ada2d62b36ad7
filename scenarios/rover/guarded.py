"""The tracker of a run as its scenario asks it: inputs handed over as copies, answers held against the interface."""

from __future__ import annotations

import time

from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.answers import checked_aim, checked_update
from marsyard.algorithms.interface import MastAim, TargetTracker, TargetUpdate
from marsyard.scenarios.handover import Handover
from marsyard.scenarios.rover.pictures import StereoPictures
from marsyard.scenarios.trial import answer_time_s
from marsyard.sim.measurements import MastCalibration, RoverMeasurements, TargetDesignation


class GuardedTracker:
    """A tracker under test.

    `tracker`: The user's or one of ours.
    `mast`: As calibrated; the tracker gets one copy of it for all of the run.
    """

    def __init__(self, tracker: TargetTracker, mast: MastCalibration) -> None:
        self._tracker = tracker
        self._mast = mast
        self._handed_mast = Handover(mast)

    def designate(self, designation: TargetDesignation, world_from_rover: RigidTransform) -> None:
        """As `TargetTracker.designate`. Raises what the tracker raises."""
        self._tracker.designate(Handover(designation).given, world_from_rover)

    def aim(self, world_from_rover: RigidTransform) -> MastAim | None:
        """As `TargetTracker.aim`. Raises AlgorithmError for a bad answer, and what the tracker raises."""
        answer = self._tracker.aim(world_from_rover, self._handed_mast.given)
        self._handed_mast.check()
        return checked_aim(answer, self._mast)

    def update(
        self, pictures: StereoPictures, angles_rad: tuple[float, float], world_from_rover: RigidTransform
    ) -> tuple[TargetUpdate, float]:
        """The answer to a stop's pictures, and the time that it took, s; raises as `aim`.

        `pictures`: Of the left and the right camera.
        `angles_rad`: Azimuth and elevation as the mast's encoders read them.
        `world_from_rover`: The rover's pose as estimated on board.
        """
        handover = Handover((pictures.left, pictures.right))
        left, right = handover.given
        measurements = RoverMeasurements(left, right, self._handed_mast.given, *angles_rad, world_from_rover)
        started = time.process_time()
        answer = self._tracker.update(measurements)
        taken = time.process_time() - started
        handover.check()
        self._handed_mast.check()
        update = checked_update(answer)
        return update, answer_time_s(update, taken)
