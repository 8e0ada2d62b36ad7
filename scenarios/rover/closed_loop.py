"""Simulate the closed loop of a run: at each stop visual odometry, tracking, navigation and drive, as in Fig. 12.

A guide points the mast at each stop and estimates the target's position. `TrackerGuide` uses a tracker;
`DesignationGuide` uses the position designated at the start and odometry, for drives whose images are used by many
trackers. Visual odometry and the navigator's map use rendered stereo pairs. Parameters with values `oracle-...` replace
these measurements by the truth with errors, which is faster and isolates the causes of failures.

Fig. 12 is that of Kim et al., "Targeted Driving Using Visual Tracking".
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.answers import check_aim, check_update
from marsyard.algorithms.exchange import answer_time_s
from marsyard.algorithms.interface import MastAim, TargetTracker, TrackingState
from marsyard.algorithms.navigation.planner import NavigationOutcome
from marsyard.algorithms.navigation.visual_odometry import MotionEstimate, estimate_motion
from marsyard.algorithms.vtt import GoalCriterion, HandOffOutcome, hand_off
from marsyard.algorithms.vtt.placement import Placement
from marsyard.algorithms.vtt.pointing import bounding_box, mast_angles
from marsyard.scenarios.base import LoadGround
from marsyard.scenarios.input_copies import InputCopy, Inputs
from marsyard.scenarios.isolation.remote import algorithm_time_s, is_remote
from marsyard.scenarios.rover.flight_software import (
    GOAL_TOLERANCE_M,
    Navigator,
    TargetEstimate,
    goal_position,
    is_finished,
    plan_step,
)
from marsyard.scenarios.rover.navigation_cameras import ODOMETRY_EDGE_RAYS, NavigationCameras, oracle_heights
from marsyard.scenarios.rover.parameters import LegParameters, MobilityParameters, RoverScenarioParameters
from marsyard.scenarios.rover.points import build_shadow_caster
from marsyard.scenarios.rover.stops import (
    DesignatedTarget,
    RunOutcome,
    StereoCamera,
    Stop,
    StopView,
    designate_from_start,
    triangulate_point,
)
from marsyard.scenarios.rover.task import TRACKING
from marsyard.scenarios.rover.world import Rig, RunWorld, Vehicle
from marsyard.scenarios.views import SiteGround
from marsyard.sim.dynamics.driving import Drive
from marsyard.sim.dynamics.rover import Stance
from marsyard.sim.frames import compose
from marsyard.sim.measurements import DriveCommand, MastCalibration, RoverMeasurements, StereoMeasurement
from marsyard.sim.streams import Streams

#: Radius of the ground in a subframe around the target, divided by the target's distance: 8 deg, more than half the
#: diagonal of the subframe of a navcam's right camera.
SUBFRAME_RADIUS_FRACTION = 0.14
#: Maximum turn in place between two stereo pairs of visual odometry, radians (MER: Maimone, Cheng & Matthies 2007).
VISUAL_TURN_RAD = np.radians(18.0)
#: Minimum and maximum depth of mapped points, metres, for the mast's cameras and the body cameras.
MAST_RANGES_M, BODY_RANGES_M = (1.4, 8.0), (0.35, 3.0)
#: Azimuth between successive stereo pairs of the mast in a navigation update, radians.
MAST_SPACING_RAD = np.radians(40.0)


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
        """Create the guide at the start; operators triangulate the point in images of the start.

        Raises ValueError if the mast cannot point at the target or the point cannot be triangulated.
        """
        if oracle:
            return cls(margin_px, None)
        stance, rig = run.setup.vehicle.stance, run.setup.rig
        point = run.target.point_world
        angles = mast_angles(np.asarray(stance.world_from_rover.inv().apply(point.copy())), rig.calibrated, False)
        if angles is None:
            raise ValueError("the mast cannot point at the target's rock from the start of this drive")
        rig.point(*angles)
        position = triangulate_point(rig, stance, point)
        return cls(margin_px, np.asarray(run.setup.vehicle.estimated_pose.apply(position)))


Guide = TrackerGuide | DesignationGuide


def run_case(p: RoverScenarioParameters, streams: Streams) -> RoverRun:
    """Simulate a run from the designation of the target to its end."""
    return track_target(p, prepare_run(p, streams))


def prepare_run(
    p: RoverScenarioParameters, streams: Streams, load_ground: LoadGround = SiteGround.from_bank
) -> RoverRun:
    """Create a run at its start and designate its target; the tracker is not called."""
    setup = Setup.draw(p, streams, load_ground)
    return RoverRun(setup, designate_from_start(p, setup.world, setup.rig, setup.vehicle.stance))


def track_target(p: RoverScenarioParameters, run: RoverRun) -> RoverRun:
    """Drive a prepared run to its end, guided by the tracker of the parameters."""
    guide, last_leg = TrackerGuide(p, run, run.setup.vehicle.estimated_pose), p.legs[-1]
    failure = drive_legs(p, run, guide)
    if failure is not None:
        run.outcome = failure
    elif not run.stops[-1].update.tracked:
        run.outcome = RunOutcome.LOST
    else:
        has_goal = not last_leg.ends_with_steps and last_leg.motion in ("approach", "back-off")
        is_complete = not has_goal or is_finished(last_leg, 0, guide.target(run))
        run.outcome = RunOutcome.COMPLETED if is_complete else RunOutcome.NOT_AT_GOAL
    if run.outcome is RunOutcome.COMPLETED and last_leg.motion == "approach":
        goal = GoalCriterion(last_leg.goal_m, 2.0 * GOAL_TOLERANCE_M)
        result = hand_off(run.stops[-1].update, goal, run.setup.rig.calibrated)
        run.handed_off = result.outcome is HandOffOutcome.HANDED_OFF
    return run


def drive_legs(p: RoverScenarioParameters, run: RoverRun, guide: Guide) -> RunOutcome | None:
    """Drive all legs; return the outcome if the run ends early, else None."""
    failure = visit_stop(p, run, guide, -1)
    for number, leg in enumerate(p.legs):
        step_count = 0
        if leg.maps_first and failure is None:
            map_terrain(p, run, leg, guide.target(run))
        while failure is None and not is_finished(leg, step_count, guide.target(run)):
            failure = drive_step(p, run, leg, step_count, guide.target(run)) or visit_stop(p, run, guide, number)
            # a loss at this stop remains a failure of the tracker
            failure = failure or (RunOutcome.STUCK if is_stuck(run.steps, p.mobility) else None)
            step_count += 1
    return failure


def visit_stop(p: RoverScenarioParameters, run: RoverRun, guide: Guide, leg: int) -> RunOutcome | None:
    """Point the mast, take images, and pass them to the guide; return the outcome if the run ends, else None."""
    run.time_s += p.timing.track_s
    aim = guide.aim(run)
    if aim is None:
        return RunOutcome.OUT_OF_REACH
    world, rig, vehicle, time_s = run.setup.world, run.setup.rig, run.setup.vehicle, run.time_s
    rig.point(aim.azimuth_rad, aim.elevation_rad)
    world_from_head = compose(vehicle.stance.world_from_rover, rig.rover_from_head)
    shadow = None
    if p.rover_shadow:
        target, stance = run.target.point_world, vehicle.stance
        radius_m = SUBFRAME_RADIUS_FRACTION * float(np.linalg.norm(target - stance.world_from_rover.translation))
        geometry, sun = rig.calibrated.geometry, world.scene(time_s).sun.direction
        shadow = build_shadow_caster(vehicle.rover, stance, geometry, rig.state.true_rad, target, radius_m, sun)
    cameras, boxes, brightness = (rig.left, rig.right), (aim.left, aim.right), world.brightness(time_s)
    images = run.setup.camera.take(world.scene(time_s), shadow, world_from_head, cameras, boxes, brightness, time_s)
    angles, drives = rig.state.readings_rad, tuple(run.drives_since_stop)
    run.drives_since_stop = []
    view = StopView(leg, time_s, vehicle.stance, vehicle.estimated_pose, angles, world_from_head, images, drives)
    return guide.observe(run, view)


def drive_step(
    p: RoverScenarioParameters, run: RoverRun, leg: LegParameters, step_count: int, target: TargetEstimate
) -> RunOutcome | None:
    """Drive one step of a leg, in parts for visual odometry; return the outcome if the run ends, else None."""
    commands: Iterable[DriveCommand] = plan_step(leg, step_count, target)
    if leg.autonav:
        map_terrain(p, run, leg, target)
        plan = run.navigator.plan(leg, target, run.setup.vehicle.estimated_pose)
        if plan.outcome not in (NavigationOutcome.PATH, NavigationOutcome.AT_GOAL):
            return RunOutcome.NO_PATH
        commands = plan.commands
    start, commanded_m = run.setup.vehicle.stance, 0.0
    for command in commands:
        part_count = 1
        if leg.visual_odometry:
            # 1e-9: tolerance for rounding errors
            parts = max(command.length_m / leg.visual_odometry_step_m, abs(command.turn_left_rad) / VISUAL_TURN_RAD)
            part_count = max(1, int(np.ceil(parts - 1e-9)))
            run.visual_odometry_updates += part_count
            run.time_s += part_count * p.timing.visual_odometry_s
        run.drives_since_stop += [drive_part(p, run, leg, command.part(1.0 / part_count)) for _ in range(part_count)]
        run.time_s += p.timing.drive_s
        commanded_m += command.length_m
    if commanded_m > 0.0:
        ends = (stance.world_from_rover.translation for stance in (start, run.setup.vehicle.stance))
        run.steps.append(Step(commanded_m, float(np.linalg.norm(np.subtract(*ends)))))
    return None


def drive_part(p: RoverScenarioParameters, run: RoverRun, leg: LegParameters, command: DriveCommand) -> Drive:
    """Execute a drive command; with visual odometry, correct the estimated position by the motion between two pairs."""
    vehicle, is_oracle = run.setup.vehicle, p.navigation.odometry == "oracle-motion"
    if not leg.visual_odometry or is_oracle:
        drive = vehicle.drive(command, leg.visual_odometry)
        run.visual_odometry_failures += vehicle.estimate.visual_failed
        return drive
    first, before = take_odometry_pair(p, run), vehicle.estimated_pose
    drive = vehicle.drive(command, False)
    second = take_odometry_pair(p, run)
    result: MotionEstimate = estimate_motion(first, second, compose(before.inv(), vehicle.estimated_pose))
    if result.first_from_second is None:
        run.visual_odometry_failures += 1
    else:
        vehicle.correct_position(np.asarray(before.apply(result.first_from_second.translation)))
    return drive


def take_odometry_pair(p: RoverScenarioParameters, run: RoverRun) -> StereoMeasurement:
    """Take the stereo pair of visual odometry, straight ahead; reuse the last one if the rover has not moved since."""
    stance = run.setup.vehicle.stance
    if run.odometry_pair is None or run.odometry_pair[0] is not stance:
        cameras, time_s = run.setup.navigation_cameras, run.time_s
        pair = cameras.take_mast_pair(
            p, run.setup.world, run.setup.rig, run.setup.vehicle, 0.0, time_s, ODOMETRY_EDGE_RAYS
        )
        run.odometry_pair = stance, pair
    return run.odometry_pair[1]


def map_terrain(p: RoverScenarioParameters, run: RoverRun, leg: LegParameters, target: TargetEstimate) -> None:
    """Add the stereo pairs of a navigation update to the navigator's map.

    The first update also adds the ground under the rover.
    """
    run.autonav_updates += 1
    run.time_s += p.timing.autonav_s
    vehicle, cameras, time_s = run.setup.vehicle, run.setup.navigation_cameras, run.time_s
    estimated_pose = vehicle.estimated_pose
    run.navigator.map_start(estimated_pose, vehicle.rover.enclosing_radius_m)
    ahead = goal_position(leg, target)
    azimuth = -float(np.arctan2(ahead[1], ahead[0]))
    azimuths = [azimuth + (number - 0.5 * (leg.wedges - 1)) * MAST_SPACING_RAD for number in range(leg.wedges)]
    if p.navigation.terrain == "oracle-heights":
        ranges_m, azimuths = (BODY_RANGES_M, [0.0]) if leg.map_by == "body" else (MAST_RANGES_M, azimuths)
        points = [
            oracle_heights(run.setup.world, vehicle, azimuth, ranges_m, leg.map_by == "body") for azimuth in azimuths
        ]
        estimated_from_true = estimated_pose * vehicle.stance.world_from_rover.inv()
        run.navigator.map_points(np.asarray(estimated_from_true.apply(np.concatenate(points))))
    elif leg.map_by == "body":
        run.navigator.map_pair(
            cameras.take_body_pair(run.setup.world, run.setup.rig, vehicle, time_s), estimated_pose, BODY_RANGES_M
        )
    else:
        for azimuth in azimuths:
            pair = cameras.take_mast_pair(p, run.setup.world, run.setup.rig, vehicle, azimuth, time_s)
            run.navigator.map_pair(pair, estimated_pose, MAST_RANGES_M)
