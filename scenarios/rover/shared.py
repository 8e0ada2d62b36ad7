"""One drive, many targets: trackers that are run over the same pictures, as in sections 5.1 to 5.3 of the paper.

The rover is driven as told, by the true place of the point in the middle of all targets, and its mast points there; at
every stop a part of both frames is taken that holds the rock and the search windows about it. A case then tracks one of
the targets over every (skip + 1)-th stop: larger steps are made by leaving pictures out. What the tracker answers moves
nothing.

A drive is a function of the parameters, the campaign's seed and the run's number; processes keep the last one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Annotated, cast

import numpy as np
from jaxtyping import Float64
from pydantic import BaseModel, Field, model_validator
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.interface import PixelBox, TrackingState
from marsyard.algorithms.vtt import VttOptions
from marsyard.algorithms.vtt.pointing import box_around, mast_angles
from marsyard.scenarios.estimators import TRACKING
from marsyard.scenarios.interface import CaseResult, Scalar
from marsyard.scenarios.parts.named import SCORE, Kind
from marsyard.scenarios.parts.scores import scored
from marsyard.scenarios.rover.guarded import GuardedTracker
from marsyard.scenarios.rover.parameters import LegParameters, RoverScenarioParameters
from marsyard.scenarios.rover.pictures import Detectors, Photographer, StereoPictures
from marsyard.scenarios.rover.rig import Rig
from marsyard.scenarios.rover.route import Belief, commands, finished
from marsyard.scenarios.rover.run import Run
from marsyard.scenarios.rover.score import (
    fixed_conditions,
    products,
    provenance,
    run_conditions,
    score,
    scored_run,
    stored_updates,
    tracking,
)
from marsyard.scenarios.rover.stops import RunOutcome, Stop
from marsyard.scenarios.rover.target import Sightings, point_on, rock_of, sightings, told_by_pixel
from marsyard.scenarios.rover.vehicle import Vehicle
from marsyard.scenarios.rover.world import RunWorld, terrain_parameters
from marsyard.scenarios.trial import Judged, attempted, case_result
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics import Stance
from marsyard.sim.parameters import Parameters
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import TerrainBank


class VariantParameters(Parameters):
    """What one run has of its own: its rock, its place and its light."""

    terrain: Annotated[int, Field(ge=0, description="number of the terrain in the bank")] = 0
    diameter_m: Annotated[float, Field(gt=0.01, le=5.0, description="of the rock")] = 1.4
    height_m: Annotated[float, Field(gt=0.01, le=5.0, description="of the rock")] = 0.8
    shape: Annotated[int, Field(ge=0, le=31, description="its shape, see PlacedRock")] = 0
    yaw_deg: Annotated[float, Field(description="its turn")] = 0.0
    sun_azimuth_deg: Annotated[float, Field(ge=-360.0, le=720.0, description="clockwise from north")] = 225.0
    sun_elevation_deg: Annotated[float, Field(gt=3.0, le=90.0)] = 45.0


class PointParameters(Parameters):
    """A target on the rock's face, see `marsyard.scenarios.rover.TargetParameters`; of a circle as seen from its
    middle.
    """

    across: Annotated[float, Field(ge=-1.0, le=1.0)] = 0.0
    up: Annotated[float, Field(ge=0.0, le=1.0)] = 0.5


class BandParameters(Parameters):
    """A range of steps by which requirements choose their cases: a column of true and false of this name."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z]\w*$")]
    least: float = 0.0
    most: float = 1.0


class SharedDriveParameters(Parameters):
    """Drives whose pictures many cases share; `run`, `target`, `skip`, `drive.algorithm`, `drive.vtt` make a case."""

    drive: Annotated[RoverScenarioParameters, Field(description="the drive at its finest steps, and the tracker")]
    variants: Annotated[tuple[VariantParameters, ...], Field(min_length=1, description="the runs")]
    targets: Annotated[tuple[PointParameters, ...], Field(min_length=1, description="points on every run's rock")]
    run: Annotated[int, Field(ge=0, description="number of the run")] = 0
    target: Annotated[int, Field(ge=0, description="number of the target")] = 0
    skip: Annotated[int, Field(ge=0, le=100, description="stops left out between two updates")] = 0
    margin_px: Annotated[float, Field(gt=0.0, description="what of the frame is taken around the rock")] = 110.0
    bands: Annotated[tuple[BandParameters, ...], Field(description="ranges of steps that are told apart")] = ()
    face_deg: Annotated[
        float | None, Field(gt=0.0, le=90.0, description="most oblique sight at any stop of a target `on_face`")
    ] = None

    @model_validator(mode="after")
    def _are_there(self) -> SharedDriveParameters:
        for name, number, there in (
            ("run", self.run, len(self.variants)),
            ("target", self.target, len(self.targets)),
        ):
            if number >= there:
                raise ValueError(f"{name} is {number}; allowed: 0 to {there - 1}")
        if len(self.drive.legs) != 1:
            raise ValueError(f"a shared drive has one leg, not {len(self.drive.legs)}")
        return self

    @property
    def step(self) -> float:
        """The step between two updates: a share of the distance, or degrees of a turn or circle."""
        leg = self.drive.legs[0]
        if leg.motion in ("turn", "circle"):
            return abs(leg.step_deg) * (self.skip + 1)
        return float(1.0 - (1.0 - leg.step_share) ** (self.skip + 1))

    def of_run(self) -> RoverScenarioParameters:
        """The drive of the run, its tracker left out: what its pictures depend on."""
        v, p = self.variants[self.run], self.drive
        target = {"diameter_m": v.diameter_m, "height_m": v.height_m, "shape": v.shape, "yaw_deg": v.yaw_deg}
        # the drive is about the middle of its targets
        target |= {
            "across": float(np.mean([one.across for one in self.targets])),
            "up": float(np.mean([one.up for one in self.targets])),
        }
        sun = {"azimuth_deg": v.sun_azimuth_deg, "elevation_deg": v.sun_elevation_deg}
        return p.model_copy(
            update={
                "world": p.world.model_copy(update={"terrain": v.terrain}),
                "target": p.target.model_copy(update=target),
                "sun": p.sun.model_copy(update=sun),
                "algorithm": "vtt",
                "compared": (),
                "vtt": VttOptions(),
            }
        )


@dataclass(frozen=True)
class View:
    """A stop of a drive, without a tracker. See `Stop` for what is the same."""

    time_s: float
    stance: Stance
    estimated: RigidTransform
    angles_rad: tuple[float, float]
    world_from_head: RigidTransform
    pictures: StereoPictures


@dataclass(frozen=True)
class SharedDrive:
    """A drive and its pictures."""

    world: RunWorld
    rig: Rig
    vehicle: Vehicle
    views: tuple[View, ...]


@lru_cache(maxsize=1)
def shared_drive(p: RoverScenarioParameters, margin_px: float, seed: int, campaign: str, run: int) -> SharedDrive:
    """The drive of a run; its streams are named by it and belong to no case."""
    streams = Streams(seed, f"{campaign}: run {run}", 0)
    rig = Rig.of(p, streams)
    world = RunWorld.of(p, rig.pixel_rad, streams)
    vehicle = Vehicle.placed(p, world, rig, streams)
    photographer = Photographer(
        p.backend,
        Detectors.drawn(p.camera, streams.generator("detector response")),
        p.exposure,
        streams.generator("detector noise"),
    )
    corners = world.target_triangles.reshape(-1, 3)
    corners = corners[corners[:, 2] > world.rocks.position_m[world.target_number, 2]]
    middle = _middle_of_targets(p, world, rig, vehicle.stance)
    leg, views, time_s = p.legs[0], [], 0.0
    while True:
        time_s += p.timing.track_s
        views.append(_view(p, world, rig, vehicle, photographer, corners, middle, margin_px, time_s))
        belief = _belief(rig, vehicle, middle)
        if finished(leg, len(views) - 1, belief):
            return SharedDrive(world, rig, vehicle, tuple(views))
        _drive(leg, len(views) - 1, belief, vehicle)
        time_s += p.timing.drive_s


def _middle_of_targets(
    p: RoverScenarioParameters, world: RunWorld, rig: Rig, stance: Stance
) -> Float64[np.ndarray, "3"]:
    """The surface point in the middle of the targets."""
    rover_from_mast = rig.calibrated.geometry.rover_from_head(0.0, 0.0)
    eyes = rig.eyes(stance.world_from_rover * rover_from_mast)
    return point_on(world, eyes, p.target.across, p.target.up, rig.pixel_rad, p.vtt, _picked_from(p, world, eyes[0]))[0]


def _picked_from(
    p: RoverScenarioParameters, world: RunWorld, eye: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "3"]:
    """Where from the targets' places on the rock are meant: the start; of a circle its middle.

    The paper selected the targets of its circle on the one face that is seen from both of its ends.
    """
    leg, rock = p.legs[0], world.rocks.position_m[world.target_number]
    turn = np.radians(0.5 * leg.steps * leg.step_deg) if leg.motion == "circle" else 0.0
    (east, north, up), sine, cosine = eye - rock, np.sin(turn), np.cos(turn)
    return np.asarray(rock + np.array([cosine * east + sine * north, cosine * north - sine * east, up]))


def _belief(rig: Rig, vehicle: Vehicle, middle: Float64[np.ndarray, "3"]) -> Belief:
    """The targets' middle as it truly lies from the rover: the drive is the test's, not the tracker's."""
    position = np.asarray(vehicle.stance.world_from_rover.inv().apply(middle.copy()))
    return Belief(position, rig.range_m(position))


def _drive(leg: LegParameters, done: int, belief: Belief, vehicle: Vehicle) -> None:
    for command in commands(leg, done, belief):
        vehicle.drive(command, leg.visual_odometry)


def _view(
    p: RoverScenarioParameters,
    world: RunWorld,
    rig: Rig,
    vehicle: Vehicle,
    photographer: Photographer,
    corners: Float64[np.ndarray, "corners 3"],
    middle: Float64[np.ndarray, "3"],
    margin_px: float,
    time_s: float,
) -> View:
    """Points at the targets' middle and takes what of both frames shows the rock, and a margin."""
    stance, known = vehicle.stance, rig.calibrated
    angles = mast_angles(np.asarray(stance.world_from_rover.inv().apply(middle.copy())), known, p.vtt.aim_pair)
    if angles is None:
        raise ValueError("the mast cannot point at the target's rock from every stop of this drive")
    rig.point(*angles)
    world_from_head = stance.world_from_rover * rig.rover_from_head
    in_head = np.asarray(world_from_head.inv().apply(corners.copy()))
    boxes = (_box(rig.left, in_head, margin_px), _box(rig.right, in_head, margin_px))
    rover, mast, true = vehicle.rover, known.geometry, rig.state.true_rad
    shading = world.shading(rover, stance, mast, true, middle, time_s) if p.rover_shadow else None
    scene, cameras = world.scene(time_s), (rig.left, rig.right)
    brightness = world.brightness(time_s)
    pictures = photographer.take(scene, shading, world_from_head, cameras, boxes, brightness, time_s)
    return View(time_s, stance, vehicle.estimated, rig.state.readings_rad, world_from_head, pictures)


def _box(camera: CameraModel, points: Float64[np.ndarray, "points 3"], margin_px: float) -> PixelBox:
    """The part of the frame about all points that are in it."""
    pixels = camera.project(points)[0]
    seen = pixels[camera.in_frame(pixels)]
    box = box_around(seen, margin_px, camera) if len(seen) else None
    if box is None:
        raise ValueError("the camera does not see the target's rock")
    return box


def _prepare_run(p: SharedDriveParameters, drive: SharedDrive) -> Run:
    """A run over the drive's pictures before a tracker has been asked, its target chosen."""
    first = drive.views[0]
    eyes = drive.rig.eyes(first.world_from_head)
    chosen, seen = p.targets[p.target], _picked_from(p.drive, drive.world, eyes[0])
    point, on_edge, lit = point_on(drive.world, eyes, chosen.across, chosen.up, drive.rig.pixel_rad, p.drive.vtt, seen)
    told = told_by_pixel(drive.rig.left, first.world_from_head, point, first.angles_rad)
    return Run(drive.world, drive.rig, drive.vehicle, rock_of(drive.world, point, told, on_edge, lit))


def tracked(p: SharedDriveParameters, drive: SharedDrive, algorithm: str | None = None) -> Run:
    """A tracker run over the drive's pictures for one of the targets; the one that is judged if none is named."""
    run = _prepare_run(p, drive)
    point = run.target.point_world
    made = TRACKING.make(algorithm or p.drive.algorithm, p.drive.vtt, p.drive.executable)
    tracker = GuardedTracker(made, drive.rig.calibrated)
    tracker.designate(run.target.designation, drive.views[0].estimated)
    for view in drive.views[:: p.skip + 1]:
        pictures = view.pictures
        update, taken = tracker.update(pictures, view.angles_rad, view.estimated)
        in_head = np.asarray(view.world_from_head.inv().apply(point.copy()))
        run.stops.append(
            Stop(
                leg=0,
                time_s=view.time_s,
                stance=view.stance,
                estimated=view.estimated,
                angles_rad=view.angles_rad,
                world_from_head=view.world_from_head,
                pictures=pictures,
                update=update,
                point_px=np.asarray(drive.rig.left.project(in_head)[0]),
                point_rover=np.asarray(view.stance.world_from_rover.inv().apply(point.copy())),
                range_m=float(np.linalg.norm(in_head - drive.rig.left.c)),
                drives=(),
                track_time_s=taken,
            )
        )
        if update.state is TrackingState.FAILURE:
            break
    run.outcome = _outcome(run)
    return run


def _outcome(run: Run) -> RunOutcome:
    if not run.stops[0].update.found:
        return RunOutcome.NOT_SEEDED
    return RunOutcome.COMPLETED if run.stops[-1].update.found else RunOutcome.LOST


@lru_cache(maxsize=128)
def seen_along(
    p: RoverScenarioParameters,
    margin_px: float,
    seed: int,
    campaign: str,
    run: int,
    chosen: PointParameters,
    options: VttOptions,
) -> Sightings:
    """How a target shows itself all along a drive; kept, as the cases of a target ask the same."""
    drive = shared_drive(p, margin_px, seed, campaign, run)
    eyes = [drive.rig.eyes(one.world_from_head) for one in drive.views]
    seen = _picked_from(p, drive.world, eyes[0][0])
    point = point_on(drive.world, eyes[0], chosen.across, chosen.up, drive.rig.pixel_rad, options, seen)[0]
    return sightings(drive.world, point, eyes, drive.rig.pixel_rad, options)


class SharedDriveScenario:
    """Many targets tracked over the pictures of one drive."""

    name = "rover-drive"
    parameters_type = SharedDriveParameters
    task = TRACKING
    algorithm_table = ("drive",)
    part_keys: Mapping[str, Kind] = {"drive.scores": SCORE}

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        """Numbers of the bank's terrains that runs use."""
        return tuple(sorted({one.terrain for one in _checked(parameters).variants}))

    def prepare(self, parameters: BaseModel, shared_input: int) -> None:
        """Builds one terrain of the bank."""
        _bank(parameters).terrain(shared_input)

    def case_inputs(self, parameters: BaseModel, case: int) -> tuple[int, ...]:
        """The terrain of the case's run."""
        p = _checked(parameters)
        return (p.variants[p.run].terrain,)

    def missing_bytes(self, parameters: BaseModel, shared_input: int) -> int:
        """Bytes of a terrain that is not on disk."""
        return _bank(parameters).missing_bytes(shared_input)

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        """One target of one run, tracked with one step; all algorithms see the same pictures."""
        p = _checked(parameters)
        of_run = p.of_run()
        shared = (of_run, p.margin_px, streams.seed, streams.campaign, p.run)
        drive = shared_drive(*shared)
        case = of_run.model_copy(update={"algorithm": p.drive.algorithm, "vtt": p.drive.vtt, "score": p.drive.score})

        seen = seen_along(*shared, p.targets[p.target], p.drive.vtt)
        on_face = seen.in_view and (p.face_deg is None or seen.obliquity_max_deg <= p.face_deg)
        chosen = fixed_conditions(case, _prepare_run(p, drive))
        known = {**chosen, **_known(p), **asdict(seen), "on_face": on_face}

        def judge(algorithm: str) -> Judged:
            attempt = attempted(lambda: tracked(p, drive, algorithm), lambda made: cast(Run, made))
            run = attempt.answer
            if run is None:
                outcome = attempt.outcome(lambda made: made.outcome.name)
                return Judged(outcome, False, attempt.row, failure=attempt.failure)
            row = {**score(case, run), **tracking(run)}
            judged = algorithm == p.drive.algorithm
            if judged:
                row |= {
                    **run_conditions(case, run),
                    **stored_updates(run, p.drive.score.stored_updates),
                    **provenance(case, run),
                }
            row |= scored(p.drive.scores, scored_run(run), {*row, *known})
            completed = run.outcome is RunOutcome.COMPLETED
            return Judged(run.outcome.name, completed, row, products(case, run) if judged else {})

        return case_result(p.drive.algorithms, judge, known)


def _known(p: SharedDriveParameters) -> dict[str, Scalar]:
    """What makes a case, whatever tracks in it."""
    chosen = p.targets[p.target]
    bands: dict[str, Scalar] = {one.name: bool(one.least <= p.step <= one.most) for one in p.bands}
    return {
        "run": p.run,
        "target": p.target,
        "point_across": chosen.across,
        "point_up": chosen.up,
        "skip": p.skip,
        "step": p.step,
        "with_scale": p.drive.algorithm != "pure-ncc" and p.drive.vtt.scale,
        "pure_ncc": p.drive.algorithm == "pure-ncc",
        **bands,
    }


def _bank(parameters: BaseModel) -> TerrainBank:
    w = _checked(parameters).drive.world
    return TerrainBank(terrain_parameters(w), w.bank_seed)


def _checked(parameters: BaseModel) -> SharedDriveParameters:
    if not isinstance(parameters, SharedDriveParameters):
        raise TypeError(f"the shared drive takes SharedDriveParameters, not {type(parameters).__name__}")
    return parameters
