"""What is rendered: ground, things on it, and light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float64

from marsyard.sim.render.clouds import CloudLayer, no_cover
from marsyard.sim.render.ground_shadow import NO_SHADOW, ground_in_cones, ground_shadow, slope_bounds, sun_over_slopes
from marsyard.sim.render.kernels.ground import height_range
from marsyard.sim.render.kernels.shading import Occluders
from marsyard.sim.render.kernels.structs import Bounds, Extent, Footprint, GroundShadow, Light, Materials
from marsyard.sim.render.mesh import graded_offsets
from marsyard.sim.render.objects import Objects
from marsyard.sim.render.photometry import Photometry, Sun, Texture
from marsyard.sim.render.reach import EVERYWHERE, Cone, casters_towards, potentially_visible, shadow_footprint
from marsyard.sim.terrain import Surface

#: By how much a mean of heights may stand above the highest of them, metres: single precision rounds at a few km.
ROUNDING_M = 0.01
NO_TEXTURE = Texture()
NO_CLOUDS = (no_cover(), np.zeros(5))


@dataclass(frozen=True)
class Scene:
    """Ground, things on it, and light.

    Attributes
    ----------
    surface
        The terrain.
    centre_m
        World x, y around which the mesh is dense: below a camera near the ground, or the place of a descent.
    sun, photometry
        The light, and how the ground scatters it.
    objects
        What stands on the ground.
    ground_texture, object_texture
        Albedo finer than the terrain's samples.
    caster_diameter_m
        Diameter of what casts a shadow from the camera's place: the lander seen against the sun. 0 for none.
    ground_shadows
        Whether the ground hides the sun from itself, as softly as the sun's disc is wide; shadows of objects are hard.
    clouds
        Clouds that dim the sun as they drift; None for none.
    mesh_finest_m, mesh_reach_m, mesh_lines
        Spacing of the mesh at the centre, how far it reaches to each side, and the number of its lines.
    among_objects
        Whether pictures are taken from among the objects, whose shadows may then fall nearly anywhere in them. Without
        it the places where they may fall are found before, which spares all others the search
        (`marsyard.sim.render.reach`).
    edge_rays
        Rays along each side of a pixel that holds an edge (`marsyard.sim.render.edges`); 1 draws every pixel by one
        ray.
    shown_m
        Least and greatest x, least and greatest y of what pictures show; None where they may show anything.
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
        """The same ground in the same light with other things on it; what was found of the ground is kept."""
        return self._knowing(replace(self, objects=objects), "mesh_offsets", "height_range_m", "steepest", "shadow")

    def in_light(self, sun: Sun, photometry: Photometry) -> Scene:
        """The same ground with the same things on it under another sun."""
        other = self._knowing(replace(self, sun=sun, photometry=photometry), "mesh_offsets", "height_range_m")
        # bounds that were not found for this sun may be for the other
        return self._knowing(other, "steepest") if np.all(np.isfinite(self.steepest)) else other

    def _knowing(self, other: Scene, *found: str) -> Scene:
        """Another scene, with what was found of this one and holds for it too."""
        other.__dict__.update({name: getattr(self, name) for name in found})
        return other

    def within(self, cones: Sequence[Cone]) -> Scene:
        """The scene with those objects alone that pictures within these cones may show, or show the shadows of.

        The ground's shadow is found only where these pictures may show it.
        """
        sun, lowest = np.asarray(self.sun.direction, dtype=np.float64), self.height_range_m[0]
        kept = np.zeros(len(self.objects), dtype=np.bool_)
        for cone in cones:
            kept |= potentially_visible(self.objects.spheres, sun, lowest, cone)
        less = replace(self, objects=self.objects.only(kept), shown_m=ground_in_cones(cones, lowest))
        return self._knowing(less, "mesh_offsets", "height_range_m", "steepest")

    @property
    def extent_m(self) -> Extent:
        """Where the ground ends: least and greatest x, least and greatest y of the mesh, greatest z of the surface."""
        (x, y), reach = self.centre_m, self.mesh_reach_m
        # coarser levels are means of finer ones: none stands higher, but for rounding
        return x - reach, x + reach, y - reach, y + reach, self.height_range_m[1] + ROUNDING_M

    @cached_property
    def height_range_m(self) -> tuple[float, float]:
        """Bounds of the ground's height."""
        low, high = height_range(self.surface.levels[0])
        return float(low), float(high)

    @cached_property
    def steepest(self) -> tuple[float, float]:
        """Bounds of the ground's slope along x and along y; infinite where it rises as steeply as the sun's rays."""
        return slope_bounds(self.surface, self.sun)

    @cached_property
    def shadow(self) -> GroundShadow:
        """The ground's shadow on the grid of a level of the surface."""
        if not self.ground_shadows or self.sun.direction[2] <= 0.0 or sun_over_slopes(self.sun, self.steepest):
            return NO_SHADOW
        return ground_shadow(self.surface, self.sun, self.height_range_m, self.shown_m)

    @cached_property
    def footprint(self) -> Footprint:
        """Where objects may shade the ground."""
        if self.among_objects:
            return EVERYWHERE
        towards = np.asarray(self.sun.direction, dtype=np.float64)
        return shadow_footprint(self.objects.spheres, towards, self.height_range_m[0])

    @cached_property
    def occluders(self) -> Occluders:
        """What hides the sun, for kernels."""
        return Occluders(self.shadow, casters_towards(self.objects, self.sun), self.footprint)

    @cached_property
    def materials(self) -> Materials:
        """How ground and objects look, for kernels."""
        objects = self.objects
        textures = self.ground_texture.arrays(), self.object_texture.arrays()
        return Materials(*textures, objects.normals, objects.body_of_triangle, objects.albedo)

    def light(self, time_s: float) -> Light:
        """The light at a time, for kernels."""
        photometry, drifting = self.photometry, NO_CLOUDS
        if self.clouds is not None:
            more = self.clouds.parameters.sky_light(self.sun)
            photometry = replace(photometry, sky_share=photometry.sky_share + more)
            drifting = (self.clouds.cover, self.clouds.numbers(self.sun, time_s))
        # clouds are not drawn: the sky between them is as bright as ever
        sky = self.photometry.sky_numbers(self.sun)
        towards = np.asarray(self.sun.direction, dtype=np.float64)
        return Light(towards, photometry.law(self.sun, self.caster_diameter_m), sky, *drifting)
