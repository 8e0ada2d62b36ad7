"""State of a rover's run: the rover in its world, its target, and what happened so far."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64

from marsyard.algorithms.vtt.arm import Placement
from marsyard.scenarios.base import LoadGround
from marsyard.scenarios.rover.designation import DesignatedTarget
from marsyard.scenarios.rover.flight_software import Navigator, TargetEstimate
from marsyard.scenarios.rover.navigation_cameras import NavigationCameras
from marsyard.scenarios.rover.parameters import MobilityParameters, RoverScenarioParameters
from marsyard.scenarios.rover.rig import Rig
from marsyard.scenarios.rover.stereo_camera import StereoCamera
from marsyard.scenarios.rover.stops import RunOutcome, Stop
from marsyard.scenarios.rover.vehicle import Vehicle
from marsyard.scenarios.rover.world import RunWorld
from marsyard.sim.dynamics.driving import Drive
from marsyard.sim.dynamics.rover import Stance
from marsyard.sim.measurements import StereoMeasurement
from marsyard.sim.streams import Streams


@dataclass
class Setup:
    """A rover in its world, with its cameras; its vehicle is at the start until a run moves it."""

    world: RunWorld
    rig: Rig
    vehicle: Vehicle
    camera: StereoCamera
    navigation_cameras: NavigationCameras

    @staticmethod
    def draw(p: RoverScenarioParameters, streams: Streams, load_ground: LoadGround) -> Setup:
        """Create the set-up of a run and draw all its errors."""
        rig = Rig.draw(p, streams)
        world = RunWorld.from_parameters(p, rig.pixel_rad, streams, load_ground)
        camera = StereoCamera.draw(p, streams)
        navigation_cameras = NavigationCameras.draw(p, rig, streams)
        return Setup(world, rig, Vehicle.at_start(p, world, rig, streams), camera, navigation_cameras)


@dataclass(frozen=True)
class Step:
    """Commanded path and true displacement of a step, metres."""

    commanded_m: float
    displacement_m: float


def is_stuck(steps: Sequence[Step], mobility: MobilityParameters) -> bool:
    """Whether the rover hardly moved over its last steps; False before `mobility.stuck_steps` steps."""
    last = steps[-mobility.stuck_steps :]
    commanded_m, displacement_m = sum(step.commanded_m for step in last), sum(step.displacement_m for step in last)
    return len(last) == mobility.stuck_steps and displacement_m < (1.0 - mobility.stuck_slip) * commanded_m


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
        return TargetEstimate(position, self.setup.rig.range_m(position))
