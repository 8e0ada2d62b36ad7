"""Create the world of a rover run: terrain with the target's rock and obstacles, sun, mast with cameras, and rover."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from marsyard.scenarios.base import LoadGround
from marsyard.scenarios.rover.parameters import MovingSunParameters, RoverScenarioParameters, WorldParameters
from marsyard.scenarios.rover.points import RockOutline
from marsyard.scenarios.views import SiteGround, Viewpoint, select_rocks, site_scene
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics.driven_ground import DrivenGround, RockyGround
from marsyard.sim.dynamics.driving import Drive, Soil, drive
from marsyard.sim.dynamics.rover import MER, ROCKY_8, RoverParameters, Stance, settle
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DriveCommand, MastCalibration
from marsyard.sim.render import CloudLayer, PixelRays, Scene
from marsyard.sim.sensor.mast import Mast, MastState
from marsyard.sim.sensor.odometry import Odometer, PoseEstimate
from marsyard.sim.sensor.stereo_head import StereoHead
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import PlacedRock, RockField, RockParameters, TerrainParameters, site
from marsyard.sim.terrain.landforms import Ramp
from marsyard.sim.terrain.rocks.field import ROCK_ARRAYS

#: Name of the target's rock.
TARGET = "target"
#: Height of the mast's head above the foot of the target's rock, m. It determines the scene's level of detail.
MAST_HEAD_HEIGHT_M = 1.2
#: Maximum distance of rendered ground and rocks behind the target, m.
BACKGROUND_M = 25.0
#: Mesh spacing of the ground around the target, m, and its relative growth from line to line. Half the spacing changes
#: the brightness of 38 of 1.4 million pixels by a thousandth (ADR 6).
MESH_FINEST_M, MESH_GROWTH = 0.04, 0.012
#: Length of the ramp divided by the terrain's period; the ramp's centre is at a quarter of the period.
RAMP_FRACTION = 0.4
#: Large rocks are removed within the start distance plus this margin of the target, m.
CLEARANCE_M = 2.0
#: Minimum gap between the terrain's rocks and a placed rock, m.
MIN_GAP_M = 0.05
#: Maximum distance of rendered rocks, and half width of the ground mesh, in images for navigation, m.
NAVIGATION_ROCKS_M, NAVIGATION_HALF_WIDTH_M = 25.0, 60.0
#: Half side of the square around the target in which wheels roll over rocks, minus the start distance, m.
ROUTE_MARGIN_M = 1.5


def terrain_parameters(world: WorldParameters) -> TerrainParameters:
    """Return the site's terrain parameters with the changes of the campaign."""
    changes: dict[str, object] = {"samples": world.samples}
    if world.rms_slope_deg is not None:
        changes["rms_slope_deg"] = world.rms_slope_deg
    base = site(world.site).terrain("ground")
    if world.rock_abundance is not None:
        changes["rocks"] = (base.rocks or RockParameters()).model_dump() | {"abundance": world.rock_abundance}
    if world.incline.slope_deg:
        length_m = RAMP_FRACTION * world.samples * base.spacing_m
        changes["ramp"] = Ramp(slope_deg=world.incline.slope_deg, length_m=length_m).model_dump()
    return base.with_changes(changes)


@dataclass
class RunWorld:
    """Terrain, scene and sun of a run."""

    ground: SiteGround
    rocks: RockField  #: rocks of the ground; the target's rock has the name `TARGET`, obstacles `obstacle-1`, ...
    base: Scene  #: scene at the start, without the rover
    viewpoint: Viewpoint  #: position of the target and resolution of the cameras
    start_distance_m: float
    sun: MovingSunParameters
    target_number: int  #: index of the target's rock
    target_triangles: Float64[np.ndarray, "triangles 3 3"]  #: rendered mesh of the target's rock, used as truth
    _cached_scene: tuple[int, Scene] | None = field(default=None, repr=False)

    @classmethod
    def from_parameters(
        cls, p: RoverScenarioParameters, pixel_rad: float, streams: Streams, load_ground: LoadGround
    ) -> RunWorld:
        """Create the world of a run."""
        world = p.world
        site_ground = load_ground(site(world.site), terrain_parameters(world), world.bank_seed, world.terrain)
        site_ground = replace(site_ground, site=world.lit_site)
        ground, rocks = place_rocks(p, site_ground, streams.generator("placed rocks"))
        radius = p.start.distance_m + BACKGROUND_M
        azimuth, half_angle = p.bearing_rad + np.pi, np.radians(world.background_half_deg)
        viewpoint = Viewpoint(
            world.east_m, world.north_m, MAST_HEAD_HEIGHT_M, pixel_rad, float(azimuth), float(half_angle), radius
        )
        clouds = None
        if p.clouds is not None:
            height = float(ground.surface.height(world.east_m, world.north_m))
            clouds = CloudLayer.draw(p.clouds, streams.generator("clouds"), ground_m=height)
        scene = replace(
            site_scene(ground, viewpoint, p.sun.sun_in_interval(0, ground.site.environment.sun_radius_rad)),
            mesh_finest_m=MESH_FINEST_M,
            mesh_half_width_m=radius,
            mesh_lines=_mesh_lines(radius),
            clouds=clouds,
        )
        # a periodic scene may contain copies of the target's rock: use the copy nearest to the rock's position
        number, objects = rocks.by_name(TARGET), scene.objects
        bodies = np.flatnonzero(objects.names == number)
        offsets = objects.spheres[bodies, :2] - rocks.position_m[number][:2]
        nearest = bodies[np.argmin(np.linalg.norm(offsets, axis=1))]
        first, end = objects.first_triangle[nearest : nearest + 2]
        return cls(ground, rocks, scene, viewpoint, p.start.distance_m, p.sun, number, objects.triangles[first:end])

    def face_distance_m(self, p: RoverScenarioParameters) -> float:
        """Compute the horizontal distance of the designated point from the rock's centre towards the start, metres.

        The point is selected as seen from near the rover's start: half a rock's diameter plus the start distance from
        the rock's centre, and `MAST_HEAD_HEIGHT_M` above its foot.
        """
        bearing, foot = p.bearing_rad, self.rocks.position_m[self.target_number]
        to_start = np.array([np.sin(bearing), np.cos(bearing), 0.0])
        viewpoint = (
            foot
            + (p.start.distance_m + 0.5 * p.target.diameter_m) * to_start
            + np.array([0.0, 0.0, MAST_HEAD_HEIGHT_M])
        )
        outline = RockOutline.from_triangles(self.target_triangles, viewpoint, float(foot[2]))
        return float((outline.point(p.target.across, p.target.up) - foot) @ to_start)

    def scene(self, time_s: float) -> Scene:
        """Return the scene at a time of the run, without the rover; the sun changes every `sun.update_interval_s`."""
        interval = int(time_s // self.sun.update_interval_s)
        if self._cached_scene is None or self._cached_scene[0] != interval:
            sun = self.sun.sun_in_interval(interval, self.ground.site.environment.sun_radius_rad)
            self._cached_scene = (interval, self.base.with_light(sun, self.ground.photometry(sun)))
        return self._cached_scene[1]

    def navigation_scene(self, rays: PixelRays, world_from_camera: RigidTransform, time_s: float) -> Scene:
        """Build the scene for a camera anywhere on the route, with the rocks that it resolves, without the rover."""
        viewpoint = Viewpoint.from_pose(rays, world_from_camera, self.ground.surface)
        viewpoint = replace(viewpoint, max_distance_m=min(viewpoint.max_distance_m, NAVIGATION_ROCKS_M))
        return self.scene(time_s).with_viewpoint(
            select_rocks(self.ground, viewpoint),
            (viewpoint.east_m, viewpoint.north_m),
            MESH_FINEST_M,
            NAVIGATION_HALF_WIDTH_M,
            _mesh_lines(NAVIGATION_HALF_WIDTH_M),
        )

    @cached_property
    def route_ground(self) -> RockyGround:
        """Ground with the rocks on the route from the target to `ROUTE_MARGIN_M` behind the start."""
        centre = (self.viewpoint.east_m, self.viewpoint.north_m)
        half_side_m = self.start_distance_m + ROUTE_MARGIN_M
        max_distance_m = float(np.sqrt(2.0)) * half_side_m
        rocks = select_rocks(self.ground, replace(self.viewpoint, half_width_rad=np.pi, max_distance_m=max_distance_m))
        return RockyGround.from_triangles(self.ground.surface, rocks.triangles, centre, half_side_m)

    def brightness(self, time_s: float) -> float:
        """Compute the direct sunlight on the ground divided by the sunlight at 1 AU."""
        air = self.ground.site.environment
        elevation = float(np.arcsin(self.scene(time_s).sun.direction[2]))
        return air.direct_fraction(elevation) * air.solar_irradiance


def _mesh_lines(half_width_m: float) -> int:
    """Return the number of lines of a ground mesh with a half width of `half_width_m`.

    The lines are at `MESH_FINEST_M * sinh(MESH_GROWTH * i) / sinh(MESH_GROWTH)`, with i = 0 at the centre.
    """
    return 2 * int(np.ceil(np.arcsinh(half_width_m / MESH_FINEST_M * np.sinh(MESH_GROWTH)) / MESH_GROWTH)) + 1


def place_rocks(p: RoverScenarioParameters, base: SiteGround, rng: np.random.Generator) -> tuple[SiteGround, RockField]:
    """Place the target's rock and the obstacles; remove rocks that overlap them, and large rocks on the route."""
    bearing, centre = p.bearing_rad, np.array([p.world.east_m, p.world.north_m])
    to_start, right = np.array([np.sin(bearing), np.cos(bearing)]), np.array([-np.cos(bearing), np.sin(bearing)])
    shape = p.target.model_dump(include={"diameter_m", "height_m", "shape", "yaw_deg"})
    placed_rocks = [PlacedRock(name=TARGET, east_m=p.world.east_m, north_m=p.world.north_m, **shape)]
    for number, obstacle in enumerate(p.obstacles, start=1):
        east, north = centre + obstacle.towards_start_m * to_start + obstacle.right_m * right
        size = obstacle.model_dump(include={"diameter_m", "height_m"})
        placed_rocks.append(PlacedRock(name=f"obstacle-{number}", east_m=float(east), north_m=float(north), **size))
    rocks = RockField.draw(base.surface, RockParameters(abundance=0.0, placed=tuple(placed_rocks)), rng)
    if base.rocks is None:
        return replace(base, rocks=rocks), rocks
    is_near = _distances(base.rocks, centre) < p.start.distance_m + CLEARANCE_M
    is_kept = ~is_near | (base.rocks.diameter_m <= p.world.largest_near_m)
    for position, diameter in zip(rocks.position_m[:, :2], rocks.diameter_m, strict=True):
        # 0.6 instead of 0.5: irregular rocks extend beyond their nominal radius
        is_kept &= _distances(base.rocks, position) - 0.6 * (base.rocks.diameter_m + diameter) > MIN_GAP_M
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(rocks, name), getattr(base.rocks, name)[is_kept]]) for name in ROCK_ARRAYS
    }
    rocks = replace(rocks, **arrays)
    return replace(base, rocks=rocks), rocks


def _distances(rocks: RockField, position: Float64[np.ndarray, "2"]) -> Float64[np.ndarray, "rocks"]:
    """Compute the horizontal distances of rocks from a position on the periodic terrain."""
    offsets = rocks.position_m[:, :2] - position
    offsets -= rocks.period_m * np.round(offsets / rocks.period_m)
    return np.asarray(np.hypot(offsets[:, 0], offsets[:, 1]))


@dataclass
class Rig:
    """Simulated mast and stereo pair with sampled errors: true values, calibrated values, and current mast angles."""

    head: StereoHead  #: true and calibrated stereo pair
    calibrated: MastCalibration  #: calibration known to the flight software
    left: CameraModel  #: true left camera in the head's frame
    right: CameraModel  #: true right camera in the head's frame
    mast: Mast
    state: MastState  #: current angles: true, and read by the encoders
    motor_stream: np.random.Generator  #: random stream of the motors' stopping errors

    @classmethod
    def draw(cls, p: RoverScenarioParameters, streams: Streams) -> Rig:
        """Draw the errors of a run's mast and pair."""
        design = p.camera.mast()
        head = StereoHead.draw(design, p.stereo, streams.generator("stereo calibration"))
        mast = Mast.draw(p.pointing, design.geometry, streams.generator("mast zeros"))
        left, right, motor_stream = head.true.left, head.true.right, streams.generator("mast motors")
        return cls(head, head.calibrated, left, right, mast, mast.rest, motor_stream)

    @property
    def pixel_rad(self) -> float:
        """Angle of a pixel at the image centre."""
        return 1.0 / self.left.focal_lengths[0]

    @property
    def rover_from_head(self) -> RigidTransform:
        """True pose of the head in the rover frame."""
        return self.mast.rover_from_head(self.state)

    def camera_positions(
        self, world_from_head: RigidTransform
    ) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
        """Compute the true positions of the left and the right camera, world, metres."""
        left, right = world_from_head.apply(np.stack([self.left.c, self.right.c]))
        return left, right

    def point(self, azimuth_rad: float, elevation_rad: float) -> None:
        """Point the mast; it does not move if its encoders already read these angles."""
        if self.state.readings_rad != (azimuth_rad, elevation_rad):
            self.state = self.mast.point(self.state, azimuth_rad, elevation_rad, self.motor_stream)

    def range_m(self, position_rover: Float64[np.ndarray, "3"]) -> float:
        """Compute the estimated distance of a position from the left camera."""
        camera = self.calibrated.left.transform(self.calibrated.geometry.rover_from_head(*self.state.readings_rad))
        return float(np.linalg.norm(position_rover - camera.c))


@dataclass
class Vehicle:
    """A rover on its route: true stance, and pose estimated by odometry."""

    rover: RoverParameters
    ground: DrivenGround
    soil: Soil
    stance: Stance
    odometer: Odometer
    estimate: PoseEstimate
    slip_stream: np.random.Generator
    odometry_stream: np.random.Generator

    @classmethod
    def at_start(cls, p: RoverScenarioParameters, world: RunWorld, rig: Rig, streams: Streams) -> Vehicle:
        """Place the rover on the ground at its start; its estimated pose is exact there."""
        rover = MER if p.camera.preset.startswith("mer") else ROCKY_8
        bearing = p.bearing_rad
        to_start = np.array([np.sin(bearing), np.cos(bearing)])
        azimuth = bearing + np.pi - np.radians(p.start.target_azimuth_deg)
        ahead = np.array([np.sin(azimuth), np.cos(azimuth)])
        left = np.array([-ahead[1], ahead[0]])
        # the start distance is that of the mast's base, not of the rover's origin
        base = rig.calibrated.geometry.base_m
        target = np.array([p.world.east_m, p.world.north_m])
        position = (
            target + (world.face_distance_m(p) + p.start.distance_m) * to_start - base[0] * ahead - base[1] * left
        )
        ground: DrivenGround = world.ground.surface
        if p.world.rocks_underfoot:
            ground = world.route_ground
        stance = settle(rover, ground, float(position[0]), float(position[1]), float(azimuth))
        odometer = Odometer.draw(p.odometry, stance.world_from_rover, streams.generator("odometry"))
        soil = Soil.draw(p.slip, streams.generator("soil"))
        generators = streams.generator("slip"), streams.generator("odometry noise")
        return cls(rover, ground, soil, stance, odometer, odometer.initial_estimate, *generators)

    @property
    def estimated_pose(self) -> RigidTransform:
        """World pose of the rover as estimated on board."""
        return self.estimate.world_from_rover

    def correct_position(self, position_m: Float64[np.ndarray, "3"]) -> None:
        """Replace the estimated position by that of visual odometry, world; the attitude remains that of the IMU."""
        pose = rigid(self.estimated_pose.rotation, position_m)
        self.estimate = replace(self.estimate, world_from_rover=pose)

    def drive(self, command: DriveCommand, visual: bool) -> Drive:
        """Execute a drive command and update the estimated pose.

        With `visual`, the update uses the true motion with the errors of visual odometry, else wheel odometry.
        """
        result = drive(self.rover, self.ground, self.soil, self.stance, command, self.slip_stream)
        self.estimate = self.odometer.step(self.estimate, result, self.odometry_stream, visual)
        self.stance = result.end
        return result
