"""World of a descent: terrain, light, and the scene of its pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from marsyard.scenarios.descent.faults import faulty_terrain
from marsyard.scenarios.descent.parameters import DescentScenarioParameters
from marsyard.scenarios.exposure import sunlight_ratio
from marsyard.scenarios.meshes import MeshParameters, add_meshes
from marsyard.scenarios.views import Eye, SiteGround, site_scene
from marsyard.sim.frames import direction
from marsyard.sim.render import Photometry, Scene, Sun
from marsyard.sim.render.clouds import CloudLayer
from marsyard.sim.terrain import Environment, Surface, TerrainBank

#: Finest spacing of a plain terrain's mesh: that of pictures from 1200 m and above, and as a fraction of lower heights.
MESH_FINEST_M, MESH_FINEST_HEIGHTS = 12.0, 0.01


@dataclass(frozen=True)
class World:
    """Terrain and light of a descent.

    - ground: the terrain with its site's light, texture and rocks; None for a plain terrain
    - meshes: own bodies on the ground
    - brightness: sunlight at the ground over the reference sunlight of the detector's responsivity
    """

    surface: Surface
    ground: SiteGround | None
    sun: Sun
    meshes: tuple[MeshParameters, ...] = ()
    brightness: float = 1.0

    @property
    def air(self) -> Environment:
        """Atmosphere of the site; Mars for a plain terrain."""
        return Environment() if self.ground is None else self.ground.site.environment

    @classmethod
    def of(cls, p: DescentScenarioParameters) -> World:
        """Create a case's world; its terrain is read from the cache or built."""
        terrain = faulty_terrain(p.faults, p.terrain)
        bank = TerrainBank(terrain, p.location.bank_seed)
        surface = bank.terrain(p.location.terrain)
        elevation = float(np.radians(p.sun.elevation_deg))
        towards_sun = direction(np.radians(p.sun.azimuth_deg), elevation)
        if p.preset is None:
            return cls(surface, None, Sun(towards_sun), p.meshes)
        air = p.preset.environment
        sun = Sun(towards_sun, air.sun_radius_rad)
        ground = SiteGround(p.preset, terrain, surface, bank.rocks(p.location.terrain))
        return cls(surface, ground, sun, p.meshes, sunlight_ratio(air, elevation, p.detector))

    def scene(
        self,
        east_m: float,
        north_m: float,
        lowest_m: float,
        pixel_rad: float,
        *,
        caster_diameter_m: float = 0.0,
        clouds: CloudLayer | None = None,
    ) -> Scene:
        """Scene of all pictures of a descent.

        - east_m, north_m: position below the first picture
        - lowest_m: height above ground of the last picture, which determines the smallest rocks
        - caster_diameter_m: diameter of the disc that casts the lander's shadow
        """
        if self.ground is None:
            finest = min(MESH_FINEST_M, MESH_FINEST_HEIGHTS * lowest_m)
            scene = Scene(self.surface, (east_m, north_m), self.sun, Photometry(), mesh_finest_m=finest)
        else:
            scene = site_scene(self.ground, Eye(east_m, north_m, lowest_m, pixel_rad), self.sun)
        scene = add_meshes(scene, self.meshes, (east_m, north_m))
        return replace(scene, caster_diameter_m=caster_diameter_m, clouds=clouds)
