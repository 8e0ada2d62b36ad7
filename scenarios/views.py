"""Views of a site: ground, scenes for cameras (ground, visible rocks, light), camera poses, and rendered images.

A `SiteGround` is a terrain of the bank with its rocks, a `Viewpoint` the position and resolution of a camera;
`site_scene` combines both into the scene for the renderer. All images near the viewpoint can use one scene, for example
a stereo pair.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.scenarios.cameras import Optics
from marsyard.scenarios.horizon import horizon_relief
from marsyard.scenarios.viewpoint import Viewpoint as Viewpoint  # also for the users of this module
from marsyard.scenarios.visible_rocks import select_rocks
from marsyard.sim.dynamics import State
from marsyard.sim.frames import rigid
from marsyard.sim.render import DustySky, Frame, Photometry, Scene, Sun, Texture, process_renderer
from marsyard.sim.render.backend import Backend
from marsyard.sim.render.micro_relief import MicroRelief, octave_heights
from marsyard.sim.sensor import CameraDesign, ImageMotion
from marsyard.sim.terrain import RockField, Site, Surface, TerrainBank, TerrainParameters

#: Scales of a site's terrains: kilometres for descents, or tens of metres for rovers and helicopters.
Scale = Literal["descent", "ground"]

#: Ground mesh: spacing next to the viewpoint divided by the viewpoint's height, its minimum divided by the spacing of
#: the terrain's samples, and its relative growth per line.
_MESH_FINEST, _MESH_SAMPLES, _MESH_GROWTH = 0.0085, 0.8, 0.012
#: Minimum half width of the ground mesh, divided by the viewpoint's height and in m.
_MIN_HALF_WIDTH_RATIO, _MIN_HALF_WIDTH_M = 14.0, 700.0
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


def load_ground(site: Site, terrain: TerrainParameters, seed: int, number: int) -> SiteGround:
    """Return `SiteGround.from_bank`; a process keeps the last four (12 MB each on a small terrain)."""
    source = terrain.source
    paths = () if source is None else (source.dtm, source.ortho)
    return _load_ground(
        site, terrain, seed, number, tuple(path.stat().st_mtime_ns for path in paths if path is not None)
    )


@lru_cache(maxsize=4)
def _load_ground(
    site: Site, terrain: TerrainParameters, seed: int, number: int, _modified_ns: tuple[int, ...]
) -> SiteGround:
    """Load a ground; the modification times of its files are a key of the cache, so that changed files are read."""
    return SiteGround.from_bank(site, terrain, seed, number)


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
    mesh = mesh_size(ground.surface.spacing_m, viewpoint.height_m, viewpoint.max_distance_m)
    objects = select_rocks(ground.rocks, ground.site.photometry.rock_albedo, viewpoint, mesh.half_width_m)
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
        cover=ground.site.cover if is_near else None,
        horizon=horizon,
        dust_albedo=ground.site.photometry.dust_albedo,
        dust_cover=ground.site.photometry.dust_cover,
        mesh_finest_m=mesh.finest_m,
        mesh_half_width_m=mesh.half_width_m,
        mesh_lines=mesh.lines,
        among_objects=is_near,
    )


class MeshSize(NamedTuple):
    """Size of the ground's mesh: spacing at the centre and half width, m, and number of lines."""

    finest_m: float
    half_width_m: float
    lines: int


def mesh_size(spacing_m: float, height_m: float, max_distance_m: float = np.inf) -> MeshSize:
    """Compute the size of the ground's mesh for a camera.

    - spacing_m: of the terrain's samples
    - height_m, max_distance_m: height of the camera above the ground, and largest distance of visible ground
    """
    # the terrain contains no detail for a mesh that is much finer than its samples
    finest_m = max(_MESH_FINEST * height_m, _MESH_SAMPLES * spacing_m)
    horizon_m = float(np.sqrt(2.0 * _MARS_RADIUS_M * height_m))
    half_width_m = max(_MIN_HALF_WIDTH_RATIO * height_m, _MIN_HALF_WIDTH_M, min(horizon_m, max_distance_m))
    # line k of the mesh is at finest_m * sinh(k growth) / sinh(growth)
    half_lines = int(np.ceil(np.arcsinh(half_width_m / finest_m * np.sinh(_MESH_GROWTH)) / _MESH_GROWTH))
    return MeshSize(finest_m, half_width_m, 2 * half_lines + 1)


def micro_relief(ground: SiteGround) -> MicroRelief:
    """Create the relief that is finer than the samples of the surface, for the renderer."""
    p, factors = ground.terrain, ground.surface.factors
    slope = float(np.radians(p.rms_slope_deg))
    coarsest, heights = octave_heights(p.hurst, slope, p.slope_baseline_m, p.outer_scale_m, p.spacing_m)
    return MicroRelief(coarsest, heights, factors, len(factors) / ground.surface.period_m)


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
