"""Views of a site: its ground, the rocks that a camera can tell apart, its light, and where cameras look from.

This is what scenarios near the ground share. A `SiteGround` is a site's terrain of the bank with its rocks; an `Eye`
says where a camera is and how fine it sees; `site_scene` puts both together under a sun as the scene that the renderer
draws. One scene serves all pictures taken close to its eye: a stereo pair, or a rover's next few steps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from types import MappingProxyType
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.frames import rigid
from marsyard.sim.render import DustySky, Objects, Photometry, PixelRays, Scene, Sun, Texture
from marsyard.sim.sensor import CameraDesign
from marsyard.sim.terrain import Environment, RockField, RockMesh, Site, Surface, TerrainBank, TerrainParameters
from marsyard.sim.terrain.rocks.shapes import FINEST, max_pixels, rock_shapes
from marsyard.sim.terrain.sites import SiteTexture

Scale = Literal["descent", "ground"]

#: Rocks smaller than this many pixels are left out.
SMALLEST_ROCK_PX = 1.5
#: Triangles of coarsely drawn rocks that a scene may have: beyond, smaller rocks are left out.
ROCK_TRIANGLES = 600_000
#: Triangles that finely drawn, near rocks may have besides: beyond, all are drawn more coarsely than a camera sees.
#: Those that are close beside the eye, out of its sight, come on top.
DETAIL_TRIANGLES = 1_200_000
#: Triangles of a rock drawn coarsely, as nearly all are.
_COARSE_TRIANGLES = 80
#: Rocks out of sight whose shadows may fall into the picture are kept within this many heights of the eye, and metres.
_BESIDE_HEIGHTS, _BESIDE_M = 3.0, 5.0
#: Ratio between the sizes of neighbouring classes of rocks.
_CLASS_RATIO = float(np.sqrt(2.0))
#: Spacing of the mesh over the height of the eye, by how much it grows with distance, and how far it reaches at least.
_MESH_FINEST, _MESH_GROWTH, _MESH_REACH_HEIGHTS, _MESH_REACH_M = 0.0085, 0.012, 14.0, 700.0
#: Radius of Mars, by which its horizon is as far as the mesh has to reach where an eye sees it.
_MARS_RADIUS_M = 3.39e6
#: Height of the eye below which pictures are taken among the rocks.
_LOW_M = 100.0


@dataclass(frozen=True)
class SiteGround:
    """The ground of a site at one scale.

    Attributes
    ----------
    site
        The site: its light and how its ground scatters it.
    terrain
        What the surface was made from.
    surface
        The terrain.
    rocks
        Its rocks; None where it has none.
    """

    site: Site
    terrain: TerrainParameters
    surface: Surface
    rocks: RockField | None

    @classmethod
    def of(cls, site: Site, scale: Scale | None = None, *, seed: int = 1, number: int = 0) -> SiteGround:
        """Terrain `number` of a site's bank, from the disk or built; by default at the site's coarsest scale.

        Raises ValueError where the site has no terrain at that scale.
        """
        return cls.from_bank(site, site.terrain(scale), seed, number)

    @classmethod
    def from_bank(cls, site: Site, terrain: TerrainParameters, seed: int, number: int) -> SiteGround:
        """Load terrain `number` of a bank from the disk, or build it, and place its rocks."""
        bank = TerrainBank(terrain, seed)
        return cls(site, terrain, bank.terrain(number), bank.rocks(number))

    def photometry(self, sun: Sun) -> Photometry:
        """How this ground scatters the light of this sun and of the sky of the site's air."""
        law = self.site.photometry
        air = self.site.environment
        sky = air.sky_share(float(np.arcsin(np.clip(sun.direction[2], -1.0, 1.0))))
        return Photometry(
            lunar_share=law.lunar_share,
            surge_amplitude=law.surge_amplitude,
            surge_width=law.surge_width,
            sky_share=sky,
            sky_radiance=sky,
            surrounding_albedo=self.terrain.albedo,
            sky=_dusty(air),
        )


def _dusty(air: Environment) -> DustySky | None:
    """The sky of a site's air; None, an even one, where the air scatters none or scatters it backward."""
    if air.optical_depth == 0.0 or air.single_scattering_albedo == 0.0 or air.asymmetry < 0.0:
        return None
    return DustySky(air.optical_depth, air.single_scattering_albedo, air.asymmetry)


@dataclass(frozen=True)
class Eye:
    """Where a camera is, which way it faces and how fine it sees: what decides the detail of a scene.

    Attributes
    ----------
    east_m, north_m, height_m
        Its place, and its height above the ground there.
    pixel_rad
        Angle that a pixel takes.
    azimuth_rad, half_width_rad
        Middle and half width of the sector that it sees, clockwise from north; a half width of pi is all round.
    reach_m
        Horizontal distance beyond which it sees no ground; infinite where it sees the horizon.
    """

    east_m: float
    north_m: float
    height_m: float
    pixel_rad: float
    azimuth_rad: float = 0.0
    half_width_rad: float = np.pi
    reach_m: float = np.inf

    @classmethod
    def of(cls, rays: PixelRays, world_from_body: RigidTransform, surface: Surface) -> Eye:
        """The eye of a camera at this pose."""
        east, north, up = (float(value) for value in world_from_body.apply(rays.centre))
        height = up - float(surface.height(east, north))
        axis = world_from_body.rotation.apply(rays.axis)
        elevation, widest = float(np.arcsin(np.clip(axis[2], -1.0, 1.0))), rays.half_angle_rad
        beside = float(np.cos(elevation))
        half_width = np.pi if np.sin(widest) >= beside or widest >= np.pi / 2 else np.arcsin(np.sin(widest) / beside)
        highest = elevation + widest
        # twice as far as level ground, for slopes that fall away
        reach = 2.0 * height / np.tan(-highest) + _BESIDE_M if highest < -np.radians(5.0) else np.inf
        return cls(
            east,
            north,
            height,
            rays.pixel_rad,
            float(np.arctan2(axis[0], axis[1])),
            float(min(half_width + np.radians(3.0), np.pi)),
            float(reach),
        )


def site_scene(ground: SiteGround, eye: Eye, sun: Sun) -> Scene:
    """The scene that a camera sees from here: ground, the rocks it can tell apart, texture and light.

    Near the ground pictures are taken among the rocks; from higher up they show where their shadows fall.
    """
    spacing = ground.surface.spacing_m
    finest = max(_MESH_FINEST * eye.height_m, 0.8 * spacing)
    horizon = float(np.sqrt(2.0 * _MARS_RADIUS_M * eye.height_m))
    reach = max(_MESH_REACH_HEIGHTS * eye.height_m, _MESH_REACH_M, min(horizon, eye.reach_m))
    half = int(np.ceil(np.arcsinh(reach / finest * np.sinh(_MESH_GROWTH)) / _MESH_GROWTH))
    return Scene(
        ground.surface,
        (eye.east_m, eye.north_m),
        sun,
        ground.photometry(sun),
        objects=rocks_in_sight(ground, eye, reach),
        ground_texture=_texture(ground.site.ground_texture),
        object_texture=_texture(ground.site.rock_texture),
        mesh_finest_m=finest,
        mesh_reach_m=reach,
        mesh_lines=2 * half + 1,
        among_objects=eye.height_m < _LOW_M,
    )


def rocks_in_sight(ground: SiteGround, eye: Eye, farthest_m: float = np.inf) -> Objects:
    """The rocks that the eye can tell apart, and those near it whose shadows it may see; bodies carry rocks' numbers.

    Where rocks of `SMALLEST_ROCK_PX` would come to more than about `ROCK_TRIANGLES`, only larger ones are taken. Rocks
    are drawn so finely that they look the same as their finest shape
    (`marsyard.sim.terrain.rocks.shapes.DEVIATION_PX`), except where that takes more than `DETAIL_TRIANGLES`, as fine
    pixels over fields of clinker do.
    """
    field = ground.rocks
    if field is None or len(field) == 0:
        return Objects.none()
    smallest_rad, pixel_rad = smallest_rock_rad(field, eye), _pixel_of_detail_rad(field, eye)
    reach = min(farthest_m, eye.reach_m)
    meshes = []
    for low, members in _size_classes(field):
        # from above, even rocks right below are far away
        horizontal = np.sqrt(max((low * np.sqrt(_CLASS_RATIO) / smallest_rad) ** 2 - eye.height_m**2, 0.0))
        radius = float(min(horizontal, reach))
        some = members[_near_sector(field, members, eye, radius)]
        if some.size:
            mesh = _subset(field, some).near(eye.east_m, eye.north_m, radius, above_m=eye.height_m, pixel_rad=pixel_rad)
            meshes.append(replace(mesh, rock_of_face=some[mesh.rock_of_face].astype(np.int32)))
    return _in_sight(meshes, eye, ground.site.photometry.rock_albedo)


def _in_sight(meshes: Sequence[RockMesh], eye: Eye, albedo: float) -> Objects:
    """What of some meshes lies in the eye's sector or close beside it."""
    if not meshes:
        return Objects.none()
    seen = [_in_sector(mesh, eye) for mesh in meshes]
    vertices = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    bodies = np.cumsum([0] + [int(mesh.body_of_face.max(initial=-1)) + 1 for mesh in meshes])
    kept = list(zip(meshes, seen, vertices.astype(np.int32), bodies.astype(np.int32), strict=False))
    return Objects.of_mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.vertex_normals for mesh in meshes]),
        np.concatenate([mesh.faces[some] + first for mesh, some, first, _ in kept]),
        np.concatenate([mesh.rock_of_face[some] for mesh, some, _, _ in kept]),
        albedo,
        np.concatenate([mesh.body_of_face[some] + first for mesh, some, _, first in kept]),
    )


def smallest_rock_rad(field: RockField, eye: Eye) -> float:
    """Angle under which the smallest rocks are seen that are worth drawing.

    Rocks of diameter D are drawn to the distance D / angle: n of them to the square metre of a sector of half width w
    make ``80 w D**2 n / angle**2`` triangles.
    """
    if np.isfinite(eye.reach_m):
        return SMALLEST_ROCK_PX * eye.pixel_rad
    squares = float(np.sum(field.diameter_m**2)) / field.period_m**2
    affordable = np.sqrt(_COARSE_TRIANGLES * eye.half_width_rad * squares / ROCK_TRIANGLES)
    return float(max(SMALLEST_ROCK_PX * eye.pixel_rad, affordable))


def _pixel_of_detail_rad(field: RockField, eye: Eye) -> float:
    """The pixel for which rocks are drawn: the eye's, or the smallest that `DETAIL_TRIANGLES` allow.

    A rock of diameter D that is held by its level k up to p_k pixels needs the next level's additional triangles up to
    the distance ``D / (p_k pixel)``.
    """
    triangles = np.array([rock_shapes(detail).faces.shape[0] for detail in range(FINEST + 1)])
    added = (np.diff(triangles) / max_pixels() ** 2).sum(axis=1)
    per_m2 = float(np.sum(field.diameter_m**2 * added[field.shape])) / field.period_m**2
    return float(max(eye.pixel_rad, np.sqrt(eye.half_width_rad * per_m2 / DETAIL_TRIANGLES)))


@dataclass(frozen=True)
class Stance:
    """How a camera usually stands: at which scale of terrain, how high, and how far its axis points above the horizon.

    The elevation of a camera that looks down is -90 deg.
    """

    scale: Scale
    height_m: float
    elevation_deg: float


#: Usual stances of the cameras of `marsyard.sim.sensor.PRESETS`: the first picture of a descent, masts of 1.5 m, MER's
#: hazcams 0.53 m above the ground (Maki et al. 2003), a helicopter at 10 m.
STANCES: Mapping[str, Stance] = MappingProxyType(
    {
        "mer-descent-flown": Stance("descent", 2000.0, -90.0),
        "mer-descent-field": Stance("descent", 2000.0, -90.0),
        "mer-navcam": Stance("ground", 1.5, -18.0),
        "mer-hazcam": Stance("ground", 0.53, -40.0),
        "research-navcam": Stance("ground", 1.5, -13.0),
        "research-pancam": Stance("ground", 1.5, -5.0),
        "xc-55": Stance("ground", 10.0, -90.0),
    }
)


def camera_pose(
    surface: Surface,
    design: CameraDesign,
    east_m: float,
    north_m: float,
    height_m: float,
    azimuth_deg: float,
    elevation_deg: float,
) -> RigidTransform:
    """Pose of the body of a camera whose axis points this way; at -90 deg the azimuth is the picture's upper edge's."""
    if design.down:
        return nadir_pose(surface, east_m, north_m, height_m, azimuth_deg, 90.0 + elevation_deg)
    return mast_pose(surface, east_m, north_m, height_m, azimuth_deg, elevation_deg)


def mast_pose(
    surface: Surface, east_m: float, north_m: float, height_m: float, azimuth_deg: float, elevation_deg: float
) -> RigidTransform:
    """Pose of a mast's frame (x forward, y left, z up) above the ground, looking this way.

    Azimuth is clockwise from north, elevation above the horizon.
    """
    turn = Rotation.from_euler("ZY", [90.0 - azimuth_deg, -elevation_deg], degrees=True)
    return rigid(turn, _above(surface, east_m, north_m, height_m))


def nadir_pose(
    surface: Surface, east_m: float, north_m: float, altitude_m: float, azimuth_deg: float = 0.0, tilt_deg: float = 0.0
) -> RigidTransform:
    """Pose of a body whose camera looks along -z: straight down, or tilted forward towards the azimuth.

    The azimuth, clockwise from north, is that of the picture's upper edge.
    """
    turn = Rotation.from_euler("ZX", [-azimuth_deg, tilt_deg], degrees=True)
    return rigid(turn, _above(surface, east_m, north_m, altitude_m))


def _above(surface: Surface, east_m: float, north_m: float, height_m: float) -> Float64[np.ndarray, "3"]:
    return np.array([east_m, north_m, float(surface.height(east_m, north_m)) + height_m])


def _texture(of_site: SiteTexture) -> Texture:
    return Texture(of_site.coarsest_m, of_site.amplitudes)


def _size_classes(field: RockField) -> list[tuple[float, Int64[np.ndarray, "members"]]]:
    """Smallest diameter and rocks' numbers of each class of sizes."""
    smallest = float(field.diameter_m.min())
    number = np.floor(np.log(field.diameter_m / smallest) / np.log(_CLASS_RATIO) + 1e-9).astype(int)
    return [(smallest * _CLASS_RATIO ** int(one), np.flatnonzero(number == one)) for one in np.unique(number)]


def _subset(field: RockField, members: Int64[np.ndarray, "members"]) -> RockField:
    """The field of some of its rocks, which are counted anew."""
    arrays = ("shape", "position_m", "diameter_m", "height_m", "yaw_rad", "up")
    return replace(field, names={}, **{name: getattr(field, name)[members] for name in arrays})


def _near_sector(
    field: RockField, members: Int64[np.ndarray, "members"], eye: Eye, radius_m: float
) -> Bool[np.ndarray, "members"]:
    """Which rocks may reach, where they lie or repeat within a radius of the eye, to what `_in_sector` keeps."""
    period, near = field.period_m, np.zeros(members.size, dtype=np.bool_)
    # wider than any shape, leaning as far as the ground may
    wide = field.diameter_m[members] + field.height_m[members]
    close = max(_BESIDE_HEIGHTS * eye.height_m, _BESIDE_M)
    here = np.array([eye.east_m, eye.north_m])
    first = field.position_m[members, :2] + np.floor(here / period) * period - here
    repeated = range(-int(np.ceil(radius_m / period)), int(np.ceil(radius_m / period)) + 1)
    for column, row in product(repeated, repeated):
        away = first + np.array([column, row]) * period
        distance = np.hypot(*away.T)
        turned = np.abs((np.arctan2(away[:, 0], away[:, 1]) - eye.azimuth_rad + np.pi) % (2.0 * np.pi) - np.pi)
        widening = np.arcsin(np.minimum(wide / np.maximum(distance, 1e-9), 1.0))
        within = (turned <= eye.half_width_rad + widening) | (distance <= close + wide)
        near |= within & (distance <= radius_m)
    return near


def _in_sector(mesh: RockMesh, eye: Eye) -> Bool[np.ndarray, "triangles"]:
    """Which triangles have their first corner in the eye's sector or close beside it."""
    away = mesh.vertices[:, :2] - (eye.east_m, eye.north_m)
    beside = np.arctan2(away[:, 0], away[:, 1]) - eye.azimuth_rad
    turned = np.abs((beside + np.pi) % (2.0 * np.pi) - np.pi)
    close = max(_BESIDE_HEIGHTS * eye.height_m, _BESIDE_M)
    corners = (turned <= eye.half_width_rad) | (np.hypot(*away.T) <= close)
    inside: Bool[np.ndarray, "triangles"] = corners[mesh.faces[:, 0]]
    return inside
