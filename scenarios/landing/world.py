"""The world of a landing: ground with rocks, light, and what the camera sees of both."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from marsyard.scenarios.base import LoadGround
from marsyard.scenarios.exposure import sunlight_ratio
from marsyard.scenarios.landing.faults import faulty_sun_deg
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.meshes import MeshParameters, with_meshes
from marsyard.scenarios.views import Eye, SiteGround, site_scene
from marsyard.sim.frames import direction
from marsyard.sim.render import Scene, Sun
from marsyard.sim.terrain import site
from marsyard.sim.terrain.sites import SiteTexture

#: Grounds that a worker keeps: their rocks take a second or two to place.
KEPT_GROUNDS = 64


@dataclass(frozen=True)
class World:
    """Where a landing happens."""

    ground: SiteGround  #: The terrain with its rocks
    sun: Sun  #: The sun
    meshes: tuple[MeshParameters, ...]  #: Own bodies on the ground
    brightness: float  #: Sunlight at the ground over that for which the detector's responsivity is stated

    @classmethod
    def of(cls, p: LandingScenarioParameters, load_ground: LoadGround = SiteGround.from_bank) -> World:
        """The world of a case."""
        ground = load_ground(site(p.site), p.terrain, p.place.bank_seed, p.place.terrain)
        textured = SiteTexture(
            coarsest_m=p.preset.ground_texture.coarsest_m,
            amplitudes=tuple(p.texture * amplitude for amplitude in p.preset.ground_texture.amplitudes),
        )
        ground = replace(ground, site=p.preset.model_copy(update={"ground_texture": textured}))
        air = p.preset.environment
        elevation = float(np.radians(faulty_sun_deg(p.faults, p.sun.elevation_deg)))
        sun = Sun(direction(np.radians(p.sun.azimuth_deg), elevation), air.sun_radius_rad)
        return cls(ground, sun, p.meshes, sunlight_ratio(air, elevation, p.detector))

    def scene(self, eye: Eye, caster_diameter_m: float) -> Scene:
        """One scene for both pictures, as fine as the lower one sees."""
        scene = site_scene(self.ground, eye, self.sun)
        scene = with_meshes(scene, self.meshes, (eye.east_m, eye.north_m))
        return replace(scene, caster_diameter_m=caster_diameter_m)
