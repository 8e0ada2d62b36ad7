"""One closed loop: at each stop visual odometry, tracking, navigation, drive, in the order of the paper's Fig. 12."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from marsyard.algorithms.interface import MastAim, TrackingState
from marsyard.algorithms.navigation import NavigationOutcome
from marsyard.algorithms.vtt import GoalReached, HandOffOutcome, hand_off
from marsyard.scenarios.estimators import TRACKING
from marsyard.scenarios.rover.guarded import GuardedTracker
from marsyard.scenarios.rover.mapping import Mapper
from marsyard.scenarios.rover.parameters import LegParameters, RoverScenarioParameters
from marsyard.scenarios.rover.pictures import Detectors, Photographer
from marsyard.scenarios.rover.rig import Rig
from marsyard.scenarios.rover.route import GOAL_TOLERANCE_M, Belief, commands, finished
from marsyard.scenarios.rover.stops import RunOutcome, Stop
from marsyard.scenarios.rover.target import ChosenTarget, choose_target
from marsyard.scenarios.rover.vehicle import Vehicle
from marsyard.scenarios.rover.world import RunWorld
from marsyard.sim.dynamics.driving import Drive
from marsyard.sim.frames import composed
from marsyard.sim.measurements import DriveCommand
from marsyard.sim.streams import Streams


@dataclass
class Run:
    """A run under way, or over.

    Attributes
    ----------
    world, rig, vehicle
        What it happens with.
    target
        The designated point.
    stops
        Those at which the target was tracked, in order.
    outcome
        How it ended.
    handed_over
        Whether the arm would have been given the target at the end.
    visual_odometry_updates, autonav_updates
        How many there were.
    mapper
        The navigator's map.
    time_s
        Since the start.
    pending
        What was driven since the last stop.
    """

    world: RunWorld
    rig: Rig
    vehicle: Vehicle
    target: ChosenTarget
    stops: list[Stop] = field(default_factory=list)
    outcome: RunOutcome = RunOutcome.STUCK
    handed_over: bool = False
    visual_odometry_updates: int = 0
    autonav_updates: int = 0
    mapper: Mapper = field(default_factory=Mapper)
    time_s: float = 0.0
    pending: list[Drive] = field(default_factory=list)


def run_case(p: RoverScenarioParameters, streams: Streams) -> Run:
    """A run, from the designation of the target to its end."""
    run = prepare_run(p, streams)
    track_target(p, run, streams)
    return run


def prepare_run(p: RoverScenarioParameters, streams: Streams) -> Run:
    """A run before a tracker has been asked: everything in its place, the target chosen."""
    rig = Rig.of(p, streams)
    world = RunWorld.of(p, rig.pixel_rad, streams)
    vehicle = Vehicle.placed(p, world, rig, streams)
    return Run(world, rig, vehicle, choose_target(p, world, rig, vehicle.stance))


def track_target(p: RoverScenarioParameters, run: Run, streams: Streams) -> None:
    """Drives a prepared run to its end by what the tracker of the parameters answers."""
    photographer = Photographer(
        p.backend,
        Detectors.drawn(p.camera, streams.generator("detector response")),
        p.exposure,
        streams.generator("detector noise"),
    )
    tracker = GuardedTracker(TRACKING.make(p.algorithm, p.vtt, p.executable), run.rig.calibrated)
    tracker.designate(run.target.designation, run.vehicle.estimated)
    run.outcome = _Loop(p, run, tracker, photographer).outcome()
    if run.outcome is RunOutcome.COMPLETED:
        last = p.legs[-1]
        if last.motion == "approach":
            reached = GoalReached(last.goal_m, 2.0 * GOAL_TOLERANCE_M)
            handed = hand_off(run.stops[-1].update, reached, run.rig.calibrated)
            run.handed_over = handed.outcome is HandOffOutcome.HANDED_OVER


@dataclass
class _Loop:
    """The parts of the loop, and what they share."""

    p: RoverScenarioParameters
    run: Run
    tracker: GuardedTracker
    photographer: Photographer

    def outcome(self) -> RunOutcome:
        """Goes through all legs; how the run ends."""
        failed = self._track(-1)
        if failed is not None:
            return failed
        for number, leg in enumerate(self.p.legs):
            done = 0
            if leg.maps_first:
                self._map(leg)
            while not finished(leg, done, self._belief()):
                failed = self._step(number, leg, done)
                if failed is not None:
                    return failed
                done += 1
        if not self.run.stops[-1].update.found:
            return RunOutcome.LOST
        return RunOutcome.COMPLETED if _reached(self.p.legs[-1], self._belief()) else RunOutcome.STUCK

    def _step(self, number: int, leg: LegParameters, done: int) -> RunOutcome | None:
        """One step of a leg and the update after it."""
        told: Iterable[DriveCommand] = commands(leg, done, self._belief())
        if leg.autonav:
            self._map(leg)
            plan = self.run.mapper.plan(leg, self._belief(), self.run.vehicle.estimated)
            if plan.outcome not in (NavigationOutcome.PATH, NavigationOutcome.AT_GOAL):
                return RunOutcome.NO_PATH
            told = plan.commands
        for command in told:
            self._drive(leg, command)
        return self._track(number)

    def _map(self, leg: LegParameters) -> None:
        """Takes the pictures of a navigation update."""
        run, vehicle = self.run, self.run.vehicle
        run.autonav_updates += 1
        run.time_s += self.p.timing.autonav_s
        run.mapper.sense(leg, self._belief(), run.world, vehicle.rover, vehicle.stance, vehicle.estimated)

    def _drive(self, leg: LegParameters, command: DriveCommand) -> None:
        run, timing = self.run, self.p.timing
        parts = max(1, int(np.ceil(command.length_m / leg.visual_odometry_step_m - 1e-9))) if leg.visual_odometry else 1
        for _ in range(parts):
            run.pending.append(run.vehicle.drive(command.part(1.0 / parts), leg.visual_odometry))
        if leg.visual_odometry:
            run.visual_odometry_updates += parts
            run.time_s += parts * timing.visual_odometry_s
        run.time_s += timing.drive_s

    def _belief(self) -> Belief:
        """Where the target is believed to be from here: as last reported, carried along by the pose estimate."""
        run = self.run
        stop = run.stops[-1]
        if stop.update.position_rover is None:
            raise ValueError("the target was not seen yet")
        here = composed(run.vehicle.estimated.inv(), stop.estimated)
        position = np.asarray(here.apply(np.array(stop.update.position_rover)))
        return Belief(position, run.rig.range_m(position))

    def _track(self, leg: int) -> RunOutcome | None:
        """Points, takes pictures, updates. Why the run is over, or None."""
        run = self.run
        run.time_s += self.p.timing.track_s
        aim = self.tracker.aim(run.vehicle.estimated)
        if aim is None:
            return RunOutcome.OUT_OF_REACH
        stop = self._stop(leg, aim)
        run.stops.append(stop)
        run.pending = []
        if stop.update.state is TrackingState.FAILURE:
            return RunOutcome.LOST
        if stop.update.position_rover is None:
            return RunOutcome.NOT_SEEDED
        return None

    def _stop(self, leg: int, aim: MastAim) -> Stop:
        run, world, rig, stance = self.run, self.run.world, self.run.rig, self.run.vehicle.stance
        rig.point(aim.azimuth_rad, aim.elevation_rad)
        angles, world_from_head = rig.state.readings_rad, composed(stance.world_from_rover, rig.rover_from_head)
        body, mast, point = run.vehicle.rover, rig.calibrated.geometry, run.target.point_world
        shading = (
            world.shading(body, stance, mast, rig.state.true_rad, point, run.time_s) if self.p.rover_shadow else None
        )
        brightness = world.brightness(run.time_s)
        scene = world.scene(run.time_s)
        pictures = self.photographer.take(
            scene, shading, world_from_head, (rig.left, rig.right), (aim.left, aim.right), brightness, run.time_s
        )
        update, taken = self.tracker.update(pictures, angles, run.vehicle.estimated)
        in_head = np.asarray(world_from_head.inv().apply(run.target.point_world.copy()))
        return Stop(
            leg=leg,
            time_s=run.time_s,
            stance=stance,
            estimated=run.vehicle.estimated,
            angles_rad=angles,
            world_from_head=world_from_head,
            pictures=pictures,
            update=update,
            point_px=np.asarray(rig.left.project(in_head)[0]),
            point_rover=np.asarray(stance.world_from_rover.inv().apply(run.target.point_world.copy())),
            range_m=float(np.linalg.norm(in_head - rig.left.c)),
            drives=tuple(run.pending),
            track_time_s=taken,
        )


def _reached(leg: LegParameters, belief: Belief) -> bool:
    """Whether the last leg has come to its goal, if it has one; those before end with their steps too."""
    if leg.ends_with_steps:
        return True
    if leg.motion == "approach":
        return belief.distance_m <= leg.goal_m + GOAL_TOLERANCE_M
    if leg.motion == "back-off":
        return belief.distance_m >= leg.goal_m - GOAL_TOLERANCE_M
    return True
