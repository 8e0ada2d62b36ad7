"""World of a landing case: terrain with rocks, scaled texture, custom meshes, and sun."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from marsyard.scenarios.landing.faults import sun_elevation_with_shadow_deg
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.meshes import MeshParameters
from marsyard.scenarios.radiance import SiteWorld, sun_at, sunlight_ratio
from marsyard.scenarios.views import load_ground
from marsyard.sim.terrain import site
from marsyard.sim.terrain.sites import SiteTexture


@dataclass(frozen=True)
class LandingWorld(SiteWorld):
    """Terrain with rocks, custom meshes, and sun of a landing case."""

    meshes: tuple[MeshParameters, ...] = ()

    @classmethod
    def from_parameters(cls, p: LandingScenarioParameters) -> LandingWorld:
        """Create the world of a case."""
        # the site without the dust of the case, so that cases share the cached terrain
        ground = load_ground(site(p.site), p.terrain, p.location.bank_seed, p.location.terrain)
        dusty_site = p.site_preset
        texture, air = dusty_site.ground_texture, dusty_site.environment
        amplitudes = tuple(p.texture * amplitude for amplitude in texture.amplitudes)
        scaled_texture = SiteTexture(coarsest_m=texture.coarsest_m, amplitudes=amplitudes)
        ground = replace(ground, site=dusty_site.model_copy(update={"ground_texture": scaled_texture}))
        elevation_deg = sun_elevation_with_shadow_deg(p.faults, p.sun.elevation_deg)
        sun = sun_at(air, p.sun.azimuth_deg, elevation_deg)
        return cls(ground, sun, sunlight_ratio(air, float(np.radians(elevation_deg)), p.detector), p.meshes)
