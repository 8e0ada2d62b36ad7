"""World of a localisation case: the terrain of a site, its atmosphere and the sun of the landing."""

from __future__ import annotations

import numpy as np

from marsyard.scenarios.radiance import SiteWorld, sun_at, sunlight_ratio
from marsyard.scenarios.views import SiteGround, Viewpoint, mesh_size, site_scene
from marsyard.sim.render import Scene
from marsyard.sim.sensor import DetectorParameters
from marsyard.sim.terrain import Site, TerrainParameters


class LocalisationWorld(SiteWorld):
    """Terrain and light of a landing."""

    @classmethod
    def from_parameters(
        cls,
        site: Site,
        terrain: TerrainParameters,
        *,
        bank_seed: int,
        terrain_number: int,
        sun_azimuth_deg: float,
        sun_elevation_deg: float,
        optical_depth: float | None = None,
        detector: DetectorParameters | None = None,
    ) -> LocalisationWorld:
        """Create the world of a case; load its terrain if it is stored, otherwise build it in memory.

        - sun_azimuth_deg, sun_elevation_deg: azimuth clockwise from north, and elevation
        - optical_depth: of the dusty atmosphere during the landing; None for that of the site
        - detector: detector of the descent camera, for the brightness; without it the brightness is 1
        """
        ground = SiteGround.from_bank(site.with_dust(optical_depth), terrain, bank_seed, terrain_number)
        air = ground.site.environment
        sun = sun_at(air, sun_azimuth_deg, sun_elevation_deg)
        brightness = 1.0 if detector is None else sunlight_ratio(air, float(np.radians(sun_elevation_deg)), detector)
        return cls(ground, sun, brightness)

    def scene(self, east_m: float, north_m: float, height_m: float, pixel_rad: float) -> Scene:
        """Create the scene for a camera; the terrain repeats beyond its period.

        - east_m, north_m: position below the camera, around which the ground's mesh is dense
        - height_m: height above the ground
        - pixel_rad: angle of a pixel
        """
        return site_scene(self.ground, Viewpoint(east_m, north_m, height_m, pixel_rad), self.sun)

    def move_scene(self, scene: Scene, east_m: float, north_m: float, height_m: float) -> Scene:
        """Return the scene with the mesh for another position of the camera.

        The mesh gives only first guesses of the range, which are refined on the exact surface. A mesh that is too
        coarse changes pixels at the edges of hidden slopes: 0.2 % of the pixels in an image 500 m above the highland,
        with a mesh for 2000 m. A mesh that is too fine takes longer.
        """
        return scene.with_mesh((east_m, north_m), *mesh_size(self.surface.spacing_m, height_m))
