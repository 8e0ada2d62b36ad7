"""World of a descent: terrain, sun, air and custom objects, and the scene of its images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from marsyard.scenarios.descent.faults import add_terrain_fault
from marsyard.scenarios.descent.parameters import DescentScenarioParameters
from marsyard.scenarios.meshes import MeshParameters, add_meshes
from marsyard.scenarios.radiance import sun_at, sunlight_ratio
from marsyard.scenarios.views import SiteGround, Viewpoint, site_scene
from marsyard.sim.frames import direction
from marsyard.sim.render import Photometry, Scene, Sun
from marsyard.sim.terrain import Environment, Surface, TerrainBank

#: Finest mesh spacing of a generic terrain: upper limit, and ratio to the height of the last image above ground.
MESH_FINEST_M, MESH_FINEST_FRACTION = 12.0, 0.01


@dataclass(frozen=True)
class DescentWorld:
    """Terrain and light of a descent.

    - ground: the terrain with its site's light, texture and rocks; None for a generic terrain
    - meshes: custom objects on the ground
    - brightness: sunlight at the ground divided by the reference sunlight of the detector's responsivity
    """

    surface: Surface
    ground: SiteGround | None
    sun: Sun
    meshes: tuple[MeshParameters, ...] = ()
    brightness: float = 1.0

    @property
    def air(self) -> Environment:
        """Atmosphere of the site; the default Martian atmosphere for a generic terrain."""
        return Environment() if self.ground is None else self.ground.site.environment

    @classmethod
    def from_parameters(cls, p: DescentScenarioParameters) -> DescentWorld:
        """Create the world of a case; load its terrain if it is stored, otherwise build it in memory."""
        terrain = add_terrain_fault(p.faults, p.terrain)
        bank = TerrainBank(terrain, p.location.bank_seed)
        surface = bank.terrain(p.location.terrain)
        azimuth, elevation = np.radians([p.sun.azimuth_deg, p.sun.elevation_deg]).tolist()
        if p.site_preset is None:
            return cls(surface, None, Sun(direction(azimuth, elevation)), p.meshes)
        air = p.site_preset.environment
        sun = sun_at(air, p.sun.azimuth_deg, p.sun.elevation_deg)
        ground = SiteGround(p.site_preset, terrain, surface, bank.rocks(p.location.terrain, surface))
        return cls(surface, ground, sun, p.meshes, sunlight_ratio(air, elevation, p.detector))

    def scene(self, east_m: float, north_m: float, last_height_m: float, pixel_rad: float) -> Scene:
        """Create the scene of all images of a descent, without the lander's shadow and clouds.

        - east_m, north_m: position below the first image
        - last_height_m: height above ground of the last image; determines the smallest rocks of the scene
        - pixel_rad: angle of a pixel
        """
        if self.ground is None:
            mesh_finest_m = min(MESH_FINEST_M, MESH_FINEST_FRACTION * last_height_m)
            scene = Scene(self.surface, (east_m, north_m), self.sun, Photometry(), mesh_finest_m=mesh_finest_m)
        else:
            scene = site_scene(self.ground, Viewpoint(east_m, north_m, last_height_m, pixel_rad), self.sun)
        return add_meshes(scene, self.meshes, (east_m, north_m))
