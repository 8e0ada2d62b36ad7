"""Open-loop tracking: many targets tracked over the pictures of one drive, as in sections 5.1 to 5.3 of the paper.

The rover is driven by the true position of the point in the middle of all targets, and its mast points there. At every
stop a part of both frames is taken that holds the rock and the search windows about it. A case then tracks one of the
targets over every (skip + 1)-th stop: skipped pictures make larger steps. The tracker's answers do not move the rover.
A drive is a function of the parameters, the campaign's seed and the run's number.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field, model_validator

from marsyard.algorithms.interface import MastAim, PixelBox, TrackingState
from marsyard.algorithms.vtt import VttOptions
from marsyard.algorithms.vtt.pointing import box_around, mast_angles
from marsyard.scenarios.base import LoadGround
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.route import Belief
from marsyard.scenarios.rover.run import Run, Setup, TrackerGuide, drive_legs
from marsyard.scenarios.rover.stops import RunOutcome, View
from marsyard.scenarios.rover.target import Sightings, choose_by_pixel, pick_point, sightings
from marsyard.scenarios.rover.world import RunWorld
from marsyard.scenarios.views import SiteGround
from marsyard.sim.camera import CameraModel
from marsyard.sim.parameters import Parameters
from marsyard.sim.streams import Streams


class VariantParameters(Parameters):
    """Rock, terrain and sun of one run."""

    terrain: Annotated[int, Field(ge=0, description="number of the terrain in the bank")] = 0
    diameter_m: Annotated[float, Field(gt=0.01, le=5.0, description="of the rock")] = 1.4
    height_m: Annotated[float, Field(gt=0.01, le=5.0, description="of the rock")] = 0.8
    shape: Annotated[int, Field(ge=0, le=31, description="its shape, see PlacedRock")] = 0
    yaw_deg: Annotated[float, Field(description="its turn")] = 0.0
    sun_azimuth_deg: Annotated[float, Field(ge=-360.0, le=720.0, description="clockwise from north")] = 225.0
    sun_elevation_deg: Annotated[float, Field(gt=3.0, le=90.0)] = 45.0


class PointParameters(Parameters):
    """A target on the rock's face, as `TargetParameters`; of a circle as seen from its middle."""

    across: Annotated[float, Field(ge=-1.0, le=1.0)] = 0.0
    up: Annotated[float, Field(ge=0.0, le=1.0)] = 0.5


class BandParameters(Parameters):
    """A range of steps: a boolean column of this name, by which requirements choose their cases."""

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
    margin_px: Annotated[float, Field(gt=0.0, description="margin about the rock in the pictures")] = 110.0
    bands: Annotated[tuple[BandParameters, ...], Field(description="ranges of steps")] = ()
    face_deg: float | None = Field(default=None, gt=0.0, le=90.0, description="maximum obliquity of a target `on_face`")

    @model_validator(mode="after")
    def _check_numbers(self) -> SharedDriveParameters:
        for name, number, count in (("run", self.run, len(self.variants)), ("target", self.target, len(self.targets))):
            if number >= count:
                raise ValueError(f"{name} is {number}; allowed: 0 to {count - 1}")
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

    def drive_of_run(self) -> RoverScenarioParameters:
        """The drive of the run without its tracker: all that its pictures depend on."""
        v, p = self.variants[self.run], self.drive
        # the drive is about the middle of its targets
        middle = {name: float(np.mean([getattr(one, name) for one in self.targets])) for name in ("across", "up")}
        rock = v.model_dump(include={"diameter_m", "height_m", "shape", "yaw_deg"})
        sun = {"azimuth_deg": v.sun_azimuth_deg, "elevation_deg": v.sun_elevation_deg}
        return p.model_copy(
            update={
                "world": p.world.model_copy(update={"terrain": v.terrain}),
                "target": p.target.model_copy(update=rock | middle),
                "sun": p.sun.model_copy(update=sun),
                "algorithm": "vtt",
                "compared": (),
                "vtt": VttOptions(),
            }
        )


@dataclass(frozen=True)
class DriveKey:
    """Everything that the pictures of a drive depend on."""

    drive: RoverScenarioParameters
    margin_px: float
    seed: int
    campaign: str
    run: int

    @classmethod
    def of(cls, p: SharedDriveParameters, streams: Streams) -> DriveKey:
        """The key of a case's drive."""
        return cls(p.drive_of_run(), p.margin_px, streams.seed, streams.campaign, p.run)


@dataclass(frozen=True)
class SharedDrive:
    """A drive and its pictures."""

    key: DriveKey
    run: Run
    views: tuple[View, ...]


def render_drive(key: DriveKey, load_ground: LoadGround = SiteGround.from_bank) -> SharedDrive:
    """Drive a run and take its pictures; its streams are named by the run and belong to no case."""
    p, streams = key.drive, Streams(key.seed, f"{key.campaign}: run {key.run}", 0)
    setup = Setup.of(p, streams, load_ground)
    world, rig, stance = setup.world, setup.rig, setup.vehicle.stance
    world_from_mast = stance.world_from_rover * rig.calibrated.geometry.rover_from_head(0.0, 0.0)
    at = _picking_eye(p, world, rig.eyes(world_from_mast)[0])
    position = p.target.across, p.target.up
    run = Run.at(setup, choose_by_pixel(world, rig, world_from_mast, (0.0, 0.0), position, p.vtt, at))
    guide = TruthGuide(key.margin_px)
    drive_legs(p, run, guide)
    return SharedDrive(key, run, tuple(guide.views))


@dataclass(frozen=True)
class TruthGuide:
    """The true target position as `marsyard.scenarios.rover.run.Guide`."""

    margin_px: float
    views: list[View] = field(default_factory=list)

    def aim(self, run: Run) -> MastAim | None:
        """Point at the target; the boxes hold what each frame shows of the rock above its foot, and a margin."""
        stance, rig = run.vehicle.stance, run.rig
        point_rover = np.asarray(stance.world_from_rover.inv().apply(run.target.point_world.copy()))
        angles = mast_angles(point_rover, rig.calibrated, pair=False)
        if angles is None:
            raise ValueError("the mast cannot point at the target's rock from every stop of this drive")
        rig.point(*angles)
        corners = run.world.target_triangles.reshape(-1, 3)
        corners = corners[corners[:, 2] > run.world.rocks.position_m[run.world.target_number, 2]]
        in_head = np.asarray((stance.world_from_rover * rig.rover_from_head).inv().apply(corners.copy()))
        left, right = (_box(camera, in_head, self.margin_px) for camera in (rig.left, rig.right))
        # the mast stays where its encoders read these angles
        return MastAim(*rig.state.readings_rad, left, right)

    def observe(self, run: Run, view: View) -> RunOutcome | None:
        """Store the pictures."""
        self.views.append(replace(view, leg=0, drives=()))
        return None

    def belief(self, run: Run) -> Belief:
        """The true target position."""
        return run.true_belief()


def _picking_eye(
    p: RoverScenarioParameters, world: RunWorld, eye: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "3"]:
    """The eye from which targets on the rock are picked: the start, or the middle of a circle.

    The paper selected the targets of its circle on the one face that is seen from both of its ends.
    """
    leg, rock = p.legs[0], world.rocks.position_m[world.target_number]
    turn = np.radians(0.5 * leg.steps * leg.step_deg) if leg.motion == "circle" else 0.0
    (east, north, up), sine, cosine = eye - rock, np.sin(turn), np.cos(turn)
    return np.asarray(rock + np.array([cosine * east + sine * north, cosine * north - sine * east, up]))


def _box(camera: CameraModel, points: Float64[np.ndarray, "points 3"], margin_px: float) -> PixelBox:
    """Bounding box, with a margin, of the points in the frame."""
    pixels = camera.project(points)[0]
    seen = pixels[camera.in_frame(pixels)]
    box = box_around(seen, margin_px, camera) if len(seen) else None
    if box is None:
        raise ValueError("the camera does not see the target's rock")
    return box


def prepare_run(p: SharedDriveParameters, drive: SharedDrive) -> Run:
    """A run over the drive's pictures, its target chosen, before the tracker is called."""
    first, run, point = drive.views[0], drive.run, p.targets[p.target]
    at = _picking_eye(p.drive, run.world, run.rig.eyes(first.world_from_head)[0])
    position, pose = (point.across, point.up), first.world_from_head
    return Run.at(run, choose_by_pixel(run.world, run.rig, pose, first.angles_rad, position, p.drive.vtt, at))


def track_views(p: SharedDriveParameters, drive: SharedDrive, algorithm: str | None = None) -> Run:
    """Run a tracker over the drive's pictures for one of the targets; by default the tracker under test."""
    run = prepare_run(p, drive)
    chosen = p.drive.model_copy(update={"algorithm": algorithm or p.drive.algorithm})
    guide = TrackerGuide(chosen, run, drive.views[0].estimated)
    for view in drive.views[:: p.skip + 1]:
        guide.observe(run, view)
        if run.stops[-1].update.state is TrackingState.FAILURE:
            break
    if not run.stops[0].update.found:
        run.outcome = RunOutcome.NOT_SEEDED
    else:
        run.outcome = RunOutcome.COMPLETED if run.stops[-1].update.found else RunOutcome.LOST
    return run


def sightings_along(drive: SharedDrive, chosen: PointParameters, options: VttOptions) -> Sightings:
    """Visibility of a target along a drive."""
    world, rig = drive.run.world, drive.run.rig
    eyes = [rig.eyes(one.world_from_head) for one in drive.views]
    at = _picking_eye(drive.key.drive, world, eyes[0][0])
    point = pick_point(world, eyes[0], (chosen.across, chosen.up), rig.pixel_rad, options, at)[0]
    return sightings(world, point, eyes, rig.pixel_rad, options)
