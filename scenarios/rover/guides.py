"""Guides of a run: they point the mast at each stop, and estimate the target's position.

`TrackerGuide` uses a tracker; `DesignationGuide` uses the position designated at the start and odometry, for drives
whose images are used by many trackers.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.answers import check_aim, check_update
from marsyard.algorithms.exchange import answer_time_s
from marsyard.algorithms.interface import MastAim, TargetTracker, TrackingState
from marsyard.algorithms.vtt.pointing import bounding_box, mast_angles
from marsyard.scenarios.input_copies import InputCopy, Inputs
from marsyard.scenarios.isolation.remote import algorithm_time_s, is_remote
from marsyard.scenarios.rover.designation import triangulate_point
from marsyard.scenarios.rover.flight_software import TargetEstimate
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.run_state import RoverRun, RunOutcome, Stop, StopView
from marsyard.scenarios.rover.task import TRACKING
from marsyard.sim.frames import compose
from marsyard.sim.measurements import MastCalibration, RoverMeasurements


class TrackerGuide:
    """The tracker under test as guide: it receives copies of its inputs, and its answers are checked."""

    def __init__(self, p: RoverScenarioParameters, run: RoverRun, estimated_pose: RigidTransform) -> None:
        """Create the tracker and designate the run's target; `estimated_pose` is the rover's estimated world pose."""
        self._tracker: TargetTracker = TRACKING.make(p.algorithm, p.vtt, p.executable)
        # a tracker in a process of its own cannot change its inputs
        self._copies: list[InputCopy[Any]] = []
        self._mast: MastCalibration = self._input(run.setup.rig.calibrated)
        self._tracker.designate(self._input(run.target.designation), estimated_pose)

    def _input(self, value: Inputs) -> Inputs:
        """Return a copy of an input, or the input for a tracker in a process of its own."""
        if is_remote(self._tracker):
            return value
        self._copies.append(InputCopy(value))
        copied: Inputs = self._copies[-1].inputs
        return copied

    def _check_inputs(self) -> None:
        """Raise AlgorithmError if the tracker changed the copies that it received; keep only that of the mast."""
        for copy in self._copies:
            copy.check()
        del self._copies[1:]

    def aim(self, run: RoverRun) -> MastAim | None:
        """Return the tracker's mast angles and subframe boxes; None if the mast or cameras cannot show the target.

        Raises AlgorithmError for an invalid answer, and the tracker's own errors.
        """
        answer = self._tracker.aim(run.setup.vehicle.estimated_pose, self._mast)
        self._check_inputs()
        return check_aim(answer, run.setup.rig.calibrated)

    def observe(self, run: RoverRun, view: StopView) -> RunOutcome | None:
        """Update the tracker and append the stop to the run; return the outcome if the run ends, else None.

        Raises the same exceptions as `aim`.
        """
        images = self._input((view.images.left, view.images.right))
        measurements = RoverMeasurements(*images, self._mast, *view.angles_rad, view.estimated_pose)
        start_s = algorithm_time_s()
        answer = self._tracker.update(measurements)
        elapsed_s = algorithm_time_s() - start_s
        self._check_inputs()
        update = check_update(answer)
        time_s = answer_time_s(update, elapsed_s)
        run.stops.append(Stop.from_view(view, run.target.point_world, run.setup.rig.left, update, time_s))
        if update.state is TrackingState.FAILURE:
            return RunOutcome.LOST
        return RunOutcome.NOT_SEEDED if update.position_rover is None else None

    def target(self, run: RoverRun) -> TargetEstimate:
        """Transform the target's last reported position by the estimated motion since that stop."""
        stop = run.stops[-1]
        if stop.update.position_rover is None:
            raise ValueError("the tracker has not reported a target position yet")
        current_from_stop = compose(run.setup.vehicle.estimated_pose.inv(), stop.estimated_pose)
        return run.create_target_estimate(current_from_stop.apply(np.array(stop.update.position_rover)))


@dataclass(frozen=True)
class DesignationGuide:
    """Guide by a designated position without tracking: odometry propagates the position. Stores all views.

    `position_world` is the designated point in the estimated world frame, or None: the true point (an oracle). The
    subframes contain the visible rock and a margin: they stand for full images, of which only this part is rendered.
    """

    margin_px: float
    position_world: Float64[np.ndarray, "3"] | None
    views: list[StopView] = field(default_factory=list)

    def aim(self, run: RoverRun) -> MastAim | None:
        """Return an aim at the estimated target; None if the mast cannot point there or a camera misses the rock."""
        stance, rig = run.setup.vehicle.stance, run.setup.rig
        angles = mast_angles(self.target(run).position_rover, rig.calibrated, use_both=False)
        if angles is None:
            return None
        rig.point(*angles)
        corners = run.setup.world.target_triangles.reshape(-1, 3)
        corners = corners[corners[:, 2] > run.setup.world.rocks.position_m[run.setup.world.target_number, 2]]
        in_head = np.asarray((stance.world_from_rover * rig.rover_from_head).inv().apply(corners.copy()))
        boxes = []
        for camera in (rig.left, rig.right):
            pixels = camera.project(in_head)[0]
            in_frame = pixels[camera.in_frame(pixels)]
            box = bounding_box(in_frame, self.margin_px, camera) if len(in_frame) else None
            if box is None:
                return None
            boxes.append(box)
        # the mast does not move if its encoders already read these angles
        return MastAim(*rig.state.readings_rad, *boxes)

    def observe(self, run: RoverRun, view: StopView) -> RunOutcome | None:
        """Store the view; the run continues."""
        # a case that tracks over these views has one leg, and no drives of its own
        self.views.append(replace(view, leg=0, drives=()))
        return None

    def target(self, run: RoverRun) -> TargetEstimate:
        """Return the designated position in the rover frame of the estimated pose, or the true target position."""
        if self.position_world is None:
            true_pose = run.setup.vehicle.stance.world_from_rover
            return run.create_target_estimate(true_pose.inv().apply(run.target.point_world.copy()))
        return run.create_target_estimate(run.setup.vehicle.estimated_pose.inv().apply(self.position_world.copy()))

    @classmethod
    def designate(cls, run: RoverRun, margin_px: float, oracle: bool) -> DesignationGuide:
        """Create the guide at the start: operators triangulate the point in images of the start; an `oracle` knows it.

        Raises ValueError if the mast cannot point at the target or the point cannot be triangulated.
        """
        if oracle:
            return cls(margin_px, None)
        stance, rig = run.setup.vehicle.stance, run.setup.rig
        point = run.target.point_world
        angles = mast_angles(
            np.asarray(stance.world_from_rover.inv().apply(point.copy())), rig.calibrated, use_both=False
        )
        if angles is None:
            raise ValueError("the mast cannot point at the target's rock from the start of this drive")
        rig.point(*angles)
        position = triangulate_point(rig, stance, point)
        return cls(margin_px, np.asarray(run.setup.vehicle.estimated_pose.apply(position)))


Guide = TrackerGuide | DesignationGuide
