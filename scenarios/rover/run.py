"""The closed loop of a run: at each stop visual odometry, tracking, navigation, drive, in the order of Fig. 12.

A guide decides where the mast points at a stop, and estimates where the target is: a tracker (`TrackerGuide`), or the
truth (`TruthGuide`), for drives whose pictures many trackers share.
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
from marsyard.algorithms.vtt import GoalReached, HandOffOutcome, hand_off
from marsyard.algorithms.vtt.pointing import box_around, mast_angles
from marsyard.scenarios.algorithm_run import Handover, answer_time_s
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

#: Radius about the target that a subframe shows, over its distance: 8 deg are more than half the diagonal of the
#: subframe of a navcam's right camera.
SUBFRAME_RADIUS_FRACTION = 0.14
#: An approach or retreat ends this near to its goal, metres.
GOAL_TOLERANCE_M = 0.03
#: The rover turns in place towards a goal beyond this direction; within, the step is an arc.
MAX_ARC_RAD = np.radians(15.0)
#: Wedges of the mast's cameras: half the 45 deg of a navcam, between where the rover's own deck ends and where stereo
#: still ranges rocks; neighbours overlap by 5 deg. Of the body's: half of 120 deg, from the front wheels on (hazcams).
MAST_HALF_RAD, MAST_MIN_M, MAST_MAX_M, MAST_SPACING_RAD = float(np.radians(22.5)), 1.4, 12.0, np.radians(40.0)
BODY_HALF_RAD, BODY_MIN_M, BODY_MAX_M = float(np.radians(60.0)), 0.3, 4.0


@dataclass(frozen=True)
class TargetEstimate:
    """Target position as the on-board computer has it when it plans a step."""

    position_rover: Float64[np.ndarray, "3"]  #: latest estimate in the rover frame, metres
    range_m: float  #: from the camera to it

    @property
    def distance_m(self) -> float:
        """Horizontal distance from the rover's origin."""
        return float(np.hypot(*self.position_rover[:2]))


def goal_position(leg: LegParameters, target: TargetEstimate) -> Float64[np.ndarray, "2"]:
    """Final position of the rover's origin: forward and left of the present one, metres.

    On the line to the target, `goal_m` before it, and to the right of that by the offset.
    """
    ahead = target.position_rover[:2] / target.distance_m
    right = np.array([ahead[1], -ahead[0]])
    return np.asarray((target.distance_m - leg.goal_m) * ahead + leg.offset_right_m * right)


def step_length_m(leg: LegParameters, target: TargetEstimate) -> float:
    """Longest step: a fraction of the target's distance from the camera, or a length."""
    return leg.step_fraction * target.range_m if leg.step_m is None else leg.step_m


def is_finished(leg: LegParameters, done: int, target: TargetEstimate) -> bool:
    """Whether the leg has come to its end after this number of steps."""
    if done >= leg.steps:
        return True
    if leg.motion == "approach":
        return target.distance_m <= leg.goal_m + GOAL_TOLERANCE_M
    return leg.motion == "back-off" and target.distance_m >= leg.goal_m - GOAL_TOLERANCE_M


def step_commands(leg: LegParameters, done: int, target: TargetEstimate) -> Iterator[DriveCommand]:
    """Plan the commands of the next step; more than one where it turns in place before it drives."""
    if leg.motion == "turn":
        yield DriveCommand(turn_left_rad=-float(np.radians(leg.step_deg)))
        if leg.shuffle_m:
            yield DriveCommand(forward_m=leg.shuffle_m if done % 2 == 0 else -leg.shuffle_m)
    elif leg.motion == "circle":
        # a rotation about the target moves the origin across the line to it
        turn = -float(np.radians(leg.step_deg))
        x, y, _ = target.position_rover
        yield DriveCommand(forward_m=turn * float(y), left_m=-turn * float(x), turn_left_rad=turn)
    elif leg.motion == "straight":
        yield DriveCommand(forward_m=step_length_m(leg, target))
    elif leg.motion == "back-off":
        yield DriveCommand(forward_m=-min(step_length_m(leg, target), leg.goal_m - target.distance_m))
    elif leg.motion == "approach":
        yield from drive_towards(goal_position(leg, target), step_length_m(leg, target))


def drive_towards(position: Float64[np.ndarray, "2"], max_length_m: float) -> Iterator[DriveCommand]:
    """Plan a step to a position (forward, left): the arc to it, or a turn in place and a straight drive."""
    angle = float(np.arctan2(position[1], position[0]))
    chord = float(np.hypot(*position))
    if abs(angle) > MAX_ARC_RAD:
        yield DriveCommand(turn_left_rad=angle)
        yield DriveCommand(forward_m=min(chord, max_length_m))
        return
    # an arc that starts ahead turns by twice the angle of its chord
    path = chord / float(np.sinc(angle / np.pi))
    length = min(path, max_length_m)
    yield DriveCommand(forward_m=length, turn_left_rad=2.0 * angle * length / path)


@dataclass
class Setup:
    """A rover at its start with its cameras, before a target is chosen."""

    world: RunWorld
    rig: Rig
    vehicle: Vehicle
    camera: StereoCamera

    @staticmethod
    def of(p: RoverScenarioParameters, streams: Streams, load_ground: LoadGround) -> Setup:
        """Create the set-up of a run and draw all its errors."""
        rig = Rig.of(p, streams)
        world = RunWorld.of(p, rig.pixel_rad, streams, load_ground)
        camera = StereoCamera.draw(p, streams)
        return Setup(world, rig, Vehicle.at_start(p, world, rig, streams), camera)


@dataclass
class Run(Setup):
    """A run in progress, or finished."""

    target: DesignatedTarget
    stops: list[Stop] = field(default_factory=list)  #: those at which the target was tracked, in order
    outcome: RunOutcome = RunOutcome.STUCK
    handed_over: bool = False  #: whether the arm would have been given the target at the end
    visual_odometry_updates: int = 0
    autonav_updates: int = 0
    terrain: TerrainMap = field(default_factory=TerrainMap)  #: the navigator's map
    time_s: float = 0.0  #: since the start
    pending: list[Drive] = field(default_factory=list)  #: drives since the last stop

    @classmethod
    def at(cls, setup: Setup, target: DesignatedTarget) -> Run:
        """A run towards a target, at its start."""
        return cls(setup.world, setup.rig, setup.vehicle, setup.camera, target)

    def estimate_at(self, position_rover: Float64[np.ndarray, "3"]) -> TargetEstimate:
        """A position in the rover frame with its range from the camera."""
        position = np.asarray(position_rover)
        return TargetEstimate(position, self.rig.range_m(position))


class TrackerGuide:
    """The tracker under test as guide: inputs are handed over as copies, answers are checked."""

    def __init__(self, p: RoverScenarioParameters, run: Run, estimated: RigidTransform) -> None:
        """Make the tracker of the parameters; the run's target is designated at the rover's estimated pose."""
        self._tracker: TargetTracker = TRACKING.make(p.algorithm, p.vtt, p.executable)
        self._mast = Handover[MastCalibration](run.rig.calibrated)
        self._tracker.designate(Handover(run.target.designation).given, estimated)

    def aim(self, run: Run) -> MastAim | None:
        """Mast angles and boxes of the frames; None where the target is out of reach.

        Raises AlgorithmError for a bad answer, and the tracker's own errors.
        """
        answer = self._tracker.aim(run.vehicle.estimated, self._mast.given)
        self._mast.check()
        return check_aim(answer, run.rig.calibrated)

    def observe(self, run: Run, view: View) -> RunOutcome | None:
        """Update the tracker and append the stop to the run; return why the run is over, or None. Raises as `aim`."""
        handover = Handover((view.pictures.left, view.pictures.right))
        measurements = RoverMeasurements(*handover.given, self._mast.given, *view.angles_rad, view.estimated)
        started = time.process_time()
        answer = self._tracker.update(measurements)
        elapsed_s = time.process_time() - started
        handover.check()
        self._mast.check()
        update = check_update(answer)
        run.stops.append(Stop.of(view, run.target.point_world, run.rig.left, update, answer_time_s(update, elapsed_s)))
        if update.state is TrackingState.FAILURE:
            return RunOutcome.LOST
        return RunOutcome.NOT_SEEDED if update.position_rover is None else None

    def target(self, run: Run) -> TargetEstimate:
        """The target's last reported position, transformed by the estimated motion since."""
        stop = run.stops[-1]
        if stop.update.position_rover is None:
            raise ValueError("the target was not seen yet")
        here = compose(run.vehicle.estimated.inv(), stop.estimated)
        return run.estimate_at(here.apply(np.array(stop.update.position_rover)))


@dataclass(frozen=True)
class TruthGuide:
    """The true target position as guide; stores the views."""

    margin_px: float
    views: list[View] = field(default_factory=list)

    def aim(self, run: Run) -> MastAim | None:
        """Point at the target; the boxes hold what each frame shows of the rock above its foot, and a margin."""
        stance, rig = run.vehicle.stance, run.rig
        angles = mast_angles(self.target(run).position_rover, rig.calibrated, pair=False)
        if angles is None:
            raise ValueError("the mast cannot point at the target's rock from every stop of this drive")
        rig.point(*angles)
        corners = run.world.target_triangles.reshape(-1, 3)
        corners = corners[corners[:, 2] > run.world.rocks.position_m[run.world.target_number, 2]]
        in_head = np.asarray((stance.world_from_rover * rig.rover_from_head).inv().apply(corners.copy()))
        boxes = []
        for camera in (rig.left, rig.right):
            pixels = camera.project(in_head)[0]
            visible = pixels[camera.in_frame(pixels)]
            box = box_around(visible, self.margin_px, camera) if len(visible) else None
            if box is None:
                raise ValueError("the camera does not see the target's rock")
            boxes.append(box)
        # the mast stays where its encoders read these angles
        return MastAim(*rig.state.readings_rad, *boxes)

    def observe(self, run: Run, view: View) -> RunOutcome | None:
        """Store the pictures."""
        self.views.append(replace(view, leg=0, drives=()))
        return None

    def target(self, run: Run) -> TargetEstimate:
        """The true target position."""
        return run.estimate_at(run.vehicle.stance.world_from_rover.inv().apply(run.target.point_world.copy()))


Guide = TrackerGuide | TruthGuide


def run_case(p: RoverScenarioParameters, streams: Streams) -> Run:
    """Simulate a run, from the designation of the target to its end."""
    return track_target(p, prepare_run(p, streams))


def prepare_run(p: RoverScenarioParameters, streams: Streams, load_ground: LoadGround = SiteGround.from_bank) -> Run:
    """Create a run at its start, the target chosen, before the tracker is called."""
    setup = Setup.of(p, streams, load_ground)
    return Run.at(setup, choose_target(p, setup.world, setup.rig, setup.vehicle.stance))


def track_target(p: RoverScenarioParameters, run: Run) -> Run:
    """Drive a prepared run to its end, guided by the tracker of the parameters."""
    guide, last = TrackerGuide(p, run, run.vehicle.estimated), p.legs[-1]
    failed = drive_legs(p, run, guide)
    if failed is not None:
        run.outcome = failed
    elif not run.stops[-1].update.found:
        run.outcome = RunOutcome.LOST
    else:
        has_goal = not last.ends_with_steps and last.motion in ("approach", "back-off")
        reached = not has_goal or is_finished(last, 0, guide.target(run))
        run.outcome = RunOutcome.COMPLETED if reached else RunOutcome.STUCK
    if run.outcome is RunOutcome.COMPLETED and last.motion == "approach":
        goal = GoalReached(last.goal_m, 2.0 * GOAL_TOLERANCE_M)
        handed = hand_off(run.stops[-1].update, goal, run.rig.calibrated)
        run.handed_over = handed.outcome is HandOffOutcome.HANDED_OVER
    return run


def drive_legs(p: RoverScenarioParameters, run: Run, guide: Guide) -> RunOutcome | None:
    """Drive all legs; return why the run ended early, or None."""
    failed = visit_stop(p, run, guide, -1)
    for number, leg in enumerate(p.legs):
        done = 0
        if leg.maps_first and failed is None:
            map_terrain(p, run, leg, guide.target(run))
        while failed is None and not is_finished(leg, done, guide.target(run)):
            failed = drive_step(p, run, leg, done, guide.target(run)) or visit_stop(p, run, guide, number)
            done += 1
    return failed


def visit_stop(p: RoverScenarioParameters, run: Run, guide: Guide, leg: int) -> RunOutcome | None:
    """Point the mast, take pictures, and hand them to the guide; return why the run is over, or None."""
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
    cameras, boxes, light = (rig.left, rig.right), (aim.left, aim.right), world.brightness(time_s)
    pictures = run.camera.take(world.scene(time_s), shadow, world_from_head, cameras, boxes, light, time_s)
    angles, drives = rig.state.readings_rad, tuple(run.pending)
    run.pending = []
    view = View(leg, time_s, vehicle.stance, vehicle.estimated, angles, world_from_head, pictures, drives)
    return guide.observe(run, view)


def drive_step(
    p: RoverScenarioParameters, run: Run, leg: LegParameters, done: int, target: TargetEstimate
) -> RunOutcome | None:
    """Drive one step of a leg, in parts that visual odometry can link; return why the run is over, or None."""
    commands: Iterable[DriveCommand] = step_commands(leg, done, target)
    if leg.autonav:
        map_terrain(p, run, leg, target)
        estimated, step_m = run.vehicle.estimated, step_length_m(leg, target)
        goal = estimated.translation + estimated.rotation.as_matrix() @ np.array([*goal_position(leg, target), 0.0])
        ignored = TARGET if leg.target_is_no_obstacle else None
        options = NavigationOptions(half_width_m=0.6)
        plan = navigate(run.terrain, estimated, np.asarray(goal[:2]), step_m, options, ignored)
        if plan.outcome not in (NavigationOutcome.PATH, NavigationOutcome.AT_GOAL):
            return RunOutcome.NO_PATH
        commands = plan.commands
    for command in commands:
        parts = 1
        if leg.visual_odometry:
            parts = max(1, int(np.ceil(command.length_m / leg.visual_odometry_step_m - 1e-9)))
            run.visual_odometry_updates += parts
            run.time_s += parts * p.timing.visual_odometry_s
        run.pending += [run.vehicle.drive(command.part(1.0 / parts), leg.visual_odometry) for _ in range(parts)]
        run.time_s += p.timing.drive_s
    return None


def map_terrain(p: RoverScenarioParameters, run: Run, leg: LegParameters, target: TargetEstimate) -> None:
    """Add the wedges of a navigation update to the map, with the rocks in them at their estimated positions.

    The ground below the rover at the start is known.
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
    wedges = [] if run.terrain.wedges else [Wedge(position.copy(), 0.0, float(np.pi), 0.0, rover.reach_m + 0.3)]
    if leg.map_by == "body":
        apex = np.asarray(position + rover.front_m * forward)
        wedges.append(Wedge(apex, heading, BODY_HALF_RAD, BODY_MIN_M, BODY_MAX_M))
    else:
        ahead = goal_position(leg, target)
        towards = heading - float(np.arctan2(ahead[1], ahead[0]))
        for number in range(leg.wedges):
            middle = float(towards + (number - 0.5 * (leg.wedges - 1)) * MAST_SPACING_RAD)
            wedges.append(Wedge(position.copy(), middle, MAST_HALF_RAD, MAST_MIN_M, MAST_MAX_M))
    for wedge in wedges:
        run.terrain = run.terrain.add_wedge(wedge, tuple(obstacles))
