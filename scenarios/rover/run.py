"""The closed loop of a run: at each stop visual odometry, tracking, navigation, drive, in the order of Fig. 12.

A guide decides where the mast points at a stop, and where the target is believed to be: a tracker (`TrackerGuide`), or
the truth, for drives whose pictures many trackers share (`marsyard.scenarios.rover.shared`).
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.answers import check_aim, check_update
from marsyard.algorithms.interface import MastAim, TargetTracker, TrackingState
from marsyard.algorithms.navigation import NavigationOutcome
from marsyard.algorithms.vtt import GoalReached, HandOffOutcome, hand_off
from marsyard.scenarios.algorithm_run import answer_time_s
from marsyard.scenarios.base import LoadGround
from marsyard.scenarios.estimators import TRACKING
from marsyard.scenarios.handover import Handover
from marsyard.scenarios.rover.parameters import LegParameters, RoverScenarioParameters
from marsyard.scenarios.rover.pictures import Detectors, Photographer
from marsyard.scenarios.rover.route import GOAL_TOLERANCE_M, Belief, Mapper, is_finished, step_commands
from marsyard.scenarios.rover.stops import RunOutcome, Stop, View
from marsyard.scenarios.rover.target import ChosenTarget, choose_target
from marsyard.scenarios.rover.vehicle import Rig, Vehicle
from marsyard.scenarios.rover.world import RunWorld
from marsyard.scenarios.views import SiteGround
from marsyard.sim.dynamics.driving import Drive
from marsyard.sim.frames import compose
from marsyard.sim.measurements import DriveCommand, MastCalibration, RoverMeasurements
from marsyard.sim.streams import Streams


@dataclass
class Setup:
    """A rover at its start with its cameras, before a target is chosen."""

    world: RunWorld
    rig: Rig
    vehicle: Vehicle
    photographer: Photographer

    @staticmethod
    def of(p: RoverScenarioParameters, streams: Streams, load_ground: LoadGround = SiteGround.from_bank) -> Setup:
        """The set-up of a run, all its errors drawn."""
        rig = Rig.of(p, streams)
        world = RunWorld.of(p, rig.pixel_rad, streams, load_ground)
        detectors = Detectors.drawn(p.camera, streams.generator("detector response"))
        photographer = Photographer(p.backend, detectors, p.exposure, streams.generator("detector noise"))
        return Setup(world, rig, Vehicle.at_start(p, world, rig, streams), photographer)


@dataclass
class Run(Setup):
    """A run in progress, or finished."""

    target: ChosenTarget
    stops: list[Stop] = field(default_factory=list)  #: those at which the target was tracked, in order
    outcome: RunOutcome = RunOutcome.STUCK
    handed_over: bool = False  #: whether the arm would have been given the target at the end
    visual_odometry_updates: int = 0
    autonav_updates: int = 0
    mapper: Mapper = field(default_factory=Mapper)
    time_s: float = 0.0  #: since the start
    pending: list[Drive] = field(default_factory=list)  #: drives since the last stop

    @classmethod
    def at(cls, setup: Setup, target: ChosenTarget) -> Run:
        """A run towards a target, at its start."""
        return cls(setup.world, setup.rig, setup.vehicle, setup.photographer, target)

    def true_belief(self) -> Belief:
        """The target's true position from the rover."""
        return self._belief(self.vehicle.stance.world_from_rover.inv().apply(self.target.point_world.copy()))

    def tracked_belief(self) -> Belief:
        """The target's last reported position, moved by the estimated motion since."""
        stop = self.stops[-1]
        if stop.update.position_rover is None:
            raise ValueError("the target was not seen yet")
        here = compose(self.vehicle.estimated.inv(), stop.estimated)
        return self._belief(here.apply(np.array(stop.update.position_rover)))

    def _belief(self, position_rover: Float64[np.ndarray, "3"]) -> Belief:
        position = np.asarray(position_rover)
        return Belief(position, self.rig.range_m(position))


class Guide(Protocol):
    """Source of the mast's aim and of the believed target position."""

    def aim(self, run: Run) -> MastAim | None:
        """Mast angles, and which parts of the frames are taken; None where the target is out of reach."""

    def observe(self, run: Run, view: View) -> RunOutcome | None:
        """Process the pictures of a stop; return why the run is over, or None."""

    def belief(self, run: Run) -> Belief:
        """The believed target position."""


class TrackerGuide:
    """The tracker under test as guide: inputs are handed over as copies, answers are checked."""

    def __init__(self, p: RoverScenarioParameters, run: Run, estimated: RigidTransform) -> None:
        """Make the tracker of the parameters; the run's target is designated at the rover's estimated pose."""
        self._tracker: TargetTracker = TRACKING.make(p.algorithm, p.vtt, p.executable)
        self._mast = Handover[MastCalibration](run.rig.calibrated)
        self._tracker.designate(Handover(run.target.designation).given, estimated)

    def aim(self, run: Run) -> MastAim | None:
        """See `Guide`. Raises AlgorithmError for a bad answer, and the tracker's own errors."""
        answer = self._tracker.aim(run.vehicle.estimated, self._mast.given)
        self._mast.check()
        return check_aim(answer, run.rig.calibrated)

    def observe(self, run: Run, view: View) -> RunOutcome | None:
        """Update the tracker and append the stop to the run; raises as `aim`."""
        handover = Handover((view.pictures.left, view.pictures.right))
        measurements = RoverMeasurements(*handover.given, self._mast.given, *view.angles_rad, view.estimated)
        started = time.process_time()
        answer = self._tracker.update(measurements)
        taken_s = time.process_time() - started
        handover.check()
        self._mast.check()
        update = check_update(answer)
        run.stops.append(Stop.of(view, run.target.point_world, run.rig.left, update, answer_time_s(update, taken_s)))
        if update.state is TrackingState.FAILURE:
            return RunOutcome.LOST
        return RunOutcome.NOT_SEEDED if update.position_rover is None else None

    def belief(self, run: Run) -> Belief:
        """See `Guide`."""
        return run.tracked_belief()


def run_case(p: RoverScenarioParameters, streams: Streams) -> Run:
    """A run, from the designation of the target to its end."""
    run = prepare_run(p, streams)
    track_target(p, run)
    return run


def prepare_run(p: RoverScenarioParameters, streams: Streams, load_ground: LoadGround = SiteGround.from_bank) -> Run:
    """A run at its start, the target chosen, before the tracker is called."""
    setup = Setup.of(p, streams, load_ground)
    return Run.at(setup, choose_target(p, setup.world, setup.rig, setup.vehicle.stance))


def track_target(p: RoverScenarioParameters, run: Run) -> None:
    """Drive a prepared run to its end, guided by the tracker of the parameters."""
    failed, last = drive_legs(p, run, TrackerGuide(p, run, run.vehicle.estimated)), p.legs[-1]
    if failed is not None:
        run.outcome = failed
    elif not run.stops[-1].update.found:
        run.outcome = RunOutcome.LOST
    else:
        run.outcome = RunOutcome.COMPLETED if _is_at_goal(last, run.tracked_belief()) else RunOutcome.STUCK
    if run.outcome is RunOutcome.COMPLETED and last.motion == "approach":
        reached = GoalReached(last.goal_m, 2.0 * GOAL_TOLERANCE_M)
        handed = hand_off(run.stops[-1].update, reached, run.rig.calibrated)
        run.handed_over = handed.outcome is HandOffOutcome.HANDED_OVER


def drive_legs(p: RoverScenarioParameters, run: Run, guide: Guide) -> RunOutcome | None:
    """Drive all legs; return why the run ended early, or None."""
    failed = visit_stop(p, run, guide, -1)
    for number, leg in enumerate(p.legs):
        done = 0
        if leg.maps_first and failed is None:
            _map(p, run, leg, guide.belief(run))
        while failed is None and not is_finished(leg, done, guide.belief(run)):
            failed = _step(p, run, guide, leg, done) or visit_stop(p, run, guide, number)
            done += 1
    return failed


def visit_stop(p: RoverScenarioParameters, run: Run, guide: Guide, leg: int) -> RunOutcome | None:
    """Point, take pictures, and hand them to the guide; return why the run is over, or None."""
    run.time_s += p.timing.track_s
    aim = guide.aim(run)
    if aim is None:
        return RunOutcome.OUT_OF_REACH
    view = _take_view(p, run, aim, leg)
    run.pending = []
    return guide.observe(run, view)


def _take_view(p: RoverScenarioParameters, run: Run, aim: MastAim, leg: int) -> View:
    world, rig, vehicle, time_s = run.world, run.rig, run.vehicle, run.time_s
    rig.point(aim.azimuth_rad, aim.elevation_rad)
    stance, point = vehicle.stance, run.target.point_world
    world_from_head = compose(stance.world_from_rover, rig.rover_from_head)
    shadow = None
    if p.rover_shadow:
        shadow = world.shadow_caster(vehicle.rover, stance, rig.calibrated.geometry, rig.state.true_rad, point, time_s)
    light = world.brightness(time_s)
    pictures = run.photographer.take(
        world.scene(time_s), shadow, world_from_head, (rig.left, rig.right), (aim.left, aim.right), light, time_s
    )
    angles = rig.state.readings_rad
    return View(leg, time_s, stance, vehicle.estimated, angles, world_from_head, pictures, tuple(run.pending))


def _step(p: RoverScenarioParameters, run: Run, guide: Guide, leg: LegParameters, done: int) -> RunOutcome | None:
    """Drive one step of a leg; return why the run is over, or None."""
    belief = guide.belief(run)
    commands: Iterable[DriveCommand] = step_commands(leg, done, belief)
    if leg.autonav:
        _map(p, run, leg, belief)
        plan = run.mapper.plan(leg, belief, run.vehicle.estimated)
        if plan.outcome not in (NavigationOutcome.PATH, NavigationOutcome.AT_GOAL):
            return RunOutcome.NO_PATH
        commands = plan.commands
    for command in commands:
        _drive(p, run, leg, command)
    return None


def _map(p: RoverScenarioParameters, run: Run, leg: LegParameters, belief: Belief) -> None:
    """Take the pictures of a navigation update."""
    vehicle = run.vehicle
    run.autonav_updates += 1
    run.time_s += p.timing.autonav_s
    run.mapper.sense(leg, belief, run.world, vehicle.rover, vehicle.stance, vehicle.estimated)


def _drive(p: RoverScenarioParameters, run: Run, leg: LegParameters, command: DriveCommand) -> None:
    """Drive a command, split so that visual odometry can link the pictures of its parts."""
    parts = 1
    if leg.visual_odometry:
        parts = max(1, int(np.ceil(command.length_m / leg.visual_odometry_step_m - 1e-9)))
        run.visual_odometry_updates += parts
        run.time_s += parts * p.timing.visual_odometry_s
    run.pending += [run.vehicle.drive(command.part(1.0 / parts), leg.visual_odometry) for _ in range(parts)]
    run.time_s += p.timing.drive_s


def _is_at_goal(leg: LegParameters, belief: Belief) -> bool:
    """Whether the last leg has reached its goal, if it has one."""
    if leg.ends_with_steps or leg.motion not in ("approach", "back-off"):
        return True
    return is_finished(leg, 0, belief)
