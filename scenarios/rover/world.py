"""World of a rover run: a site's terrain with the target's rock and obstacles, and the sun."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from marsyard.scenarios.base import LoadGround
from marsyard.scenarios.rover.parameters import RoverScenarioParameters, SunParameters, WorldParameters
from marsyard.scenarios.rover.points import RockOutline
from marsyard.scenarios.views import Eye, SiteGround, site_scene
from marsyard.sim.dynamics import RoverParameters, Stance
from marsyard.sim.frames import direction
from marsyard.sim.measurements import MastGeometry
from marsyard.sim.render import CloudLayer, Objects, Scene, Sun, may_cast_shadow, rover_objects, rover_sphere
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import PlacedRock, RockField, RockParameters, Site, Surface, TerrainParameters, site
from marsyard.sim.terrain.landforms import Ramp

#: Name of the target's rock.
TARGET = "target"
#: Height above the target's foot from which the scene's detail is chosen: that of a mast's head at the goal.
EYE_HEIGHT_M = 1.2
#: How far behind the target ground and rocks are drawn.
BACKGROUND_M = 25.0
#: Spacing of the ground's mesh about the target, and its growth from line to line: half of it changed 38 of 1.4 million
#: pixels by a thousandth of their brightness (ADR 34).
MESH_FINEST_M, MESH_GROWTH = 0.04, 0.012
#: Length of an even slope as a fraction of the terrain's period; the landform centres it at a quarter of the period.
RAMP_FRACTION = 0.4
#: Distance beyond start and target within which the ground is cleared of rocks on the route.
CLEARED_M = 2.0
#: Rocks lie at least this far from the outline of one that was placed.
FREE_M = 0.05
#: Radius about the target that a subframe shows, over its distance: 8 deg are more than half the diagonal of the
#: subframe of a navcam's right camera.
SEEN_FRACTION = 0.14
_ROCK_ARRAYS = ("shape", "position_m", "diameter_m", "height_m", "yaw_rad", "up")


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
    return base.changed(changes)


@dataclass(frozen=True)
class SunPath:
    """The sun over a run: it rotates westwards about the pole."""

    parameters: SunParameters

    def direction(self, time_s: float) -> Float64[np.ndarray, "3"]:
        """Unit vector to the sun, world axes."""
        p = self.parameters
        first = direction(np.radians(p.azimuth_deg), np.radians(p.elevation_deg))
        pole = direction(0.0, np.radians(p.latitude_deg))
        angle = -np.radians(p.hour_angle_deg_min * time_s / 60.0)
        cosine, sine = np.cos(angle), np.sin(angle)
        turned = cosine * first + sine * np.cross(pole, first) + (1.0 - cosine) * (pole @ first) * pole
        unit: Float64[np.ndarray, "3"] = turned / np.linalg.norm(turned)
        return unit

    def step(self, time_s: float) -> int:
        """Number of the interval within which pictures share a sun."""
        return int(time_s // self.parameters.held_s)

    def held(self, step: int, angular_radius_rad: float) -> Sun:
        """The sun in the middle of an interval."""
        return Sun(self.direction((step + 0.5) * self.parameters.held_s), angular_radius_rad)


@dataclass
class RunWorld:
    """Terrain, scene and sun of a run."""

    ground: SiteGround  #: with all rocks; the target's is named `TARGET`, obstacles `obstacle-1`, `obstacle-2`, ...
    base: Scene  #: the scene at the start, without the rover
    sun: SunPath
    target_triangles: Float64[np.ndarray, "triangles 3 3"]  #: the target's rock as rendered, which is the truth
    _latest: tuple[int, Scene] | None = field(default=None, repr=False)

    @classmethod
    def of(
        cls,
        p: RoverScenarioParameters,
        pixel_rad: float,
        streams: Streams,
        load_ground: LoadGround = SiteGround.from_bank,
    ) -> RunWorld:
        """The world of a run."""
        w = p.world
        bare = load_ground(site(w.site), terrain_parameters(w), w.bank_seed, w.terrain)
        ground = place_rocks(p, bare, streams.generator("placed rocks"))
        path = SunPath(p.sun)
        reach = p.start.distance_m + BACKGROUND_M
        middle, half = p.bearing_rad + np.pi, np.radians(w.background_half_deg)
        eye = Eye(w.east_m, w.north_m, EYE_HEIGHT_M, pixel_rad, float(middle), float(half), reach)
        lines = 2 * int(np.ceil(np.arcsinh(reach / MESH_FINEST_M * np.sinh(MESH_GROWTH)) / MESH_GROWTH)) + 1
        clouds = None
        if p.clouds is not None:
            level = float(ground.surface.height(w.east_m, w.north_m))
            clouds = CloudLayer.draw(p.clouds, streams.generator("clouds"), ground_m=level)
        scene = replace(
            site_scene(ground, eye, path.held(0, ground.site.environment.sun_radius_rad)),
            mesh_finest_m=MESH_FINEST_M,
            mesh_reach_m=reach,
            mesh_lines=lines,
            clouds=clouds,
        )
        return cls(ground, scene, path, _target_triangles(ground, scene.objects))

    @property
    def surface(self) -> Surface:
        """The ground's surface."""
        return self.ground.surface

    @property
    def site(self) -> Site:
        """The site."""
        return self.ground.site

    @property
    def rocks(self) -> RockField:
        """All rocks of the ground; placed ones have names."""
        if self.ground.rocks is None:
            raise ValueError("a furnished ground has rocks")
        return self.ground.rocks

    @property
    def target_number(self) -> int:
        """Number of the target's rock."""
        return self.rocks.by_name(TARGET)

    @property
    def placed_m(self) -> Float64[np.ndarray, "rocks 3"]:
        """East, north and diameter of the target's rock and of the obstacles."""
        numbers = list(self.rocks.names.values())
        return np.column_stack([self.rocks.position_m[numbers, :2], self.rocks.diameter_m[numbers]])

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
        step = self.sun.step(time_s)
        if self._latest is None or self._latest[0] != step:
            sun = self.sun.held(step, self.site.environment.sun_radius_rad)
            self._latest = (step, self.base.in_light(sun, self.ground.photometry(sun)))
        return self._latest[1]

    def shadow_caster(
        self,
        rover: RoverParameters,
        stance: Stance,
        mast: MastGeometry,
        angles_rad: tuple[float, float],
        target_m: Float64[np.ndarray, "3"],
        time_s: float,
    ) -> Objects | None:
        """The rover's mesh if its shadow may fall into a subframe about the target, else None."""
        seen_m = SEEN_FRACTION * float(np.linalg.norm(target_m - stance.world_from_rover.translation))
        sun = self.scene(time_s).sun.direction
        # the mesh is built only where its bounding sphere may cast a shadow there
        if not may_cast_shadow(rover_sphere(rover, stance, mast), sun, target_m, seen_m):
            return None
        body = rover_objects(rover, stance, mast, *angles_rad)
        return body if may_cast_shadow(body.spheres, sun, target_m, seen_m) else None

    def brightness(self, time_s: float) -> float:
        """Direct sunlight on the ground relative to 1 AU."""
        air = self.site.environment
        elevation = float(np.arcsin(self.scene(time_s).sun.direction[2]))
        return air.direct_share(elevation) * air.solar_irradiance


def place_rocks(p: RoverScenarioParameters, bare: SiteGround, rng: np.random.Generator) -> SiteGround:
    """The ground with the target's rock and obstacles; the bank's rocks on them and on the route are removed."""
    field = RockField.on(bare.surface, RockParameters(abundance=0.0, placed=placed_rocks(p)), rng)
    if bare.rocks is None:
        return replace(bare, rocks=field)
    kept = _kept_rocks(p, bare.rocks, field)
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(field, name), getattr(bare.rocks, name)[kept]]) for name in _ROCK_ARRAYS
    }
    return replace(bare, rocks=replace(field, **arrays))


def placed_rocks(p: RoverScenarioParameters) -> tuple[PlacedRock, ...]:
    """The target's rock and the obstacles, in world coordinates."""
    t, w = p.target, p.world
    bearing = p.bearing_rad
    along, right = np.array([np.sin(bearing), np.cos(bearing)]), np.array([-np.cos(bearing), np.sin(bearing)])
    rocks = [
        PlacedRock(
            name=TARGET,
            east_m=w.east_m,
            north_m=w.north_m,
            **t.model_dump(include={"diameter_m", "height_m", "shape", "yaw_deg"}),
        )
    ]
    for number, one in enumerate(p.obstacles, start=1):
        east, north = np.array([w.east_m, w.north_m]) + one.towards_start_m * along + one.right_m * right
        size = one.model_dump(include={"diameter_m", "height_m"})
        rocks.append(PlacedRock(name=f"obstacle-{number}", east_m=float(east), north_m=float(north), **size))
    return tuple(rocks)


def _kept_rocks(p: RoverScenarioParameters, rocks: RockField, placed: RockField) -> Bool[np.ndarray, "rocks"]:
    """Which of the bank's rocks stay: small ones near the route, all of them beyond, none on a placed rock."""
    w = p.world
    near = _distance(rocks, np.array([w.east_m, w.north_m])) < p.start.distance_m + CLEARED_M
    kept = ~near | (rocks.diameter_m <= w.largest_near_m)
    for position, diameter in zip(placed.position_m[:, :2], placed.diameter_m, strict=True):
        apart = _distance(rocks, position) - 0.6 * (rocks.diameter_m + diameter)
        kept &= apart > FREE_M
    return kept


def _distance(rocks: RockField, position: Float64[np.ndarray, "2"]) -> Float64[np.ndarray, "rocks"]:
    """Horizontal distance of the rocks from a position on the periodic ground."""
    away = rocks.position_m[:, :2] - position
    away -= rocks.period_m * np.round(away / rocks.period_m)
    distance: Float64[np.ndarray, "rocks"] = np.hypot(away[:, 0], away[:, 1])
    return distance


def _target_triangles(ground: SiteGround, objects: Objects) -> Float64[np.ndarray, "triangles 3 3"]:
    """Triangles of the body of the target's name that is nearest to its position: a periodic scene may hold copies."""
    if ground.rocks is None:
        raise ValueError("the ground has no rocks")
    number = ground.rocks.by_name(TARGET)
    bodies = np.flatnonzero(objects.names == number)
    position = ground.rocks.position_m[number]
    nearest = bodies[np.argmin(np.linalg.norm(objects.spheres[bodies, :2] - position[:2], axis=1))]
    first, end = objects.first_triangle[nearest : nearest + 2]
    return objects.triangles[first:end]
