"""The world of a descent: its terrain, its light, and what the camera sees of both."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from marsyard.scenarios.descent.faults import faulty_terrain
from marsyard.scenarios.descent.parameters import DescentScenarioParameters
from marsyard.scenarios.exposure import sunlight_ratio
from marsyard.scenarios.meshes import MeshParameters, with_meshes
from marsyard.scenarios.views import Eye, SiteGround, site_scene
from marsyard.sim.frames import direction
from marsyard.sim.render import Photometry, Scene, Sun
from marsyard.sim.render.clouds import CloudLayer
from marsyard.sim.terrain import Environment, Surface, TerrainBank

#: Finest spacing of a plain terrain's mesh: that of pictures from 1200 m and more, and its share of a lower height.
MESH_FINEST_M, MESH_FINEST_HEIGHTS = 12.0, 0.01


@dataclass(frozen=True)
class World:
    """Where a descent happens.

    Attributes
    ----------
    surface
        The terrain.
    ground
        The same with its site's light, texture and rocks; None for a plain terrain.
    sun
        The sun.
    meshes
        Own bodies on the ground.
    brightness
        Sunlight at the ground over that for which the detector's responsivity is stated.
    """

    surface: Surface
    ground: SiteGround | None
    sun: Sun
    meshes: tuple[MeshParameters, ...] = ()
    brightness: float = 1.0

    @property
    def air(self) -> Environment:
        """The site's air; that of Mars over a plain terrain."""
        return Environment() if self.ground is None else self.ground.site.environment

    @classmethod
    def of(cls, p: DescentScenarioParameters) -> World:
        """The world of a case; its terrain comes from the disk, or is built."""
        terrain = faulty_terrain(p.faults, p.terrain)
        bank = TerrainBank(terrain, p.place.bank_seed)
        surface = bank.terrain(p.place.terrain)
        elevation = float(np.radians(p.sun.elevation_deg))
        towards_sun = direction(np.radians(p.sun.azimuth_deg), elevation)
        if p.preset is None:
            return cls(surface, None, Sun(towards_sun), p.meshes)
        air = p.preset.environment
        sun = Sun(towards_sun, air.sun_radius_rad)
        brightness = sunlight_ratio(air, elevation, p.detector)
        ground = SiteGround(p.preset, terrain, surface, bank.rocks(p.place.terrain))
        return cls(surface, ground, sun, p.meshes, brightness)

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
        """One scene for all pictures of a descent.

        Parameters
        ----------
        east_m, north_m
            Below the first picture.
        lowest_m
            Height above the ground of the last picture, which shows the smallest rocks.
        pixel_rad
            Angle that a pixel takes.
        caster_diameter_m
            Diameter of what casts the lander's shadow.
        clouds
            Clouds that drift above.
        """
        if self.ground is None:
            finest = min(MESH_FINEST_M, MESH_FINEST_HEIGHTS * lowest_m)
            scene = Scene(self.surface, (east_m, north_m), self.sun, Photometry(), mesh_finest_m=finest)
        else:
            scene = site_scene(self.ground, Eye(east_m, north_m, lowest_m, pixel_rad), self.sun)
        scene = with_meshes(scene, self.meshes, (east_m, north_m))
        return replace(scene, caster_diameter_m=caster_diameter_m, clouds=clouds)
