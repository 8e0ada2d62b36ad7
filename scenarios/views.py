"""Views of a site: scenes for cameras (ground, visible rocks, light), camera poses, and rendered images.

A `SiteGround` is a terrain of the bank with its rocks, a `Viewpoint` the position and resolution of a camera;
`site_scene` combines both into the scene for the renderer. All images near the viewpoint can use one scene, for example
a stereo pair.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.scenarios.cameras import Optics
from marsyard.scenarios.horizon import horizon_relief
from marsyard.sim.dynamics import State
from marsyard.sim.frames import rigid
from marsyard.sim.render import DustySky, Frame, Objects, Photometry, PixelRays, Scene, Sun, Texture, process_renderer
from marsyard.sim.render.backend import Backend
from marsyard.sim.render.texture import MicroRelief, octave_heights
from marsyard.sim.sensor import CameraDesign, ImageMotion
from marsyard.sim.terrain import RockField, RockMesh, Site, Surface, TerrainBank, TerrainParameters
from marsyard.sim.terrain.rocks.field import ROCK_ARRAYS, find_periods
from marsyard.sim.terrain.rocks.shapes import FINEST, max_pixels, rock_shapes

#: Scales of a site's terrains: kilometres for descents, or tens of metres for rovers and helicopters.
Scale = Literal["descent", "ground"]

#: Smallest rendered rocks, pixels.
SMALLEST_ROCK_PX = 1.5
#: Approximate maximum number of triangles of coarse rocks in a scene; smaller rocks are omitted to satisfy it.
ROCK_TRIANGLES = 600_000
#: Maximum number of additional triangles of detailed rocks in the viewpoint's sector; to satisfy it, all rocks are
#: rendered with less detail than the camera resolves.
DETAIL_TRIANGLES = 1_200_000
#: Number of triangles of a coarse rock.
_COARSE_TRIANGLES = 20
#: Radius around the viewpoint in which rocks outside the sector are included for their shadows: `_NEAR_HEIGHTS` times
#: the viewpoint's height, at least `_NEAR_M` metres.
_NEAR_HEIGHTS, _NEAR_M = 3.0, 5.0
#: Margin of a viewpoint's sector on each side, and depression of the image's upper edge above which the horizon is
#: assumed visible, radians.
_SECTOR_MARGIN_RAD, _MIN_DEPRESSION_RAD = np.radians(3.0), np.radians(5.0)
#: Ratio of the diameters of neighbouring size classes of rocks; rocks of one class are selected up to one distance.
_CLASS_RATIO = float(np.sqrt(2.0))
#: Ground mesh: spacing next to the viewpoint divided by the viewpoint's height, relative growth of the spacing per
#: line, and minimum half width, divided by this height and in m.
_MESH_FINEST, _MESH_GROWTH, _MIN_HALF_WIDTH_RATIO, _MIN_HALF_WIDTH_M = 0.0085, 0.012, 14.0, 700.0
#: Radius of Mars, m, for the distance of the horizon.
_MARS_RADIUS_M = 3.39e6
#: Maximum height of a viewpoint, m, at which it is among the rocks (`Scene.among_objects`).
_MAX_AMONG_ROCKS_M = 100.0


@dataclass(frozen=True)
class SiteGround:
    """The ground of a site at one scale: its surface, and its rocks (None without rocks)."""

    site: Site
    terrain: TerrainParameters
    surface: Surface
    rocks: RockField | None

    @classmethod
    def from_site(cls, site: Site, scale: Scale | None = None, *, seed: int = 1, number: int = 0) -> SiteGround:
        """Load terrain `number` of a site's bank, or build and store it; by default at the site's coarsest scale.

        Raises ValueError if the site has no terrain at that scale.
        """
        terrain = site.terrain(scale)
        bank = TerrainBank(terrain, seed)
        surface = bank.store(number)
        return cls(site, terrain, surface, bank.rocks(number, surface))

    @classmethod
    def from_bank(cls, site: Site, terrain: TerrainParameters, seed: int, number: int) -> SiteGround:
        """Load terrain `number` of a bank if it is stored, otherwise build it in memory, and place its rocks."""
        bank = TerrainBank(terrain, seed)
        surface = bank.terrain(number)
        return cls(site, terrain, surface, bank.rocks(number, surface))

    def photometry(self, sun: Sun) -> Photometry:
        """Return the photometry of this ground under a sun and the sky of the site's atmosphere."""
        reflectance = self.site.photometry
        air = self.site.environment
        sky = air.sky_fraction(float(np.arcsin(np.clip(sun.direction[2], -1.0, 1.0))), self.terrain.albedo)
        return Photometry(
            lunar_fraction=reflectance.lunar_fraction,
            surge_amplitude=reflectance.surge_amplitude,
            surge_width=reflectance.surge_width,
            sky_fraction=sky,
            sky_radiance=sky,
            surrounding_albedo=self.terrain.albedo,
            # None is a uniform sky; the model of a dusty sky needs forward scattering
            sky=None
            if air.optical_depth == 0.0 or air.single_scattering_albedo == 0.0 or air.asymmetry < 0.0
            else DustySky(air.optical_depth, air.single_scattering_albedo, air.asymmetry),
        )


@dataclass(frozen=True)
class Viewpoint:
    """Viewpoint of a camera: position, visible sector and resolution, which determine the detail of a scene.

    - east_m, north_m, height_m: position, and height above the ground
    - pixel_rad: angle of a pixel
    - azimuth_rad, half_width_rad: centre, clockwise from north, and half width of the visible sector; a half width of
      pi is the full circle
    - max_distance_m: maximum horizontal distance of visible ground; infinite if the horizon is visible
    """

    east_m: float
    north_m: float
    height_m: float
    pixel_rad: float
    azimuth_rad: float = 0.0
    half_width_rad: float = np.pi
    max_distance_m: float = np.inf

    @classmethod
    def from_pose(cls, rays: PixelRays, world_from_body: RigidTransform, surface: Surface) -> Viewpoint:
        """Compute the viewpoint of a camera at a pose."""
        east, north, up = (float(value) for value in world_from_body.apply(rays.centre))
        height = up - float(surface.height(east, north))
        axis = world_from_body.rotation.apply(rays.axis)
        elevation, half_angle = float(np.arcsin(np.clip(axis[2], -1.0, 1.0))), rays.half_angle_rad
        horizontal = float(np.cos(elevation))
        is_full_circle = np.sin(half_angle) >= horizontal or half_angle >= np.pi / 2
        half_width = np.pi if is_full_circle else np.arcsin(np.sin(half_angle) / horizontal)
        half_width = float(min(half_width + _SECTOR_MARGIN_RAD, np.pi))
        upper_edge = elevation + half_angle
        # twice the maximum distance on level ground, because slopes may descend; unlimited near the horizon
        max_distance_m = 2.0 * height / np.tan(-upper_edge) + _NEAR_M if upper_edge < -_MIN_DEPRESSION_RAD else np.inf
        return cls(
            east, north, height, rays.pixel_rad, float(np.arctan2(axis[0], axis[1])), half_width, float(max_distance_m)
        )


def render_state(
    backend: Backend, scene: Scene, optics: Optics, state: State, mounting: RigidTransform | None = None
) -> tuple[Frame, ImageMotion]:
    """Render the view of a camera at the body's origin, and compute the image motion during its exposure.

    `mounting` rotates the camera in the body.
    """
    pose = state.world_from_body if mounting is None else state.world_from_body * mounting
    frame = process_renderer(backend).render(scene, optics.rays, pose, state.time_s)
    rate = state.attitude.apply(state.body_rate_rad_s)
    return frame, ImageMotion.from_camera(optics.camera, frame.range_m, frame.world_from_body, state.velocity_m_s, rate)


def site_scene(ground: SiteGround, viewpoint: Viewpoint, sun: Sun) -> Scene:
    """Build the scene for a viewpoint: ground, resolved rocks, texture and light."""
    finest_m, half_width_m, lines = mesh_size(ground.surface.spacing_m, viewpoint.height_m, viewpoint.max_distance_m)
    objects = select_rocks(ground, viewpoint, half_width_m)
    is_near = viewpoint.height_m < _MAX_AMONG_ROCKS_M
    horizon = None
    if ground.site.hills and is_near:
        extinction_m = ground.site.environment.mean_extinction_m(0.0)
        horizon = horizon_relief(ground.site.hills, ground.surface, extinction_m, ground.terrain.albedo)
    return Scene(
        ground.surface,
        (viewpoint.east_m, viewpoint.north_m),
        sun,
        ground.photometry(sun),
        objects=objects,
        relief=micro_relief(ground),
        ground_texture=Texture(ground.site.ground_texture.coarsest_m, ground.site.ground_texture.amplitudes),
        object_texture=Texture(ground.site.rock_texture.coarsest_m, ground.site.rock_texture.amplitudes),
        pebbles=ground.site.pebbles if is_near else None,
        horizon=horizon,
        dust_albedo=ground.site.photometry.dust_albedo,
        dust_cover=ground.site.photometry.dust_cover,
        mesh_finest_m=finest_m,
        mesh_half_width_m=half_width_m,
        mesh_lines=lines,
        among_objects=is_near,
    )


def mesh_size(spacing_m: float, height_m: float, max_distance_m: float = np.inf) -> tuple[float, float, int]:
    """Return spacing at the centre, half width, m, and number of lines of the ground's mesh for a camera.

    - spacing_m: of the terrain's samples
    - height_m, max_distance_m: height of the camera above the ground, and largest distance of visible ground
    """
    # the terrain contains no detail for a mesh that is much finer than its samples
    finest_m = max(_MESH_FINEST * height_m, 0.8 * spacing_m)
    horizon_m = float(np.sqrt(2.0 * _MARS_RADIUS_M * height_m))
    half_width_m = max(_MIN_HALF_WIDTH_RATIO * height_m, _MIN_HALF_WIDTH_M, min(horizon_m, max_distance_m))
    # line k of the mesh is at finest_m * sinh(k growth) / sinh(growth)
    half_lines = int(np.ceil(np.arcsinh(half_width_m / finest_m * np.sinh(_MESH_GROWTH)) / _MESH_GROWTH))
    return finest_m, half_width_m, 2 * half_lines + 1


def micro_relief(ground: SiteGround) -> MicroRelief:
    """Create the relief that is finer than the samples of the surface, for the renderer."""
    p, factors = ground.terrain, ground.surface.factors
    slope = float(np.radians(p.rms_slope_deg))
    coarsest, heights = octave_heights(p.hurst, slope, p.slope_baseline_m, p.outer_scale_m, p.spacing_m)
    return MicroRelief(coarsest, heights, factors, len(factors) / ground.surface.period_m)


def select_rocks(ground: SiteGround, viewpoint: Viewpoint, farthest_m: float = np.inf) -> Objects:
    """Select the rocks that a camera resolves (`viewpoint`), and near rocks for their shadows.

    The names of the objects are the rocks' numbers in the field; each periodic copy of a rock is a body of its own. If
    rocks of `SMALLEST_ROCK_PX` need more than about `ROCK_TRIANGLES`, only larger rocks are selected. The level of
    detail is high enough that a rock cannot be distinguished from its finest mesh
    (`marsyard.sim.terrain.rocks.shapes.DEVIATION_PX`), within the limit of `DETAIL_TRIANGLES`.
    """
    field = ground.rocks
    if field is None or len(field) == 0:
        return Objects.none()
    smallest_rad, pixel_rad = smallest_rock_rad(field, viewpoint), _detail_pixel_rad(field, viewpoint)
    smallest_m = float(field.diameter_m.min())
    size_class = np.floor(np.log(field.diameter_m / smallest_m) / np.log(_CLASS_RATIO) + 1e-9)
    # maximum distance of each size class, and its horizontal part
    distance_m = smallest_m * _CLASS_RATIO ** (size_class + 0.5) / smallest_rad
    radius_m = np.sqrt(np.maximum(distance_m**2 - viewpoint.height_m**2, 0.0))
    radius_m = np.minimum(radius_m, min(farthest_m, viewpoint.max_distance_m))
    near = np.flatnonzero(_find_near_rocks(field, viewpoint, radius_m))
    subset = replace(field, names={}, **{name: getattr(field, name)[near] for name in ROCK_ARRAYS})
    mesh = subset.near(
        viewpoint.east_m, viewpoint.north_m, radius_m[near], above_m=viewpoint.height_m, pixel_rad=pixel_rad
    )
    # keep only triangles in the viewpoint's sector or near the viewpoint
    visible = _find_visible_triangles(mesh, viewpoint)
    return Objects.of_mesh(
        mesh.vertices,
        mesh.vertex_normals,
        mesh.faces[visible],
        near[mesh.rock_of_face[visible]].astype(np.int32),
        np.minimum(ground.site.photometry.rock_albedo * field.albedo, 1.0),
        mesh.body_of_face[visible],
    )


def smallest_rock_rad(field: RockField, viewpoint: Viewpoint) -> float:
    """Return the angular size of the smallest rocks in a scene.

    Rocks of diameter D are rendered up to the distance D / angle. With n rocks per square metre and a sector of half
    width w, they have ``20 w D**2 n / angle**2`` triangles. The result limits this number to `ROCK_TRIANGLES`.
    """
    if np.isfinite(viewpoint.max_distance_m):
        return SMALLEST_ROCK_PX * viewpoint.pixel_rad
    squared_diameters_per_m2 = float(np.sum(field.diameter_m**2)) / field.period_m**2
    limit_rad = np.sqrt(_COARSE_TRIANGLES * viewpoint.half_width_rad * squared_diameters_per_m2 / ROCK_TRIANGLES)
    return float(max(SMALLEST_ROCK_PX * viewpoint.pixel_rad, limit_rad))


def _detail_pixel_rad(field: RockField, viewpoint: Viewpoint) -> float:
    """Return the pixel angle for the detail of rocks, at least the smallest that `DETAIL_TRIANGLES` allows.

    Detail level k of a rock of diameter D is sufficient up to a size of p_k pixels. The additional triangles of the
    next level are therefore needed up to the distance ``D / (p_k * pixel angle)``.
    """
    triangles = np.array([rock_shapes(detail).faces.shape[0] for detail in range(FINEST + 1)])
    added_triangles = (np.diff(triangles) / max_pixels() ** 2).sum(axis=1)
    per_m2 = float(np.sum(field.diameter_m**2 * added_triangles[field.shape])) / field.period_m**2
    return float(max(viewpoint.pixel_rad, np.sqrt(viewpoint.half_width_rad * per_m2 / DETAIL_TRIANGLES)))


@dataclass(frozen=True)
class CameraMounting:
    """Typical mounting of a camera: terrain scale, height above the ground, and elevation of the optical axis.

    `on_rover_m` is the position x, y, z of a camera that is fixed to a rover's body, in the rover's frame; None for
    other cameras.
    """

    scale: Scale
    height_m: float
    elevation_deg: float
    on_rover_m: tuple[float, float, float] | None = None


#: Typical mountings of the cameras of `marsyard.sim.sensor.PRESETS`: first image of a descent, masts of 1.5 m, MER's
#: hazcams 0.53 m above the ground (Maki et al. 2003) at the front of the body, a helicopter at 10 m.
CAMERA_MOUNTINGS: Mapping[str, CameraMounting] = {
    "mer-descent-flown": CameraMounting("descent", 2000.0, -90.0),
    "mer-descent-field": CameraMounting("descent", 2000.0, -90.0),
    "mer-navcam": CameraMounting("ground", 1.5, -18.0),
    "mer-hazcam": CameraMounting("ground", 0.53, -40.0, (0.55, 0.0, 0.53)),
    "research-navcam": CameraMounting("ground", 1.5, -13.0),
    "research-pancam": CameraMounting("ground", 1.5, -5.0),
    "xc-55": CameraMounting("ground", 10.0, -90.0),
}


def camera_pose(
    surface: Surface,
    design: CameraDesign,
    east_m: float,
    north_m: float,
    height_m: float,
    azimuth_deg: float,
    elevation_deg: float,
) -> RigidTransform:
    """Return the body's pose for a camera direction; at -90 deg the azimuth is that of the upper edge."""
    if design.down:
        return nadir_pose(surface, east_m, north_m, height_m, azimuth_deg, 90.0 + elevation_deg)
    return mast_pose(surface, east_m, north_m, height_m, azimuth_deg, elevation_deg)


def mast_pose(
    surface: Surface, east_m: float, north_m: float, height_m: float, azimuth_deg: float, elevation_deg: float
) -> RigidTransform:
    """Return the pose of a mast's frame (x forward, y left, z up); azimuth clockwise from north."""
    rotation = Rotation.from_euler("ZY", [90.0 - azimuth_deg, -elevation_deg], degrees=True)
    return rigid(rotation, _position_above_ground(surface, east_m, north_m, height_m))


def nadir_pose(
    surface: Surface, east_m: float, north_m: float, altitude_m: float, azimuth_deg: float = 0.0, tilt_deg: float = 0.0
) -> RigidTransform:
    """Return the pose of a body whose camera looks along -z, down or tilted forward towards the azimuth.

    The azimuth, clockwise from north, is that of the image's upper edge.
    """
    rotation = Rotation.from_euler("ZX", [-azimuth_deg, tilt_deg], degrees=True)
    return rigid(rotation, _position_above_ground(surface, east_m, north_m, altitude_m))


def _position_above_ground(
    surface: Surface, east_m: float, north_m: float, height_m: float
) -> Float64[np.ndarray, "3"]:
    return np.array([east_m, north_m, float(surface.height(east_m, north_m)) + height_m])


def _find_near_rocks(
    field: RockField, viewpoint: Viewpoint, radius_m: Float64[np.ndarray, "rocks"]
) -> Bool[np.ndarray, "rocks"]:
    """Select rocks of which a copy is within their radius of the viewpoint; the rock field repeats with its period.

    All rocks with triangles of `_find_visible_triangles` are among them.
    """
    is_selected = np.zeros(len(field), dtype=np.bool_)
    # larger than any shape on the steepest ground
    extent = field.diameter_m + field.height_m
    near_m = max(_NEAR_HEIGHTS * viewpoint.height_m, _NEAR_M)
    for corner_m in find_periods(viewpoint.east_m, viewpoint.north_m, float(radius_m.max()), field.period_m):
        east, north = (field.position_m[:, :2] + (corner_m - (viewpoint.east_m, viewpoint.north_m))).T
        distance = np.hypot(east, north)
        within = np.flatnonzero(distance <= radius_m)
        distance, extent_within = distance[within], extent[within]
        bearing = np.arctan2(east[within], north[within]) - viewpoint.azimuth_rad
        bearing = np.abs((bearing + np.pi) % (2.0 * np.pi) - np.pi)
        widening = np.arcsin(np.minimum(extent_within / np.maximum(distance, 1e-9), 1.0))
        is_selected[within] |= (bearing <= viewpoint.half_width_rad + widening) | (distance <= near_m + extent_within)
    return is_selected


def _find_visible_triangles(mesh: RockMesh, viewpoint: Viewpoint) -> Bool[np.ndarray, "triangles"]:
    """Select the triangles whose first corner is in the viewpoint's sector or near the viewpoint."""
    offsets = mesh.vertices[:, :2] - (viewpoint.east_m, viewpoint.north_m)
    distance = np.hypot(*offsets.T)
    forward = offsets @ (np.sin(viewpoint.azimuth_rad), np.cos(viewpoint.azimuth_rad))
    near_m = max(_NEAR_HEIGHTS * viewpoint.height_m, _NEAR_M)
    # with a margin for rounding, so that a half width of pi selects all
    min_cosine = np.cos(viewpoint.half_width_rad) - 1e-9
    is_selected = (forward >= min_cosine * distance) | (distance <= near_m)
    return np.asarray(is_selected[mesh.faces[:, 0]])
