"""Scene for the renderer: ground, objects and light, with cached results that images of it share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from marsyard.sim.render.arrays import to_device, vectors_to_device
from marsyard.sim.render.casters import casters_towards
from marsyard.sim.render.clouds import CloudLayer
from marsyard.sim.render.cones import Bounds, Cone, ground_in_cones, potentially_visible, spheres_in_cone
from marsyard.sim.render.device import Array3f, Array3f64, Float, Float64, Int32
from marsyard.sim.render.ground import Extent
from marsyard.sim.render.ground_shadow import GroundShadow, compute_ground_shadow, is_sun_above_slopes, slope_bounds
from marsyard.sim.render.micro_relief import MicroRelief, RoughGround
from marsyard.sim.render.objects import Objects
from marsyard.sim.render.obstructions import MOUND_RANGE, Mounds, Obstructions, Shelter
from marsyard.sim.render.pebbles import PebbleField
from marsyard.sim.render.photometry import Photometry
from marsyard.sim.render.rock_surface import ROVER_DUST, WRINKLED_M, describe_grain
from marsyard.sim.render.shading import Light, Materials, ObjectSurfaces
from marsyard.sim.render.shadows import Footprint, Occluders
from marsyard.sim.render.sky import Sun
from marsyard.sim.render.skyline import Relief, Skyline
from marsyard.sim.render.spline import Terrain
from marsyard.sim.render.texture import Cover, Texture
from marsyard.sim.terrain import Surface
from marsyard.sim.terrain.sites import SiteCover, SitePebbles
from marsyard.sim.terrain.surface import HEIGHT, UNIFORM

#: Rounding error of a mean of heights of a few km in single precision, metres.
ROUNDING_M = 0.01
NO_TEXTURE = Texture()
NO_RELIEF = MicroRelief(1.0, np.empty(0), UNIFORM, 0.0)


@dataclass(frozen=True)
class Scene:
    """Ground, objects and light of an image.

    - centre_m: world x, y around which the mesh is dense: below a camera near the ground, or the site of a descent
    - relief: relief finer than the terrain's samples; its slopes change the shading, but not normals and range
    - ground_texture, object_texture: albedo variation finer than the terrain's samples
    - pebbles: pebbles on the ground; None without
    - cover: sharp borders of sand on bedrock; None without
    - horizon: relief on the horizon; None without
    - dust_albedo, dust_cover: albedo of dust, and fraction of the level faces of rocks that it covers
    - caster_diameter_m: diameter of a round body at the camera that casts a shadow, such as a lander
    - ground_shadows: whether the ground casts shadows, with a penumbra; shadows of objects have hard edges
    - clouds: drifting clouds that cast shadows
    - mesh_finest_m, mesh_half_width_m, mesh_lines: spacing of the mesh at the centre, its half width, and its number of
      lines along each axis
    - among_objects: whether the camera is among the objects, so that nearly all visible ground may be in their shadows.
      Otherwise the shaded region is computed in advance, and only its pixels are tested (`shadows.Footprint`)
    - edge_rays: rays along each side of a pixel at an edge (`marsyard.sim.render.renderer`); with 1, one ray per pixel
    - visible_m: minimum and maximum x, then y, of the visible ground; None for no bounds
    """

    surface: Surface
    centre_m: tuple[float, float]
    sun: Sun
    photometry: Photometry
    objects: Objects = field(default_factory=Objects.none)
    relief: MicroRelief = NO_RELIEF
    ground_texture: Texture = NO_TEXTURE
    object_texture: Texture = NO_TEXTURE
    pebbles: SitePebbles | None = None
    cover: SiteCover | None = None
    horizon: Relief | None = None
    dust_albedo: float = 0.3
    dust_cover: float = 0.0
    caster_diameter_m: float = 0.0
    ground_shadows: bool = True
    clouds: CloudLayer | None = None
    mesh_finest_m: float = 12.0
    mesh_half_width_m: float = 20000.0
    mesh_lines: int = 513
    among_objects: bool = False
    edge_rays: int = 2
    visible_m: Bounds | None = None

    def with_objects(self, objects: Objects) -> Scene:
        """Return the scene with other objects."""
        return self._replace("height_range_m", "max_slopes", "shadow", objects=objects)

    def with_light(self, sun: Sun, photometry: Photometry) -> Scene:
        """Return the scene with another light."""
        # infinite bounds of the slope depend on the direction of the sun
        slopes = ("max_slopes",) if np.all(np.isfinite(self.max_slopes)) else ()
        return self._replace("height_range_m", *slopes, sun=sun, photometry=photometry)

    def with_mesh(self, centre_m: tuple[float, float], finest_m: float, half_width_m: float, lines: int) -> Scene:
        """Return the scene with another mesh of the ground."""
        mesh = {"centre_m": centre_m, "mesh_finest_m": finest_m, "mesh_half_width_m": half_width_m, "mesh_lines": lines}
        return self._replace("height_range_m", "max_slopes", "shadow", **mesh)

    def with_viewpoint(
        self, objects: Objects, centre_m: tuple[float, float], finest_m: float, half_width_m: float, lines: int
    ) -> Scene:
        """Return the scene for another camera, with other objects and another mesh of the same ground."""
        mesh = {"centre_m": centre_m, "mesh_finest_m": finest_m, "mesh_half_width_m": half_width_m, "mesh_lines": lines}
        return self._replace("height_range_m", "max_slopes", objects=objects, **mesh)

    def with_edge_rays(self, edge_rays: int) -> Scene:
        """Return the scene with another number of rays at edges."""
        return self._replace(*self._results, edge_rays=edge_rays)

    def with_photometry(self, photometry: Photometry) -> Scene:
        """Return the scene with another photometry under the same sun."""
        return self._replace(*self._results, photometry=photometry)

    @property
    def _results(self) -> set[str]:
        """Names of the cached results that exist."""
        return set(self.__dict__) - {field.name for field in fields(self)}

    def _replace(self, *results: str, **changes: Any) -> Scene:
        """Return a changed scene with these results of this one, which remain valid; missing results are computed."""
        scene = replace(self, **changes)
        scene.__dict__.update({name: getattr(self, name) for name in results})
        return scene

    def restrict_to_cones(self, cones: Sequence[Cone]) -> Scene:
        """Return the scene without objects and ground shadows that are invisible in images within these cones."""
        sun, min_height = np.asarray(self.sun.direction, dtype=np.float64), self.height_range_m[0]
        spheres, (is_visible, hides_sky) = self.objects.spheres, np.zeros((2, len(self.objects)), dtype=np.bool_)
        # rocks hide the sky from visible ground up to this distance
        sky_spheres = spheres * (1.0, 1.0, 1.0, MOUND_RANGE)
        for cone in cones:
            is_visible |= potentially_visible(spheres, sun, min_height, cone)
            if self.among_objects:
                hides_sky |= spheres_in_cone(sky_spheres, *cone)
        objects = self.objects.select(is_visible, hides_sky)
        visible_m = ground_in_cones(cones, min_height)
        return self._replace("height_range_m", "max_slopes", objects=objects, visible_m=visible_m)

    @property
    def extent(self) -> Extent:
        """Bounds of the mesh and of the height of the surface."""
        (x, y), half_width = self.centre_m, self.mesh_half_width_m
        # coarser levels are means of finer ones: none is higher, except for rounding
        highest = self.height_range_m[1] + ROUNDING_M
        return Extent(*map(Float64, (x - half_width, x + half_width, y - half_width, y + half_width, highest)))

    @cached_property
    def terrain(self) -> Terrain:
        """The surface on the device."""
        return Terrain.of_surface(self.surface, ceilings=False)

    @cached_property
    def terrain_with_ceilings(self) -> Terrain:
        """The surface on the device, with the height bounds of its levels."""
        return Terrain.of_surface(self.surface, ceilings=True)

    @cached_property
    def height_range_m(self) -> tuple[float, float]:
        """Minimum and maximum height of the ground, metres."""
        # control values bound the surface
        heights = self.surface.levels[0][..., HEIGHT]
        return float(heights.min()), float(heights.max())

    @cached_property
    def max_slopes(self) -> tuple[float, float]:
        """Upper bounds of the slope along x and y; infinite if ground may be as steep as the rays of the sun."""
        return slope_bounds(self.surface, self.sun)

    @cached_property
    def shadow(self) -> GroundShadow | None:
        """Shadow of the ground; None if all ground is lit, or the sun is not up."""
        if not self.ground_shadows or self.sun.direction[2] <= 0.0 or is_sun_above_slopes(self.sun, self.max_slopes):
            return None
        return compute_ground_shadow(self.surface, self.sun, self.height_range_m, self.visible_m)

    @cached_property
    def footprint(self) -> Footprint | None:
        """Region of the ground that objects may shade; None for all ground."""
        if self.among_objects:
            return None
        sun = np.asarray(self.sun.direction, dtype=np.float64)
        return Footprint.of(self.objects.spheres, sun, self.height_range_m[0])

    @cached_property
    def occluders(self) -> Occluders:
        """Occluders of the sun."""
        return Occluders(self.shadow, casters_towards(self.objects, self.sun), self.footprint, self.among_objects)

    @cached_property
    def obstructions(self) -> Obstructions | None:
        """Bodies that hide the sky and the aureole from the ground around them; None from afar."""
        mounds, shelter = self.objects.mounds, self.objects.shelter
        if not self.among_objects or (len(mounds) == 0 and shelter is None):
            return None
        sun = np.asarray(self.sun.direction, dtype=np.float64)
        return Obstructions(Mounds.of(mounds, sun), None if shelter is None else Shelter.of(shelter, sun))

    @cached_property
    def skyline(self) -> Skyline | None:
        """Relief on the horizon, on the device."""
        return None if self.horizon is None else Skyline.of(self.horizon)

    @cached_property
    def materials(self) -> Materials:
        """Relief, textures, normals and albedo."""
        objects, surfaces = self.objects, None
        if len(objects) > 0:
            # dust covers a part of the level faces of rocks and rovers, less of rovers
            covered = self.dust_cover * np.where(objects.is_rock, 1.0, ROVER_DUST * objects.is_rover)
            dust_albedo = (1.0 - covered) * objects.albedo + covered * self.dust_albedo
            # only rocks and rovers with texture have grain
            sizes = 0.5 * (objects.bounds[:, 3:5] - objects.bounds[:, :2]).sum(axis=1)
            sizes = np.where(objects.is_rock, sizes, WRINKLED_M * objects.is_rover) * bool(
                self.object_texture.amplitudes
            )
            surfaces = ObjectSurfaces(
                vectors_to_device(Array3f, objects.normals.reshape(-1, 3)),
                to_device(Int32, objects.body_of_triangle),
                to_device(Float, objects.albedo),
                to_device(Float, dust_albedo),
                to_device(Float, describe_grain(objects.names, sizes)),
            )
        return Materials(
            RoughGround.of(self.relief),
            PebbleField.of(self.pebbles, self.surface) if self.pebbles is not None else None,
            Cover.of(self.cover, self.surface) if self.cover is not None else None,
            self.ground_texture.octaves,
            self.object_texture.octaves,
            surfaces,
        )

    def light(self, time_s: float) -> Light:
        """Return the illumination at a time."""
        photometry, clouds = self.photometry, None
        if self.clouds is not None:
            cloud_light = self.clouds.parameters.sky_light(self.sun)
            photometry = replace(photometry, sky_fraction=photometry.sky_fraction + cloud_light)
            # without direct sunlight clouds cast no shadows
            clouds = self.clouds.at_time(self.sun, time_s) if self.sun.direction[2] > 0.0 else None
        # clouds are not rendered, so they do not change the brightness of the sky
        return Light(
            Array3f64(*self.sun.direction.tolist()),
            Float64(self.sun.angular_radius_rad),
            Float(photometry.disc_fraction(self.sun)),
            photometry.law(self.sun),
            self.photometry.sky_model(self.sun),
            Float64(self.caster_diameter_m) if self.caster_diameter_m > 0.0 else None,
            clouds,
            self.obstructions,
            self.skyline,
        )
