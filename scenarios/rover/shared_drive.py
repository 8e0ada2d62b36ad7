"""Rover scenario: one target tracked over the images of a shared drive.

A shared drive is open-loop tracking (paper, 5.1 to 5.3): the tracker's answers do not move the rover. A point at the
mean position of all targets is designated in images of the start; rover and mast follow it by odometry. At every stop,
both cameras take subframes that contain the rock and the search windows around it. A case tracks one target over the
images of every (skipped_stops + 1)-th stop; skipping stops makes the steps larger. A campaign has several drives, which
the parameters call runs: each has its own rock, terrain and sun. A drive depends only on the parameters, the campaign's
seed and the index of its run.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float64
from pydantic import BaseModel
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.interface import TrackingState
from marsyard.algorithms.vtt import VttOptions
from marsyard.scenarios.case_evaluation import evaluate_case
from marsyard.scenarios.interface import CaseResult, Scalar
from marsyard.scenarios.parts.named import SCORE, PartKind
from marsyard.scenarios.rover.closed_loop import drive_legs
from marsyard.scenarios.rover.conditions import Visibility, evaluate_visibility, fixed_conditions, shadow_columns
from marsyard.scenarios.rover.designation import designate_point
from marsyard.scenarios.rover.guides import DesignationGuide, TrackerGuide
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.run_state import RoverRun, RunOutcome, Setup, StopView
from marsyard.scenarios.rover.shared_drive_parameters import PointParameters, SharedDriveParameters
from marsyard.scenarios.rover.task import TRACKING
from marsyard.scenarios.rover.tracked_run import run_tracker, score_track
from marsyard.scenarios.rover.world import terrain_parameters
from marsyard.scenarios.terrain_scenario import TerrainScenario
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import TerrainBank

#: Cache sizes of a process: shared drives with their images, visibilities of targets along drives.
MAX_DRIVES, MAX_VISIBILITIES = 1, 128


@dataclass(frozen=True)
class DriveKey:
    """All inputs of a drive's images: the drive of a run without its tracker, and its seed."""

    drive: RoverScenarioParameters
    margin_px: float
    steering: str
    seed: int
    campaign: str
    run: int

    @classmethod
    def from_parameters(cls, p: SharedDriveParameters, streams: Streams) -> DriveKey:
        """Create the key of a case's drive."""
        variant, drive = p.variants[p.run], p.drive
        # the mean position of all targets guides the drive
        centre = {name: float(np.mean([getattr(point, name) for point in p.targets])) for name in ("across", "up")}
        rock = variant.model_dump(include={"diameter_m", "height_m", "shape", "yaw_deg"})
        sun = {"azimuth_deg": variant.sun_azimuth_deg, "elevation_deg": variant.sun_elevation_deg}
        changes = {
            "world": drive.world.model_copy(update={"terrain": variant.terrain}),
            "target": drive.target.model_copy(update=rock | centre),
            "sun": drive.sun.model_copy(update=sun),
            "algorithm": "vtt",
            "compared": (),
            "vtt": VttOptions(),
        }
        return cls(drive.model_copy(update=changes), p.margin_px, p.steering, streams.seed, streams.campaign, p.run)


@dataclass(frozen=True)
class SharedDrive:
    """A drive and its images; `viewpoint` is the position from which targets on the rock are selected.

    `viewpoint` is the left camera at the start, or in the middle of a circle: the paper selected the targets of its
    circle on the face that is visible from both ends of the circle.
    """

    run: RoverRun
    views: tuple[StopView, ...]
    viewpoint: Float64[np.ndarray, "3"]


def render_drive(key: DriveKey) -> SharedDrive:
    """Drive a run and take its images; its random streams depend on the run, not on a case."""
    p, streams = key.drive, Streams(key.seed, f"{key.campaign}: run {key.run}", 0)
    setup = Setup.draw(p, streams)
    world, rig, leg = setup.world, setup.rig, p.legs[0]
    half_circle_rad = np.radians(0.5 * leg.steps * leg.step_deg) if leg.motion == "circle" else 0.0
    sine, cosine = np.sin(half_circle_rad), np.cos(half_circle_rad)

    def compute_viewpoint(world_from_head: RigidTransform) -> Float64[np.ndarray, "3"]:
        """Compute the left camera's position, rotated about the rock by half the circle, clockwise from above."""
        rock = world.rocks.position_m[world.target_number]
        east, north, up = rig.camera_positions(world_from_head)[0] - rock
        return np.asarray(rock + np.array([cosine * east + sine * north, cosine * north - sine * east, up]))

    mast = setup.vehicle.stance.world_from_rover * rig.calibrated.geometry.rover_from_head(0.0, 0.0)
    position = p.target.across, p.target.up
    viewpoint, time_s = compute_viewpoint(mast), p.timing.track_s
    run = RoverRun(setup, designate_point(world, rig, mast, (0.0, 0.0), position, p.vtt, time_s, viewpoint))
    guide = DesignationGuide.designate(run, key.margin_px, key.steering == "oracle-target")
    drive_legs(p, run, guide)
    if not guide.views:
        raise ValueError("the cameras cannot show the target's rock from the start of this drive")
    return SharedDrive(run, tuple(guide.views), compute_viewpoint(guide.views[0].world_from_head))


def prepare_shared_run(p: SharedDriveParameters, drive: SharedDrive) -> RoverRun:
    """Create a run over the drive's images and designate its target; the tracker is not called."""
    first, run, point = drive.views[0], drive.run, p.targets[p.target]
    position, head = (point.across, point.up), first.world_from_head
    target = designate_point(
        run.setup.world, run.setup.rig, head, first.angles_rad, position, p.drive.vtt, first.time_s, drive.viewpoint
    )
    return RoverRun(run.setup, target)


def track_views(p: SharedDriveParameters, drive: SharedDrive, algorithm: str | None = None) -> RoverRun:
    """Run a tracker over the drive's images for one of the targets; default: the tracker under test."""
    run = prepare_shared_run(p, drive)
    parameters = p.drive.model_copy(update={"algorithm": algorithm or p.drive.algorithm})
    guide = TrackerGuide(parameters, run, drive.views[0].estimated_pose)
    for view in drive.views[:: p.skipped_stops + 1]:
        guide.observe(run, view)
        if run.stops[-1].update.state is TrackingState.FAILURE:
            break
    if not run.stops[0].update.tracked:
        run.outcome = RunOutcome.NOT_SEEDED
    else:
        run.outcome = RunOutcome.COMPLETED if run.stops[-1].update.tracked else RunOutcome.LOST
    return run


def evaluate_drive_visibility(
    p: RoverScenarioParameters, drive: SharedDrive, point: PointParameters, options: VttOptions
) -> tuple[Visibility, dict[str, Scalar]]:
    """Evaluate the visibility of a target along a drive, and the columns of the rover's shadow on it, at all stops."""
    world, rig, first = drive.run.setup.world, drive.run.setup.rig, drive.views[0]
    position, head = (point.across, point.up), first.world_from_head
    target = designate_point(world, rig, head, first.angles_rad, position, options, first.time_s, drive.viewpoint)
    heads = [view.world_from_head for view in drive.views]
    visibility = evaluate_visibility(world, rig, target.point_world, heads, options)
    run = RoverRun(drive.run.setup, target)
    return visibility, shadow_columns(p.model_copy(update={"vtt": options}), run, drive.views)


class SharedDriveScenario(TerrainScenario[SharedDriveParameters]):
    """Tracking of many targets over the images of one drive."""

    name = "rover-drive"
    parameters_type = SharedDriveParameters
    task = TRACKING
    algorithm_table = ("drive",)
    part_keys: Mapping[str, PartKind] = {"drive.scores": SCORE}

    def __init__(self) -> None:
        self._drive = lru_cache(maxsize=MAX_DRIVES)(render_drive)
        self._visibility = lru_cache(maxsize=MAX_VISIBILITIES)(
            lambda key, point, options: evaluate_drive_visibility(key.drive, self._drive(key), point, options)
        )

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        """Return the indices of the terrains that runs use."""
        return tuple(sorted({variant.terrain for variant in self.check_parameters(parameters).variants}))

    def case_inputs(self, parameters: BaseModel, case: int) -> tuple[int, ...]:
        """Return the terrain of the case's run."""
        p = self.check_parameters(parameters)
        return (p.variants[p.run].terrain,)

    def input_terrain(self, p: SharedDriveParameters, shared_input: int) -> tuple[TerrainBank, int]:
        """Return the terrain bank and the index of a terrain in it."""
        world = p.drive.world
        return TerrainBank(terrain_parameters(world), world.bank_seed), shared_input

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """Track one target of one run with one step size; all algorithms use the same images."""
        p = self.check_parameters(parameters)
        key, point, algorithm = DriveKey.from_parameters(p, streams), p.targets[p.target], p.drive.algorithm
        drive = self._drive(key)
        case = key.drive.model_copy(update={"algorithm": algorithm, "vtt": p.drive.vtt})
        visibility, shadow = self._visibility(key, point, p.drive.vtt)
        shared = {
            **fixed_conditions(case, prepare_shared_run(p, drive)),
            "step": p.step,
            "with_scale": algorithm != "pure-ncc" and p.drive.vtt.scale,
            "pure_ncc": algorithm == "pure-ncc",
            **{entry.name: bool(entry.min <= p.step <= entry.max) for entry in p.step_ranges},
            **asdict(visibility),
            **shadow,
            "on_face": visibility.in_view
            and (p.max_obliquity_deg is None or visibility.obliquity_max_deg <= p.max_obliquity_deg),
        }

        return evaluate_case(
            p.drive,
            shared,
            lambda name: run_tracker(case, lambda: track_views(p, drive, name)),
            lambda name, runs: score_track(case, runs[name].answer, is_tested=name == algorithm),
        )
