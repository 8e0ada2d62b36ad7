"""World of a rover run: a site's terrain with the target's rock and obstacles, the sun, the rover and its mast."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from marsyard.scenarios.base import LoadGround
from marsyard.scenarios.rover.parameters import RoverScenarioParameters, SunParameters, WorldParameters
from marsyard.scenarios.rover.points import RockOutline
from marsyard.scenarios.views import Eye, SiteGround, site_scene
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics import MER, ROCKY_8, Drive, Ground, RockyGround, RoverParameters, Soil, Stance, drive, settle
from marsyard.sim.measurements import DriveCommand, MastCalibration
from marsyard.sim.render import CloudLayer, Scene
from marsyard.sim.sensor import Mast, MastState, StereoHead
from marsyard.sim.sensor.odometry import Odometer, PoseEstimate
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import PlacedRock, RockField, RockParameters, TerrainParameters, site
from marsyard.sim.terrain.landforms import Ramp
from marsyard.sim.terrain.rocks.field import ROCK_ARRAYS

#: Name of the target's rock.
TARGET = "target"
#: Height above the target's foot from which the scene's detail is chosen: that of a mast's head at the goal.
EYE_HEIGHT_M = 1.2
#: Distance behind the target to which ground and rocks are drawn.
BACKGROUND_M = 25.0
#: Spacing of the ground's mesh about the target, and its growth from line to line: half of it changed 38 of 1.4 million
#: pixels by a thousandth of their brightness (ADR 34).
MESH_FINEST_M, MESH_GROWTH = 0.04, 0.012
#: Length of an even slope as a fraction of the terrain's period; the landform centres it at a quarter of the period.
RAMP_FRACTION = 0.4
#: Distance beyond start and target within which the ground is cleared of rocks on the route.
CLEARED_M = 2.0
#: Minimum distance of the bank's rocks from the outline of a placed rock.
MIN_GAP_M = 0.05
#: Maximum distance from the route of rocks that wheels roll over, metres.
ROUTE_MARGIN_M = 1.5


def terrain_parameters(w: WorldParameters) -> TerrainParameters:
    """The terrain of the site with the campaign's changes."""
    changes: dict[str, object] = {"samples": w.samples}
    if w.rms_slope_deg is not None:
        changes["rms_slope_deg"] = w.rms_slope_deg
    base = site(w.site).terrain("ground")
    if w.rock_abundance is not None:
        changes["rocks"] = (base.rocks or RockParameters()).model_dump() | {"abundance": w.rock_abundance}
    if w.incline.slope_deg:
        length_m = RAMP_FRACTION * w.samples * base.spacing_m
        changes["ramp"] = Ramp(slope_deg=w.incline.slope_deg, length_m=length_m).model_dump()
    return base.with_changes(changes)


@dataclass
class RunWorld:
    """Terrain, scene and sun of a run."""

    ground: SiteGround
    rocks: RockField  #: of the ground; the target's is named `TARGET`, obstacles `obstacle-1`, `obstacle-2`, ...
    base: Scene  #: the scene at the start, without the rover
    sun: SunParameters
    target_number: int  #: number of the target's rock
    target_triangles: Float64[np.ndarray, "triangles 3 3"]  #: the target's rock as rendered, which is the truth
    _latest: tuple[int, Scene] | None = field(default=None, repr=False)

    @classmethod
    def of(cls, p: RoverScenarioParameters, pixel_rad: float, streams: Streams, load_ground: LoadGround) -> RunWorld:
        """Create the world of a run."""
        w = p.world
        bare = load_ground(site(w.site), terrain_parameters(w), w.bank_seed, w.terrain)
        ground, rocks = place_rocks(p, bare, streams.generator("placed rocks"))
        reach = p.start.distance_m + BACKGROUND_M
        middle, half = p.bearing_rad + np.pi, np.radians(w.background_half_deg)
        eye = Eye(w.east_m, w.north_m, EYE_HEIGHT_M, pixel_rad, float(middle), float(half), reach)
        clouds = None
        if p.clouds is not None:
            level = float(ground.surface.height(w.east_m, w.north_m))
            clouds = CloudLayer.draw(p.clouds, streams.generator("clouds"), ground_m=level)
        scene = replace(
            site_scene(ground, eye, p.sun.in_interval(0, ground.site.environment.sun_radius_rad)),
            mesh_finest_m=MESH_FINEST_M,
            mesh_reach_m=reach,
            mesh_lines=2 * int(np.ceil(np.arcsinh(reach / MESH_FINEST_M * np.sinh(MESH_GROWTH)) / MESH_GROWTH)) + 1,
            clouds=clouds,
        )
        # a periodic scene may hold copies of the target's rock: take the one nearest to its position
        number, objects = rocks.by_name(TARGET), scene.objects
        bodies = np.flatnonzero(objects.names == number)
        offsets = objects.spheres[bodies, :2] - rocks.position_m[number][:2]
        nearest = bodies[np.argmin(np.linalg.norm(offsets, axis=1))]
        first, end = objects.first_triangle[nearest : nearest + 2]
        return cls(ground, rocks, scene, p.sun, number, objects.triangles[first:end])

    def face_m(self, p: RoverScenarioParameters) -> float:
        """Distance of the designated point from the rock's middle along the horizontal line to the start, metres.

        Picked from about the rover's start: at the start's distance, an eye's height above the rock's foot.
        """
        bearing, foot = p.bearing_rad, self.rocks.position_m[self.target_number]
        away = np.array([np.sin(bearing), np.cos(bearing), 0.0])
        eye = foot + (p.start.distance_m + 0.5 * p.target.diameter_m) * away + np.array([0.0, 0.0, EYE_HEIGHT_M])
        point = RockOutline.of(self.target_triangles, eye, float(foot[2])).point(p.target.across, p.target.up)
        return float((point - foot) @ away)

    def scene(self, time_s: float) -> Scene:
        """The scene at a time of the run, without the rover. The sun is held for `SunParameters.held_s`."""
        interval = int(time_s // self.sun.held_s)
        if self._latest is None or self._latest[0] != interval:
            sun = self.sun.in_interval(interval, self.ground.site.environment.sun_radius_rad)
            self._latest = (interval, self.base.in_light(sun, self.ground.photometry(sun)))
        return self._latest[1]

    def brightness(self, time_s: float) -> float:
        """Direct sunlight on the ground relative to 1 AU."""
        air = self.ground.site.environment
        elevation = float(np.arcsin(self.scene(time_s).sun.direction[2]))
        return air.direct_share(elevation) * air.solar_irradiance


def place_rocks(p: RoverScenarioParameters, bare: SiteGround, rng: np.random.Generator) -> tuple[SiteGround, RockField]:
    """Location the target's rock and the obstacles; remove the bank's rocks on them, and large ones near the route."""
    bearing, centre = p.bearing_rad, np.array([p.world.east_m, p.world.north_m])
    along, right = np.array([np.sin(bearing), np.cos(bearing)]), np.array([-np.cos(bearing), np.sin(bearing)])
    shape = p.target.model_dump(include={"diameter_m", "height_m", "shape", "yaw_deg"})
    placed = [PlacedRock(name=TARGET, east_m=p.world.east_m, north_m=p.world.north_m, **shape)]
    for number, one in enumerate(p.obstacles, start=1):
        east, north = centre + one.towards_start_m * along + one.right_m * right
        size = one.model_dump(include={"diameter_m", "height_m"})
        placed.append(PlacedRock(name=f"obstacle-{number}", east_m=float(east), north_m=float(north), **size))
    rocks = RockField.on(bare.surface, RockParameters(abundance=0.0, placed=tuple(placed)), rng)
    if bare.rocks is None:
        return replace(bare, rocks=rocks), rocks
    near = _distances(bare.rocks, centre) < p.start.distance_m + CLEARED_M
    kept = ~near | (bare.rocks.diameter_m <= p.world.largest_near_m)
    for position, diameter in zip(rocks.position_m[:, :2], rocks.diameter_m, strict=True):
        kept &= _distances(bare.rocks, position) - 0.6 * (bare.rocks.diameter_m + diameter) > MIN_GAP_M
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(rocks, name), getattr(bare.rocks, name)[kept]]) for name in ROCK_ARRAYS
    }
    rocks = replace(rocks, **arrays)
    return replace(bare, rocks=rocks), rocks


def _distances(rocks: RockField, position: Float64[np.ndarray, "2"]) -> Float64[np.ndarray, "rocks"]:
    away = rocks.position_m[:, :2] - position
    away -= rocks.period_m * np.round(away / rocks.period_m)
    return np.asarray(np.hypot(away[:, 0], away[:, 1]))


@dataclass
class Rig:
    """A mast and its stereo pair, with their errors."""

    head: StereoHead  #: the pair, true and calibrated
    calibrated: MastCalibration  #: the calibration that flight software is given
    left: CameraModel  #: the true left camera in the head's frame
    right: CameraModel  #: the true right camera in the head's frame
    mast: Mast
    state: MastState  #: present angles
    motors: np.random.Generator  #: stream of the motors' stopping errors

    @classmethod
    def of(cls, p: RoverScenarioParameters, streams: Streams) -> Rig:
        """Draw the errors of a run's mast and pair."""
        design = p.camera.mast()
        head = StereoHead.draw(design, p.stereo, streams.generator("stereo calibration"))
        mast = Mast.draw(p.pointing, design.geometry, streams.generator("mast zeros"))
        left, right, motors = head.true.left, head.true.right, streams.generator("mast motors")
        return cls(head, head.calibrated, left, right, mast, mast.rest, motors)

    @property
    def pixel_rad(self) -> float:
        """Angle of a pixel in the middle of the frame."""
        return 1.0 / self.left.focal_lengths[0]

    @property
    def rover_from_head(self) -> RigidTransform:
        """True pose of the head in the rover frame."""
        return self.mast.rover_from_head(self.state)

    def eyes(self, world_from_head: RigidTransform) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
        """True positions of the left and the right camera, world, metres."""
        left, right = world_from_head.apply(np.stack([self.left.c, self.right.c]))
        return left, right

    def point(self, azimuth_rad: float, elevation_rad: float) -> None:
        """Point the mast; it stays where its encoders read these angles already."""
        if self.state.readings_rad != (azimuth_rad, elevation_rad):
            self.state = self.mast.point(self.state, azimuth_rad, elevation_rad, self.motors)

    def range_m(self, position_rover: Float64[np.ndarray, "3"]) -> float:
        """Estimated distance of a position from the left camera."""
        camera = self.calibrated.left.transform(self.calibrated.geometry.rover_from_head(*self.state.readings_rad))
        return float(np.linalg.norm(position_rover - camera.c))


@dataclass
class Vehicle:
    """A rover on its route: true stance, and pose estimate by odometry."""

    rover: RoverParameters
    ground: Ground
    soil: Soil
    stance: Stance
    odometer: Odometer
    estimate: PoseEstimate
    slip_stream: np.random.Generator
    odometry_stream: np.random.Generator

    @classmethod
    def at_start(cls, p: RoverScenarioParameters, world: RunWorld, rig: Rig, streams: Streams) -> Vehicle:
        """Settle the rover at its start, its pose known there."""
        rover = MER if p.camera.preset.startswith("mer") else ROCKY_8
        bearing = p.bearing_rad
        away = np.array([np.sin(bearing), np.cos(bearing)])
        azimuth = bearing + np.pi - np.radians(p.start.target_azimuth_deg)
        ahead = np.array([np.sin(azimuth), np.cos(azimuth)])
        left = np.array([-ahead[1], ahead[0]])
        base = rig.calibrated.geometry.base_m
        target = np.array([p.world.east_m, p.world.north_m])
        position = target + (world.face_m(p) + p.start.distance_m) * away - base[0] * ahead - base[1] * left
        ground: Ground = world.ground.surface
        if p.world.rocks_underfoot:
            half = p.start.distance_m + ROUTE_MARGIN_M
            ground = RockyGround.of(ground, world.base.objects.triangles, (p.world.east_m, p.world.north_m), half)
        stance = settle(rover, ground, float(position[0]), float(position[1]), float(azimuth))
        odometer = Odometer.draw(p.odometry, stance.world_from_rover, streams.generator("odometry"))
        soil = Soil.draw(p.slip, streams.generator("soil"))
        generators = streams.generator("slip"), streams.generator("odometry noise")
        return cls(rover, ground, soil, stance, odometer, odometer.first, *generators)

    @property
    def estimated(self) -> RigidTransform:
        """World pose of the rover as estimated on board."""
        return self.estimate.world_from_rover

    def drive(self, command: DriveCommand, visual: bool) -> Drive:
        """Drive a command and update the estimate."""
        driven = drive(self.rover, self.ground, self.soil, self.stance, command, self.slip_stream)
        self.estimate = self.odometer.step(self.estimate, driven, self.odometry_stream, visual)
        self.stance = driven.end
        return driven
