"""World of a rover's run: terrain with the target's rock and obstacles, and the moving sun."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from marsyard.scenarios.rover.parameters import MovingSunParameters, RoverScenarioParameters, WorldParameters
from marsyard.scenarios.rover.points import RockOutline
from marsyard.scenarios.views import SiteGround, Viewpoint, load_ground, site_scene
from marsyard.scenarios.visible_rocks import select_rocks
from marsyard.sim.dynamics.driven_ground import RockyGround
from marsyard.sim.render import CloudLayer, PixelRays, Scene
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
    #: index of an interval of the sun's position, and the scene in it
    _cached_scene: tuple[int, Scene] | None = field(default=None, repr=False)

    @classmethod
    def from_parameters(cls, p: RoverScenarioParameters, pixel_rad: float, streams: Streams) -> RunWorld:
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
            select_rocks(self.ground.rocks, self.ground.site.photometry.rock_albedo, viewpoint),
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
        viewpoint = replace(self.viewpoint, half_width_rad=np.pi, max_distance_m=max_distance_m)
        rocks = select_rocks(self.ground.rocks, self.ground.site.photometry.rock_albedo, viewpoint)
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
