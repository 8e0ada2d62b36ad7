"""Where a site is: gravity, rotation, sunlight and air."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from marsyard.sim.parameters import Parameters

#: Lowest sun for which a plane-parallel atmosphere is used.
LOWEST_SUN_SINE = 0.05
#: Angular radius of the sun at 1 AU, radians.
SUN_RADIUS_AT_1_AU_RAD = 0.00465


class Environment(Parameters):
    """A planet's gravity, rotation, sunlight and dusty air at a site."""

    planet: Annotated[str, Field(description="which planet")] = "Mars"
    gravity_m_s2: Annotated[float, Field(gt=0.0, description="gravity, m/s2")] = 3.72
    rotation_rad_s: Annotated[float, Field(ge=0.0, description="sidereal rotation rate, rad/s")] = 7.0882e-5
    solar_irradiance: Annotated[
        float, Field(gt=0.0, description="sunlight above the air over that at 1 AU; 0.44 at 1.5 AU")
    ] = 0.44
    optical_depth: Annotated[float, Field(ge=0.0, le=10.0, description="extinction optical depth of the air")] = 0.5
    single_scattering_albedo: Annotated[
        float, Field(ge=0.0, lt=1.0, description="share of the extinction that is scattering")
    ] = 0.94
    asymmetry: Annotated[float, Field(gt=-1.0, lt=1.0, description="mean cosine of the scattering angle")] = 0.65

    @property
    def sun_radius_rad(self) -> float:
        """Angular radius of the sun's disc: like the square root of its irradiance, it falls with the distance."""
        return float(SUN_RADIUS_AT_1_AU_RAD * np.sqrt(self.solar_irradiance))

    def direct_share(self, sun_elevation_rad: float) -> float:
        """Share of sunlight that reaches a plane facing the sun, with the aureole scattered forward around it.

        ``exp(-tau' / sin elevation)``, tau' the optical depth less the forward peak (delta scaling, Joseph et al.
        1976): light scattered by a few degrees shades the ground as the sun's own does.
        """
        return float(np.exp(-self._scaled()[0] / max(np.sin(sun_elevation_rad), LOWEST_SUN_SINE)))

    def sky_share(self, sun_elevation_rad: float) -> float:
        """Diffuse irradiance of a level ground over the direct sun's on a plane facing it.

        The delta-Eddington approximation (Joseph, Wiscombe & Weinman 1976) over a black ground; it leaves out light
        that the ground sends up and the air returns. An even sky of this radiance factor gives this irradiance.
        """
        tau, albedo, asymmetry = self._scaled()
        if tau == 0.0:
            return 0.0
        mu = max(float(np.sin(sun_elevation_rad)), LOWEST_SUN_SINE)
        k = np.sqrt(3.0 * (1.0 - albedo) * (1.0 - albedo * asymmetry))
        p = np.sqrt(3.0 * (1.0 - albedo) / (1.0 - albedo * asymmetry))
        # intensity I + I1 cos(angle from the nadir) for a solar flux of pi, particular solution -alpha, -beta
        alpha = 0.75 * albedo * mu**2 * (1.0 + asymmetry * (1.0 - albedo)) / (1.0 - (k * mu) ** 2)
        beta = 0.75 * albedo * mu * (1.0 + 3.0 * asymmetry * (1.0 - albedo) * mu**2) / (1.0 - (k * mu) ** 2)
        # I = C1 e^-kt + C2 e^kt - alpha e^-t/mu, I1 = p (C1 e^-kt - C2 e^kt) - beta e^-t/mu; no diffuse light comes
        # down at the top (I + 2/3 I1 = 0) nor up from the ground (I - 2/3 I1 = 0)
        two_thirds = 2.0 / 3.0
        fade = np.exp(-tau / mu)
        system = np.array(
            [
                [1.0 + two_thirds * p, 1.0 - two_thirds * p],
                [(1.0 - two_thirds * p) * np.exp(-k * tau), (1.0 + two_thirds * p) * np.exp(k * tau)],
            ]
        )
        c1, c2 = np.linalg.solve(system, [alpha + two_thirds * beta, (alpha - two_thirds * beta) * fade])
        mean = c1 * np.exp(-k * tau) + c2 * np.exp(k * tau) - alpha * fade
        slant = p * (c1 * np.exp(-k * tau) - c2 * np.exp(k * tau)) - beta * fade
        return float(max(mean + two_thirds * slant, 0.0) / fade)

    def _scaled(self) -> tuple[float, float, float]:
        """Optical depth, single-scattering albedo and asymmetry without the forward peak g**2."""
        peak = self.asymmetry**2
        left = 1.0 - self.single_scattering_albedo * peak
        albedo = self.single_scattering_albedo * (1.0 - peak) / left
        return self.optical_depth * left, albedo, self.asymmetry / (1.0 + self.asymmetry)
