"""A scene: ground, objects and light, and the quantities that kernels need of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float64

from marsyard.sim.render.clouds import CloudLayer, no_cover
from marsyard.sim.render.kernels.ground import height_range
from marsyard.sim.render.kernels.shading import Occluders
from marsyard.sim.render.kernels.structs import Bounds, Extent, Footprint, GroundShadow, Light, Materials
from marsyard.sim.render.mesh import graded_offsets
from marsyard.sim.render.objects import Objects
from marsyard.sim.render.photometry import Photometry, Sun, Texture
from marsyard.sim.render.shadows import (
    EVERYWHERE,
    NO_SHADOW,
    Cone,
    casters_towards,
    ground_in_cones,
    ground_shadow,
    potentially_visible,
    shadow_footprint,
    slope_bounds,
    sun_over_slopes,
)
from marsyard.sim.terrain import Surface

#: Rounding of a mean of heights in single precision, metres, at a few km.
ROUNDING_M = 0.01
NO_TEXTURE = Texture()
NO_CLOUDS = (no_cover(), np.zeros(5))


@dataclass(frozen=True)
class Scene:
    """Ground, objects and light.

    - centre_m: world x, y around which the mesh is dense: below a camera near the ground, or the site of a descent
    - ground_texture, object_texture: albedo finer than the terrain's samples
    - caster_diameter_m: diameter of a body at the camera that casts a shadow, as a lander seen against the sun
    - ground_shadows: whether the ground shades itself, with a penumbra; shadows of objects are hard
    - clouds: clouds that dim the sun as they drift
    - mesh_finest_m, mesh_reach_m, mesh_lines: spacing of the mesh at the centre, its extent to each side, and the
      number of its lines
    - among_objects: whether pictures are taken from among the objects, whose shadows may then fall nearly anywhere.
      Otherwise the region where they may fall is computed in advance, which spares all other pixels the search
      (`marsyard.sim.render.shadows`)
    - edge_rays: rays along each side of a pixel at an edge (`marsyard.sim.render.renderer`); 1 draws every pixel by one
    - shown_m: bounds of x, then of y, of what pictures show; None for no bounds
    """

    surface: Surface
    centre_m: tuple[float, float]
    sun: Sun
    photometry: Photometry
    objects: Objects = field(default_factory=Objects.none)
    ground_texture: Texture = NO_TEXTURE
    object_texture: Texture = NO_TEXTURE
    caster_diameter_m: float = 0.0
    ground_shadows: bool = True
    clouds: CloudLayer | None = None
    mesh_finest_m: float = 12.0
    mesh_reach_m: float = 20000.0
    mesh_lines: int = 513
    among_objects: bool = False
    edge_rays: int = 2
    shown_m: Bounds | None = None

    @cached_property
    def mesh_offsets(self) -> Float64[np.ndarray, "lines"]:
        """Offsets of the mesh's lines from the centre."""
        return graded_offsets(self.mesh_reach_m, self.mesh_finest_m, self.mesh_lines)

    def with_objects(self, objects: Objects) -> Scene:
        """Replace the objects; keep the results computed for the ground."""
        return self._keep_results(
            replace(self, objects=objects), "mesh_offsets", "height_range_m", "max_slopes", "shadow"
        )

    def in_light(self, sun: Sun, photometry: Photometry) -> Scene:
        """Replace the light."""
        other = self._keep_results(replace(self, sun=sun, photometry=photometry), "mesh_offsets", "height_range_m")
        # the other sun may have bounds although this one has none
        return self._keep_results(other, "max_slopes") if np.all(np.isfinite(self.max_slopes)) else other

    def _keep_results(self, other: Scene, *names: str) -> Scene:
        """Copy cached results of this scene that hold for another."""
        other.__dict__.update({name: getattr(self, name) for name in names})
        return other

    def within(self, cones: Sequence[Cone]) -> Scene:
        """Restrict objects, and the ground's shadow, to those that pictures within these cones may show."""
        sun, lowest = np.asarray(self.sun.direction, dtype=np.float64), self.height_range_m[0]
        kept = np.zeros(len(self.objects), dtype=np.bool_)
        for cone in cones:
            kept |= potentially_visible(self.objects.spheres, sun, lowest, cone)
        less = replace(self, objects=self.objects.only(kept), shown_m=ground_in_cones(cones, lowest))
        return self._keep_results(less, "mesh_offsets", "height_range_m", "max_slopes")

    @property
    def extent_m(self) -> Extent:
        """Bounds of the mesh in x, then in y, and of the surface's height."""
        (x, y), reach = self.centre_m, self.mesh_reach_m
        # coarser levels are means of finer ones: none is higher, except for rounding
        return x - reach, x + reach, y - reach, y + reach, self.height_range_m[1] + ROUNDING_M

    @cached_property
    def height_range_m(self) -> tuple[float, float]:
        """Bounds of the ground's height."""
        low, high = height_range(self.surface.levels[0])
        return float(low), float(high)

    @cached_property
    def max_slopes(self) -> tuple[float, float]:
        """Bounds of the ground's slope along x and y; infinite where it may rise as steeply as the sun's rays."""
        return slope_bounds(self.surface, self.sun)

    @cached_property
    def shadow(self) -> GroundShadow:
        """The ground's shadow."""
        if not self.ground_shadows or self.sun.direction[2] <= 0.0 or sun_over_slopes(self.sun, self.max_slopes):
            return NO_SHADOW
        return ground_shadow(self.surface, self.sun, self.height_range_m, self.shown_m)

    @cached_property
    def footprint(self) -> Footprint:
        """Region where objects may shade the ground."""
        if self.among_objects:
            return EVERYWHERE
        towards = np.asarray(self.sun.direction, dtype=np.float64)
        return shadow_footprint(self.objects.spheres, towards, self.height_range_m[0])

    @cached_property
    def occluders(self) -> Occluders:
        """Occluders of the sun, for kernels."""
        return Occluders(self.shadow, casters_towards(self.objects, self.sun), self.footprint)

    @cached_property
    def materials(self) -> Materials:
        """Textures, normals and albedo, for kernels."""
        objects = self.objects
        textures = self.ground_texture.arrays(), self.object_texture.arrays()
        return Materials(*textures, objects.normals, objects.body_of_triangle, objects.albedo)

    def light(self, time_s: float) -> Light:
        """The light at a time, for kernels."""
        photometry, drifting = self.photometry, NO_CLOUDS
        if self.clouds is not None:
            more = self.clouds.parameters.sky_light(self.sun)
            photometry = replace(photometry, sky_share=photometry.sky_share + more)
            drifting = (self.clouds.cover, self.clouds.coefficients(self.sun, time_s))
        # clouds are not drawn: they do not change the sky's own brightness
        sky = self.photometry.sky_coefficients(self.sun)
        towards = np.asarray(self.sun.direction, dtype=np.float64)
        return Light(towards, photometry.law(self.sun, self.caster_diameter_m), sky, *drifting)
