"""The world of a landing: ground with rocks, light, and what the camera sees of both."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from marsyard.scenarios.landing.faults import faulty_sun_deg
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.meshes import MeshParameters, standing
from marsyard.scenarios.optics import Optics
from marsyard.scenarios.views import Eye, SiteGround, site_scene
from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import direction
from marsyard.sim.render import Objects, Scene, Sun
from marsyard.sim.terrain import TerrainBank, TerrainParameters, site
from marsyard.sim.terrain.sites import SiteTexture

#: Grounds that a worker keeps: their rocks take a second or two to place.
KEPT_GROUNDS = 64


@dataclass(frozen=True)
class World:
    """Where a landing happens.

    Attributes
    ----------
    ground
        The terrain with its rocks.
    sun
        The sun.
    meshes
        Own bodies on the ground.
    brightness
        Sunlight at the ground over that for which the detector's responsivity is stated.
    """

    ground: SiteGround
    sun: Sun
    meshes: tuple[MeshParameters, ...]
    brightness: float

    @classmethod
    def of(cls, p: LandingScenarioParameters) -> World:
        """The world of a case; its terrain comes from the disk, or is built."""
        ground = site_ground(p.site, p.terrain, p.place.bank_seed, p.place.terrain)
        textured = SiteTexture(
            coarsest_m=p.preset.ground_texture.coarsest_m,
            amplitudes=tuple(p.texture * amplitude for amplitude in p.preset.ground_texture.amplitudes),
        )
        ground = replace(ground, site=p.preset.model_copy(update={"ground_texture": textured}))
        air = p.preset.environment
        elevation = float(np.radians(faulty_sun_deg(p.faults, p.sun.elevation_deg)))
        sun = Sun(direction(np.radians(p.sun.azimuth_deg), elevation), air.sun_radius_rad)
        brightness = air.direct_share(elevation) * air.solar_irradiance / p.detector.sunlight
        return cls(ground, sun, p.meshes, brightness)

    def scene(self, eye: Eye, caster_diameter_m: float) -> Scene:
        """One scene for both pictures, as fine as the lower one sees."""
        scene = site_scene(self.ground, eye, self.sun)
        if self.meshes:
            own = standing(self.meshes, self.ground.surface, (eye.east_m, eye.north_m))
            scene = scene.with_objects(Objects.joined([scene.objects, own]))
        return replace(scene, caster_diameter_m=caster_diameter_m)


@lru_cache(maxsize=KEPT_GROUNDS)
def site_ground(site_name: str, terrain: TerrainParameters, bank_seed: int, number: int) -> SiteGround:
    """A terrain of a site's bank with its rocks, kept by the process."""
    bank = TerrainBank(terrain, bank_seed)
    return SiteGround(site(site_name), terrain, bank.terrain(number), bank.rocks(number))


@lru_cache(maxsize=4)
def camera_optics(camera: CameraModel) -> Optics:
    """The optics of a camera in the body frame: at its origin, looking down, columns along x."""
    return Optics.of(camera)
