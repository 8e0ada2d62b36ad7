"""Simulate the closed loop of a run: at each stop visual odometry, tracking, navigation and drive, as in Fig. 12.

A guide points the mast at each stop and estimates the target's position. `TrackerGuide` uses a tracker; `TruthGuide`
uses the true position, for drives whose images are used by many trackers.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.answers import check_aim, check_update
from marsyard.algorithms.interface import MastAim, TargetTracker, TrackingState
from marsyard.algorithms.navigation import NavigationOptions, NavigationOutcome, Obstacle, TerrainMap, Wedge, navigate
from marsyard.algorithms.vtt import GoalCriterion, HandOffOutcome, hand_off
from marsyard.algorithms.vtt.pointing import bounding_box, mast_angles
from marsyard.scenarios.algorithm_run import InputCopy, answer_time_s
from marsyard.scenarios.base import LoadGround
from marsyard.scenarios.estimators import TRACKING
from marsyard.scenarios.rover.parameters import LegParameters, RoverScenarioParameters
from marsyard.scenarios.rover.points import cast_rover_shadow
from marsyard.scenarios.rover.stops import DesignatedTarget, RunOutcome, StereoCamera, Stop, View, choose_target
from marsyard.scenarios.rover.world import TARGET, Rig, RunWorld, Vehicle
from marsyard.scenarios.views import SiteGround
from marsyard.sim.dynamics import Drive
from marsyard.sim.frames import compose
from marsyard.sim.measurements import DriveCommand, MastCalibration, RoverMeasurements
from marsyard.sim.streams import Streams

#: Radius of the ground in a subframe around the target, divided by the target's distance: 8 deg, more than half the
#: diagonal of the subframe of a navcam's right camera.
SUBFRAME_RADIUS_FRACTION = 0.14
#: Maximum distance from the goal at the end of an approach or back-off, metres.
GOAL_TOLERANCE_M = 0.03
#: Maximum angle of the goal from straight ahead for an arc; for a larger angle the rover first turns in place.
MAX_ARC_RAD = np.radians(15.0)
#: Mapped wedges of the mast's cameras: half a navcam's field of view of 45 deg, from the end of the rover's deck to the
#: maximum stereo range of rocks; neighbours overlap by 5 deg.
MAST_HALF_RAD, MAST_MIN_M, MAST_MAX_M, MAST_SPACING_RAD = float(np.radians(22.5)), 1.4, 12.0, np.radians(40.0)
#: Mapped wedge of the body cameras (hazcams): half the field of view of 120 deg, from the front wheels.
BODY_HALF_RAD, BODY_MIN_M, BODY_MAX_M = float(np.radians(60.0)), 0.3, 4.0


@dataclass(frozen=True)
class TargetEstimate:
    """On-board estimate of the target's position, used to plan a step."""

    position_rover: Float64[np.ndarray, "3"]  #: latest estimate in the rover frame, metres
    range_m: float  #: distance from the camera

    @property
    def distance_m(self) -> float:
        """Horizontal distance from the rover's origin."""
        return float(np.hypot(*self.position_rover[:2]))


def goal_position(leg: LegParameters, target: TargetEstimate) -> Float64[np.ndarray, "2"]:
    """Compute the goal of the rover's origin, forward and left of its current position, metres.

    The goal is on the line to the target, `goal_m` in front of the target, shifted to the right by `offset_right_m`.
    """
    ahead = target.position_rover[:2] / target.distance_m
    right = np.array([ahead[1], -ahead[0]])
    return np.asarray((target.distance_m - leg.goal_m) * ahead + leg.offset_right_m * right)


def step_length_m(leg: LegParameters, target: TargetEstimate) -> float:
    """Return the maximum step length: a fraction of the target's distance from the camera, or a fixed length."""
    return leg.step_fraction * target.range_m if leg.step_m is None else leg.step_m


def is_finished(leg: LegParameters, step_count: int, target: TargetEstimate) -> bool:
    """Return whether the leg is finished after this number of steps."""
    if step_count >= leg.steps:
        return True
    if leg.motion == "approach":
        return target.distance_m <= leg.goal_m + GOAL_TOLERANCE_M
    return leg.motion == "back-off" and target.distance_m >= leg.goal_m - GOAL_TOLERANCE_M


def plan_step(leg: LegParameters, step_count: int, target: TargetEstimate) -> Iterator[DriveCommand]:
    """Plan the commands of the next step; two commands if the rover turns in place before it drives."""
    if leg.motion == "turn":
        yield DriveCommand(turn_left_rad=-float(np.radians(leg.step_deg)))
        if leg.shuffle_m:
            yield DriveCommand(forward_m=leg.shuffle_m if step_count % 2 == 0 else -leg.shuffle_m)
    elif leg.motion == "circle":
        # a rotation about the target moves the origin perpendicular to the line to the target
        angle = -float(np.radians(leg.step_deg))
        x, y, _ = target.position_rover
        yield DriveCommand(forward_m=angle * float(y), left_m=-angle * float(x), turn_left_rad=angle)
    elif leg.motion == "straight":
        yield DriveCommand(forward_m=step_length_m(leg, target))
    elif leg.motion == "back-off":
        yield DriveCommand(forward_m=-min(step_length_m(leg, target), leg.goal_m - target.distance_m))
    elif leg.motion == "approach":
        yield from plan_drive(goal_position(leg, target), step_length_m(leg, target))


def plan_drive(position: Float64[np.ndarray, "2"], max_length_m: float) -> Iterator[DriveCommand]:
    """Plan a step to a position (forward, left): an arc, or a turn in place and a straight drive."""
    angle = float(np.arctan2(position[1], position[0]))
    chord = float(np.hypot(*position))
    if abs(angle) > MAX_ARC_RAD:
        yield DriveCommand(turn_left_rad=angle)
        yield DriveCommand(forward_m=min(chord, max_length_m))
        return
    # an arc that starts straight ahead turns by twice the angle of its chord
    arc = chord / float(np.sinc(angle / np.pi))
    length = min(arc, max_length_m)
    yield DriveCommand(forward_m=length, turn_left_rad=2.0 * angle * length / arc)


@dataclass
class Setup:
    """A rover at its start with its cameras, before a target is chosen."""

    world: RunWorld
    rig: Rig
    vehicle: Vehicle
    camera: StereoCamera

    @staticmethod
    def draw(p: RoverScenarioParameters, streams: Streams, load_ground: LoadGround) -> Setup:
        """Create the set-up of a run and draw all its errors."""
        rig = Rig.draw(p, streams)
        world = RunWorld.from_parameters(p, rig.pixel_rad, streams, load_ground)
        camera = StereoCamera.draw(p, streams)
        return Setup(world, rig, Vehicle.at_start(p, world, rig, streams), camera)


@dataclass
class Run(Setup):
    """State of a run in progress or finished."""

    target: DesignatedTarget
    stops: list[Stop] = field(default_factory=list)  #: stops with a tracking update, in order
    outcome: RunOutcome = RunOutcome.STUCK
    handed_over: bool = False  #: whether the target was handed over to the arm at the end
    visual_odometry_updates: int = 0
    autonav_updates: int = 0
    terrain: TerrainMap = field(default_factory=TerrainMap)  #: the navigator's map
    time_s: float = 0.0  #: time since the start
    pending: list[Drive] = field(default_factory=list)  #: drives since the last stop

    @classmethod
    def from_setup(cls, setup: Setup, target: DesignatedTarget) -> Run:
        """Create a run with a target, at its start."""
        return cls(setup.world, setup.rig, setup.vehicle, setup.camera, target)

    def estimate_at(self, position_rover: Float64[np.ndarray, "3"]) -> TargetEstimate:
        """Create a target estimate from a position in the rover frame; add its range from the camera."""
        position = np.asarray(position_rover)
        return TargetEstimate(position, self.rig.range_m(position))


class TrackerGuide:
    """The tracker under test as guide: it receives copies of its inputs, and its answers are checked."""

    def __init__(self, p: RoverScenarioParameters, run: Run, estimated: RigidTransform) -> None:
        """Create the tracker and designate the run's target; `estimated` is the rover's estimated world pose."""
        self._tracker: TargetTracker = TRACKING.make(p.algorithm, p.vtt, p.executable)
        self._mast = InputCopy[MastCalibration](run.rig.calibrated)
        self._tracker.designate(InputCopy(run.target.designation).inputs, estimated)

    def aim(self, run: Run) -> MastAim | None:
        """Return the tracker's mast angles and subframe boxes; None if the mast or cameras cannot show the target.

        Raises AlgorithmError for an invalid answer, and the tracker's own errors.
        """
        answer = self._tracker.aim(run.vehicle.estimated, self._mast.inputs)
        self._mast.check()
        return check_aim(answer, run.rig.calibrated)

    def observe(self, run: Run, view: View) -> RunOutcome | None:
        """Update the tracker and append the stop to the run; return the outcome if the run ends, else None.

        Raises the same exceptions as `aim`.
        """
        input_copy = InputCopy((view.images.left, view.images.right))
        measurements = RoverMeasurements(*input_copy.inputs, self._mast.inputs, *view.angles_rad, view.estimated)
        start_s = time.process_time()
        answer = self._tracker.update(measurements)
        elapsed_s = time.process_time() - start_s
        input_copy.check()
        self._mast.check()
        update = check_update(answer)
        time_s = answer_time_s(update, elapsed_s)
        run.stops.append(Stop.from_view(view, run.target.point_world, run.rig.left, update, time_s))
        if update.state is TrackingState.FAILURE:
            return RunOutcome.LOST
        return RunOutcome.NOT_SEEDED if update.position_rover is None else None

    def target(self, run: Run) -> TargetEstimate:
        """Transform the target's last reported position by the estimated motion since that stop."""
        stop = run.stops[-1]
        if stop.update.position_rover is None:
            raise ValueError("the tracker has not reported a target position yet")
        current_from_stop = compose(run.vehicle.estimated.inv(), stop.estimated)
        return run.estimate_at(current_from_stop.apply(np.array(stop.update.position_rover)))


@dataclass(frozen=True)
class TruthGuide:
    """The true target position as guide; stores the views of all stops."""

    margin_px: float
    views: list[View] = field(default_factory=list)

    def aim(self, run: Run) -> MastAim | None:
        """Return an aim at the target; its boxes contain the visible rock above its foot, and a margin."""
        stance, rig = run.vehicle.stance, run.rig
        angles = mast_angles(self.target(run).position_rover, rig.calibrated, use_both=False)
        if angles is None:
            raise ValueError("the mast cannot point at the target's rock from every stop of this drive")
        rig.point(*angles)
        corners = run.world.target_triangles.reshape(-1, 3)
        corners = corners[corners[:, 2] > run.world.rocks.position_m[run.world.target_number, 2]]
        in_head = np.asarray((stance.world_from_rover * rig.rover_from_head).inv().apply(corners.copy()))
        boxes = []
        for camera in (rig.left, rig.right):
            pixels = camera.project(in_head)[0]
            in_frame = pixels[camera.in_frame(pixels)]
            box = bounding_box(in_frame, self.margin_px, camera) if len(in_frame) else None
            if box is None:
                raise ValueError("the camera does not see the target's rock")
            boxes.append(box)
        # the mast does not move if its encoders already read these angles
        return MastAim(*rig.state.readings_rad, *boxes)

    def observe(self, run: Run, view: View) -> RunOutcome | None:
        """Store the view; the run continues."""
        self.views.append(replace(view, leg=0, drives=()))
        return None

    def target(self, run: Run) -> TargetEstimate:
        """Return the true target position."""
        return run.estimate_at(run.vehicle.stance.world_from_rover.inv().apply(run.target.point_world.copy()))


Guide = TrackerGuide | TruthGuide


def run_case(p: RoverScenarioParameters, streams: Streams) -> Run:
    """Simulate a run from the designation of the target to its end."""
    return track_target(p, prepare_run(p, streams))


def prepare_run(p: RoverScenarioParameters, streams: Streams, load_ground: LoadGround = SiteGround.from_bank) -> Run:
    """Create a run at its start and choose its target; the tracker is not called."""
    setup = Setup.draw(p, streams, load_ground)
    return Run.from_setup(setup, choose_target(p, setup.world, setup.rig, setup.vehicle.stance))


def track_target(p: RoverScenarioParameters, run: Run) -> Run:
    """Drive a prepared run to its end, guided by the tracker of the parameters."""
    guide, last = TrackerGuide(p, run, run.vehicle.estimated), p.legs[-1]
    failure = drive_legs(p, run, guide)
    if failure is not None:
        run.outcome = failure
    elif not run.stops[-1].update.found:
        run.outcome = RunOutcome.LOST
    else:
        has_goal = not last.ends_with_steps and last.motion in ("approach", "back-off")
        is_complete = not has_goal or is_finished(last, 0, guide.target(run))
        run.outcome = RunOutcome.COMPLETED if is_complete else RunOutcome.STUCK
    if run.outcome is RunOutcome.COMPLETED and last.motion == "approach":
        goal = GoalCriterion(last.goal_m, 2.0 * GOAL_TOLERANCE_M)
        result = hand_off(run.stops[-1].update, goal, run.rig.calibrated)
        run.handed_over = result.outcome is HandOffOutcome.HANDED_OVER
    return run


def drive_legs(p: RoverScenarioParameters, run: Run, guide: Guide) -> RunOutcome | None:
    """Drive all legs; return the outcome if the run ends early, else None."""
    failure = visit_stop(p, run, guide, -1)
    for number, leg in enumerate(p.legs):
        count = 0
        if leg.maps_first and failure is None:
            map_terrain(p, run, leg, guide.target(run))
        while failure is None and not is_finished(leg, count, guide.target(run)):
            failure = drive_step(p, run, leg, count, guide.target(run)) or visit_stop(p, run, guide, number)
            count += 1
    return failure


def visit_stop(p: RoverScenarioParameters, run: Run, guide: Guide, leg: int) -> RunOutcome | None:
    """Point the mast, take images, and pass them to the guide; return the outcome if the run ends, else None."""
    run.time_s += p.timing.track_s
    aim = guide.aim(run)
    if aim is None:
        return RunOutcome.OUT_OF_REACH
    world, rig, vehicle, time_s = run.world, run.rig, run.vehicle, run.time_s
    rig.point(aim.azimuth_rad, aim.elevation_rad)
    world_from_head = compose(vehicle.stance.world_from_rover, rig.rover_from_head)
    shadow = None
    if p.rover_shadow:
        target, stance = run.target.point_world, vehicle.stance
        radius_m = SUBFRAME_RADIUS_FRACTION * float(np.linalg.norm(target - stance.world_from_rover.translation))
        geometry, sun = rig.calibrated.geometry, world.scene(time_s).sun.direction
        shadow = cast_rover_shadow(vehicle.rover, stance, geometry, rig.state.true_rad, target, radius_m, sun)
    cameras, boxes, brightness = (rig.left, rig.right), (aim.left, aim.right), world.brightness(time_s)
    images = run.camera.take(world.scene(time_s), shadow, world_from_head, cameras, boxes, brightness, time_s)
    angles, drives = rig.state.readings_rad, tuple(run.pending)
    run.pending = []
    view = View(leg, time_s, vehicle.stance, vehicle.estimated, angles, world_from_head, images, drives)
    return guide.observe(run, view)


def drive_step(
    p: RoverScenarioParameters, run: Run, leg: LegParameters, step_count: int, target: TargetEstimate
) -> RunOutcome | None:
    """Drive one step of a leg, in parts for visual odometry; return the outcome if the run ends, else None."""
    commands: Iterable[DriveCommand] = plan_step(leg, step_count, target)
    if leg.autonav:
        map_terrain(p, run, leg, target)
        estimated, step_m = run.vehicle.estimated, step_length_m(leg, target)
        goal = estimated.translation + estimated.rotation.as_matrix() @ np.array([*goal_position(leg, target), 0.0])
        ignored_rock = TARGET if leg.target_is_no_obstacle else None
        options = NavigationOptions(half_width_m=0.6)
        plan = navigate(run.terrain, estimated, np.asarray(goal[:2]), step_m, options, ignored_rock)
        if plan.outcome not in (NavigationOutcome.PATH, NavigationOutcome.AT_GOAL):
            return RunOutcome.NO_PATH
        commands = plan.commands
    for command in commands:
        count = 1
        if leg.visual_odometry:
            count = max(1, int(np.ceil(command.length_m / leg.visual_odometry_step_m - 1e-9)))
            run.visual_odometry_updates += count
            run.time_s += count * p.timing.visual_odometry_s
        run.pending += [run.vehicle.drive(command.part(1.0 / count), leg.visual_odometry) for _ in range(count)]
        run.time_s += p.timing.drive_s
    return None


def map_terrain(p: RoverScenarioParameters, run: Run, leg: LegParameters, target: TargetEstimate) -> None:
    """Add the wedges of a navigation update, and the rocks at their estimated positions, to the navigator's map.

    The first update also adds a disc around the rover.
    """
    run.autonav_updates += 1
    run.time_s += p.timing.autonav_s
    rover, estimated, rocks = run.vehicle.rover, run.vehicle.estimated, run.world.rocks
    estimated_from_true = estimated * run.vehicle.stance.world_from_rover.inv()
    obstacles = []
    for name, number in rocks.names.items():
        centre = np.asarray(estimated_from_true.apply(rocks.position_m[number].copy()))[:2]
        obstacles.append(Obstacle(name, centre, 0.5 * float(rocks.diameter_m[number]), float(rocks.height_m[number])))
    position, forward = estimated.translation[:2], estimated.rotation.as_matrix()[:2, 0]
    heading = float(np.arctan2(forward[0], forward[1]))
    radius_m = rover.enclosing_radius_m + 0.3
    wedges = [] if run.terrain.wedges else [Wedge(position.copy(), 0.0, float(np.pi), 0.0, radius_m)]
    if leg.map_by == "body":
        apex = np.asarray(position + rover.front_m * forward)
        wedges.append(Wedge(apex, heading, BODY_HALF_RAD, BODY_MIN_M, BODY_MAX_M))
    else:
        ahead = goal_position(leg, target)
        azimuth = heading - float(np.arctan2(ahead[1], ahead[0]))
        for number in range(leg.wedges):
            wedge_azimuth = float(azimuth + (number - 0.5 * (leg.wedges - 1)) * MAST_SPACING_RAD)
            wedges.append(Wedge(position.copy(), wedge_azimuth, MAST_HALF_RAD, MAST_MIN_M, MAST_MAX_M))
    for wedge in wedges:
        run.terrain = run.terrain.add_wedge(wedge, tuple(obstacles))
