"""State of a rover's run: the rover in its world, its target, its stops with images and answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from enum import Enum

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.interface import TargetUpdate
from marsyard.algorithms.vtt import VttDetails
from marsyard.algorithms.vtt.arm import Placement
from marsyard.scenarios.rover.designation import DesignatedTarget
from marsyard.scenarios.rover.flight_software import Navigator, TargetEstimate
from marsyard.scenarios.rover.navigation_cameras import NavigationCameras
from marsyard.scenarios.rover.parameters import MobilityParameters, RoverScenarioParameters
from marsyard.scenarios.rover.rig import Rig
from marsyard.scenarios.rover.stereo_camera import StereoCamera, StereoImages
from marsyard.scenarios.rover.vehicle import Vehicle
from marsyard.scenarios.rover.world import RunWorld
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics.driving import Drive
from marsyard.sim.dynamics.rover import Stance
from marsyard.sim.measurements import MastCalibration, RoverMeasurements, StereoMeasurement
from marsyard.sim.streams import Streams

#: Index of the leg of the first stop, before the rover has driven.
START_LEG = -1


class RunOutcome(Enum):
    """Outcome of a run. All outcomes except COMPLETED are expected failures: no position is reported at the goal.

    NOT_SEEDED and LOST are failures of the tracker. STUCK is a property of rover and ground: the target may be tracked.
    """

    COMPLETED = "the run was completed and the target was tracked at its end"
    NOT_SEEDED = "the target was not found in the first images"
    LOST = "the target was lost and was not found again"
    OUT_OF_REACH = "the mast or the cameras cannot show the target"
    NO_PATH = "the navigator found no path"
    STUCK = "the rover hardly moved over several steps"
    NOT_AT_GOAL = "the maximum number of steps was reached before the goal"


@dataclass(frozen=True)
class StopView:
    """The images of a stop, with the poses at which they were taken."""

    leg: int  #: index of the leg with the step that ended here; `START_LEG` for the start
    time_s: float  #: time since the start of the run
    stance: Stance  #: true pose and joint angles of the rover
    estimated_pose: RigidTransform  #: estimated world pose of the rover
    angles_rad: tuple[float, float]  #: azimuth and elevation read by the mast's encoders
    world_from_head: RigidTransform  #: true pose of the mast's head
    images: StereoImages
    drives: tuple[Drive, ...]  #: drives since the previous stop

    def measurements(self, mast: MastCalibration) -> RoverMeasurements:
        """Return the measurements of the stop, with the calibrated mast."""
        return RoverMeasurements(self.images.left, self.images.right, mast, *self.angles_rad, self.estimated_pose)


@dataclass(frozen=True)
class Stop(StopView):
    """A stop at which the target was tracked."""

    update: TargetUpdate  #: the tracker's answer
    details: VttDetails | None  #: details of the answer; None for a custom tracker
    reported_position_rover: Float64[np.ndarray, "3"] | None  #: reported position, rover frame; None if not tracked
    track_time_s: float  #: processor time of the update
    point_px: Float64[np.ndarray, "2"]  #: true full-frame (u, v) of the target in the left image; NaN outside
    point_rover: Float64[np.ndarray, "3"]  #: the designated point in the rover's true frame, metres
    range_m: float  #: true distance from the left camera to the point

    @classmethod
    def from_view(
        cls,
        view: StopView,
        point_m: Float64[np.ndarray, "3"],
        left: CameraModel,
        update: TargetUpdate,
        track_time_s: float,
    ) -> Stop:
        """Create a stop; `point_m` is the designated point in world axes, `left` the true left camera."""
        in_head = np.asarray(view.world_from_head.inv().apply(point_m.copy()))
        return cls(
            **{item.name: getattr(view, item.name) for item in fields(StopView)},
            update=update,
            details=update.details if isinstance(update.details, VttDetails) else None,
            reported_position_rover=update.position_rover if update.tracked else None,
            track_time_s=track_time_s,
            point_px=np.asarray(left.project(in_head)[0]),
            point_rover=np.asarray(view.stance.world_from_rover.inv().apply(point_m.copy())),
            range_m=float(np.linalg.norm(in_head - left.c)),
        )

    def reported_px(self, mast: MastCalibration) -> Float64[np.ndarray, "2"]:
        """Project the reported position into the left image by the calibrated camera.

        The pixel is NaN if the target was not tracked, or if the reported position is behind the camera.
        """
        if self.reported_position_rover is None:
            return np.full(2, np.nan)
        camera = mast.left.transform(mast.geometry.rover_from_head(*self.angles_rad))
        return np.asarray(camera.project(self.reported_position_rover)[0], dtype=np.float64)

    def error_px(self, mast: MastCalibration) -> Float64[np.ndarray, "2"]:
        """Compute the reported minus the true pixel (u, v); NaN if the target was not tracked.

        The error is infinite if the reported or the true position of a tracked target is behind the camera.
        """
        error = self.reported_px(mast) - self.point_px
        is_undefined = self.reported_position_rover is not None and not np.isfinite(error).all()
        return np.full(2, np.inf) if is_undefined else error

    def error_m(self) -> Float64[np.ndarray, "3"]:
        """Compute the reported minus the true position in the rover frame; NaN if no position was reported."""
        return (
            np.full(3, np.nan)
            if self.reported_position_rover is None
            else np.asarray(self.reported_position_rover - self.point_rover)
        )


@dataclass
class Setup:
    """A rover in its world, with its cameras; its vehicle is at the start until a run moves it."""

    world: RunWorld
    rig: Rig
    vehicle: Vehicle
    camera: StereoCamera
    navigation_cameras: NavigationCameras

    @staticmethod
    def draw(p: RoverScenarioParameters, streams: Streams) -> Setup:
        """Create the set-up of a run and draw all its errors."""
        rig = Rig.draw(p, streams)
        world = RunWorld.from_parameters(p, rig.pixel_rad, streams)
        camera = StereoCamera.draw(p, streams)
        navigation_cameras = NavigationCameras.draw(p, rig, streams)
        return Setup(world, rig, Vehicle.at_start(p, world, rig, streams), camera, navigation_cameras)


@dataclass(frozen=True)
class Step:
    """Commanded path of a step, and its part that the rover truly drove in the commanded direction, metres."""

    commanded_m: float
    progress_m: float

    @classmethod
    def from_drives(cls, drives: Sequence[Drive]) -> Step:
        """Create a step from its drives."""
        return cls(sum(drive.command.length_m for drive in drives), sum(drive.progress_m for drive in drives))


def is_stuck(steps: Sequence[Step], mobility: MobilityParameters) -> bool:
    """Whether the slip over any `mobility.stuck_steps` successive steps is above `mobility.stuck_slip`.

    In a shorter run it is the slip over all steps, because the tracker may have ended the run. False without steps.
    """
    count = mobility.stuck_steps
    windows = (steps[first : first + count] for first in range(max(len(steps) - count, 0) + 1))
    return any(
        sum(step.progress_m for step in window) < (1.0 - mobility.stuck_slip) * sum(step.commanded_m for step in window)
        for window in windows
    )


@dataclass
class RoverRun:
    """State of a run in progress or finished: the rover in its world, its target, and what happened so far."""

    setup: Setup
    target: DesignatedTarget
    stops: list[Stop] = field(default_factory=list)  #: stops with a tracking update, in order
    outcome: RunOutcome = RunOutcome.NOT_AT_GOAL
    handed_off: bool = False  #: whether the target was handed off to the arm at the end
    placement: Placement | None = None  #: placement of the instrument; None without a hand-off
    visual_odometry_updates: int = 0
    visual_odometry_failures: int = 0  #: updates without an estimate; wheel odometry was used
    autonav_updates: int = 0
    navigator: Navigator = field(default_factory=Navigator)
    odometry_pair: tuple[Stance, StereoMeasurement] | None = None  #: last pair of visual odometry, and its stance
    time_s: float = 0.0  #: time since the start
    drives_since_stop: list[Drive] = field(default_factory=list)
    steps: list[Step] = field(default_factory=list)  #: all steps with a commanded path, in order

    def create_target_estimate(self, position_rover: Float64[np.ndarray, "3"]) -> TargetEstimate:
        """Create a target estimate from a position in the rover frame; add its range from the camera."""
        position = np.asarray(position_rover)
        return TargetEstimate(position, self.setup.rig.estimated_range_m(position))
