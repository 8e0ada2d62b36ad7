"""Environment of a site: gravity, sunlight, and the dusty atmosphere that transmits and scatters it."""

from typing import Annotated

import numpy as np
from pydantic import Field

from marsyard.sim.parameters import Parameters, Positive

MIN_SUN_SINE = 0.05  #: Lower limit of the sine of the sun's elevation in the plane-parallel atmosphere model.
SUN_RADIUS_AT_1_AU_RAD = 0.00465  #: Angular radius of the sun at 1 AU.


class Environment(Parameters):
    """Gravity, sunlight and dusty atmosphere at a site."""

    planet: Annotated[str, Field(description="name of the planet")] = "Mars"
    gravity_m_s2: Annotated[Positive, Field(description="gravity, m/s2")] = 3.72
    solar_irradiance: Annotated[Positive, Field(description="solar irradiance relative to that at 1 AU")] = 0.44
    optical_depth: Annotated[float, Field(ge=0.0, le=10.0, description="optical depth of the atmosphere")] = 0.5
    single_scattering_albedo: Annotated[float, Field(ge=0.0, lt=1.0, description="scattering / extinction")] = 0.94
    asymmetry: Annotated[float, Field(gt=-1.0, lt=1.0, description="mean cosine of the scattering angle")] = 0.65
    scale_height_m: Annotated[Positive, Field(description="height over which extinction falls to 1/e, m")] = 11100.0

    @property
    def sun_radius_rad(self) -> float:
        """Angular radius of the sun's disc, proportional to the square root of the irradiance."""
        return float(SUN_RADIUS_AT_1_AU_RAD * np.sqrt(self.solar_irradiance))

    def direct_fraction(self, sun_elevation_rad: float) -> float:
        """Compute the fraction of sunlight on a plane facing the sun, including light scattered by a few degrees.

        ``exp(-tau' / sin elevation)``, where tau' is the optical depth without the forward peak of scattering (delta
        scaling, Joseph et al. 1976).
        """
        return float(np.exp(-self._apply_delta_scaling()[0] / max(np.sin(sun_elevation_rad), MIN_SUN_SINE)))

    def sky_fraction(self, sun_elevation_rad: float, ground_albedo: float = 0.0) -> float:
        """Compute the diffuse irradiance on level ground divided by the direct irradiance on a plane facing the sun.

        Delta-Eddington approximation (Joseph, Wiscombe & Weinman 1976) over ground with an albedo, which reflects light
        to the atmosphere. The value is also the radiance factor of a uniform sky with this irradiance.
        """
        tau, albedo, asymmetry = self._apply_delta_scaling()
        if tau == 0.0:
            return 0.0
        mu = max(float(np.sin(sun_elevation_rad)), MIN_SUN_SINE)
        k = np.sqrt(3.0 * (1.0 - albedo) * (1.0 - albedo * asymmetry))
        if abs(1.0 - k * mu) < 1e-6:
            mu *= 1.0 + 2e-6  # the particular solution is singular at k mu = 1, but the irradiance is continuous
        p = np.sqrt(3.0 * (1.0 - albedo) / (1.0 - albedo * asymmetry))
        # intensity I + I1 cos(angle from the nadir) for a solar flux of pi, particular solution -alpha, -beta
        alpha = 0.75 * albedo * mu**2 * (1.0 + asymmetry * (1.0 - albedo)) / (1.0 - (k * mu) ** 2)
        beta = 0.75 * albedo * mu * (1.0 + 3.0 * asymmetry * (1.0 - albedo) * mu**2) / (1.0 - (k * mu) ** 2)
        # I = C1 e^-kt + C2 e^kt - alpha e^-t/mu, I1 = p (C1 e^-kt - C2 e^kt) - beta e^-t/mu; boundary conditions: no
        # downward diffuse light at the top (I + 2/3 I1 = 0); upward light from ground with the albedo A:
        # I - 2/3 I1 = A (I + 2/3 I1 + mu e^-t/mu)
        two_thirds = 2.0 / 3.0
        direct = np.exp(-tau / mu)
        plus, minus = 1.0 + two_thirds * p, 1.0 - two_thirds * p
        a = ground_albedo
        at_ground = [(minus - a * plus) * np.exp(-k * tau), (plus - a * minus) * np.exp(k * tau)]
        source = alpha - two_thirds * beta - a * (alpha + two_thirds * beta - mu)
        c1, c2 = np.linalg.solve(np.array([[plus, minus], at_ground]), [alpha + two_thirds * beta, source * direct])
        i0 = c1 * np.exp(-k * tau) + c2 * np.exp(k * tau) - alpha * direct
        i1 = p * (c1 * np.exp(-k * tau) - c2 * np.exp(k * tau)) - beta * direct
        return float(max(i0 + two_thirds * i1, 0.0) / direct)

    def mean_extinction_m(self, height_m: float) -> float:
        """Return the mean extinction coefficient between the ground and a height above it, 1/m."""
        height_m = max(height_m, 1.0)
        return float(-self.optical_depth * np.expm1(-height_m / self.scale_height_m) / height_m)

    def _apply_delta_scaling(self) -> tuple[float, float, float]:
        """Compute optical depth, single-scattering albedo and asymmetry g without the forward peak (fraction g**2)."""
        peak = self.asymmetry**2
        remainder = 1.0 - self.single_scattering_albedo * peak
        albedo = self.single_scattering_albedo * (1.0 - peak) / remainder
        return self.optical_depth * remainder, albedo, self.asymmetry / (1.0 + self.asymmetry)
