"""Simulate the closed loop of a run: at each stop visual odometry, tracking, navigation and drive, as in Fig. 12.

A guide points the mast at each stop and estimates the target's position (`marsyard.scenarios.rover.guides`). Visual
odometry and the navigator's map use rendered stereo pairs. Parameters with values `oracle-...` replace
these measurements by the truth with errors, which is faster and isolates the causes of failures.
"""

from collections.abc import Iterable

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.navigation.planner import NavigationOutcome
from marsyard.algorithms.navigation.visual_odometry import MotionEstimate, estimate_motion
from marsyard.algorithms.vtt import GoalCriterion, HandOffOutcome, hand_off
from marsyard.algorithms.vtt.pointing import mast_angles
from marsyard.scenarios.rover.designation import designate_from_start
from marsyard.scenarios.rover.flight_software import (
    GOAL_TOLERANCE_M,
    TargetEstimate,
    goal_position,
    is_at_goal,
    is_finished,
    plan_step,
)
from marsyard.scenarios.rover.guides import Guide, TrackerGuide
from marsyard.scenarios.rover.navigation_cameras import ODOMETRY_EDGE_RAYS, oracle_heights
from marsyard.scenarios.rover.parameters import LegParameters, RoverScenarioParameters
from marsyard.scenarios.rover.points import build_shadow_caster
from marsyard.scenarios.rover.run_state import START_LEG, RoverRun, RunOutcome, Setup, Step, StopView, is_stuck
from marsyard.sim.dynamics.driving import Drive
from marsyard.sim.frames import compose
from marsyard.sim.measurements import DriveCommand, StereoMeasurement
from marsyard.sim.streams import Streams

#: Radius of the ground in a subframe around the target, divided by the target's distance: 8 deg, more than half the
#: diagonal of the subframe of a navcam's right camera.
SUBFRAME_RADIUS_FRACTION = 0.14
#: Maximum turn in place between two stereo pairs of visual odometry, radians (MER: Maimone, Cheng & Matthies 2007).
VISUAL_TURN_RAD = np.radians(18.0)
#: Maximum distance from the goal at which the target is handed off to the arm, metres (assumed): the last step of an
#: approach may overshoot the goal.
HAND_OFF_TOLERANCE_M = 2.0 * GOAL_TOLERANCE_M
#: Minimum and maximum depth of mapped points, metres, for the mast's cameras and the body cameras.
MAST_RANGES_M, BODY_RANGES_M = (1.4, 8.0), (0.35, 3.0)
#: Azimuth between successive stereo pairs of the mast in a navigation update, radians.
MAST_SPACING_RAD = np.radians(40.0)


def run_case(p: RoverScenarioParameters, streams: Streams) -> RoverRun:
    """Simulate a run from the designation of the target to its end."""
    return track_target(p, prepare_run(p, streams))


def prepare_run(p: RoverScenarioParameters, streams: Streams) -> RoverRun:
    """Create a run at its start and designate its target; the tracker is not called."""
    setup = Setup.draw(p, streams)
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
        is_complete = not has_goal or is_at_goal(last_leg, guide.target(run))
        run.outcome = RunOutcome.COMPLETED if is_complete else RunOutcome.NOT_AT_GOAL
    if run.outcome is RunOutcome.COMPLETED and last_leg.motion == "approach":
        goal = GoalCriterion(last_leg.goal_m, HAND_OFF_TOLERANCE_M)
        result = hand_off(run.stops[-1].update, goal, run.setup.rig.calibrated)
        run.handed_off = result.outcome is HandOffOutcome.HANDED_OFF
    return run


def drive_legs(p: RoverScenarioParameters, run: RoverRun, guide: Guide) -> RunOutcome | None:
    """Drive all legs; return the outcome if the run ends early, else None."""
    failure = visit_stop(p, run, guide, START_LEG)
    for number, leg in enumerate(p.legs):
        step_count = 0
        if leg.maps_first and failure is None:
            map_terrain(p, run, leg, guide.target(run))
        while failure is None and not is_finished(leg, step_count, guide.target(run)):
            failure = drive_step(p, run, leg, step_count, guide.target(run)) or visit_stop(p, run, guide, number)
            # a loss at this stop remains a failure of the tracker
            failure = failure or (RunOutcome.STUCK if ends_stuck(p, run) else None)
            step_count += 1
    return failure


def ends_stuck(p: RoverScenarioParameters, run: RoverRun) -> bool:
    """Whether a stuck rover ends the run; not before `mobility.stuck_steps` steps."""
    return len(run.steps) >= p.mobility.stuck_steps and is_stuck(run.steps, p.mobility)


def drive_commanded_path(p: RoverScenarioParameters, run: RoverRun) -> list[RigidTransform]:
    """Drive a prepared run of commanded legs without a tracker and images; return the true poses of the mast's head.

    At all stops the mast points at the designated point.
    """
    # without rendered images of visual odometry, which do not change the true path
    p = p.model_copy(update={"navigation": p.navigation.model_copy(update={"odometry": "oracle-motion"})})
    rig, vehicle, heads = run.setup.rig, run.setup.vehicle, []

    def add_stop() -> TargetEstimate:
        target = run.create_target_estimate(vehicle.stance.world_from_rover.inv().apply(run.target.point_world.copy()))
        angles = mast_angles(target.position_rover, rig.calibrated, p.vtt.aim_pair)
        if angles is not None:
            rig.point(*angles)
        heads.append(compose(vehicle.stance.world_from_rover, rig.rover_from_head))
        return target

    target = add_stop()
    for leg in p.legs:
        for step_count in range(leg.steps):
            drive_step(p, run, leg, step_count, target)
            target = add_stop()
            if ends_stuck(p, run):
                return heads
    return heads


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
    drives: list[Drive] = []
    for command in commands:
        part_count = 1
        if leg.visual_odometry:
            # 1e-9: tolerance for rounding errors
            parts = max(command.length_m / leg.visual_odometry_step_m, abs(command.turn_left_rad) / VISUAL_TURN_RAD)
            part_count = max(1, int(np.ceil(parts - 1e-9)))
            run.visual_odometry_updates += part_count
            run.time_s += part_count * p.timing.visual_odometry_s
        drives += [drive_part(p, run, leg, command.part(1.0 / part_count)) for _ in range(part_count)]
        run.time_s += p.timing.drive_s
    run.drives_since_stop += drives
    step = Step.from_drives(drives)
    if step.commanded_m > 0.0:
        run.steps.append(step)
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
    world, rig, by_body = run.setup.world, run.setup.rig, leg.map_by == "body"
    if by_body:
        # the body cameras look straight ahead
        ranges_m, azimuths = BODY_RANGES_M, [0.0]
    else:
        ahead = goal_position(leg, target)
        azimuth = -float(np.arctan2(ahead[1], ahead[0]))
        offsets = [number - 0.5 * (leg.wedges - 1) for number in range(leg.wedges)]
        ranges_m, azimuths = MAST_RANGES_M, [azimuth + offset * MAST_SPACING_RAD for offset in offsets]
    if p.navigation.terrain == "oracle-heights":
        points = [oracle_heights(world, vehicle, azimuth, ranges_m, by_body) for azimuth in azimuths]
        estimated_from_true = estimated_pose * vehicle.stance.world_from_rover.inv()
        run.navigator.map_points(np.asarray(estimated_from_true.apply(np.concatenate(points))))
        return
    for azimuth in azimuths:
        if by_body:
            pair = cameras.take_body_pair(world, rig, vehicle, time_s)
        else:
            pair = cameras.take_mast_pair(p, world, rig, vehicle, azimuth, time_s)
        run.navigator.map_pair(pair, estimated_pose, ranges_m)
